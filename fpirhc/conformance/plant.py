"""Laws that every plant keeps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.conformance.laws import hold, keep, within
from fpirhc.errors import Mistakes
from fpirhc.plant.motion import input_columns
from fpirhc.plant.plant import Plant

_POINTS = 20
_INVERSE = 1e-6  # relative to the response; Newton's method is stopped at 1e-8
_SLOPE = 1e-5  # relative, of central differences


def check_plant(plant: Plant, *, seed: int, box: Mapping[str, tuple[float, float]] | None = None) -> None:
    """Check every law on a plant at random points.

    Args:
        plant: the plant.
        seed: of the points.
        box: intervals of states (q1, q1', ...) and inputs by name ("input NAME" beside a coordinate NAME), from which the points
            are drawn; (-1, 1) for every other name.

    Raises:
        AssertionError: the first law that does not hold, in one sentence.
        InvalidProblem: a name in `box` that the plant does not have.
    """
    mistakes = Mistakes("box")
    mistakes.unknown("state or input", box or {}, [*plant.state.elements, *input_columns(plant)])
    mistakes.raise_if_any()
    keep(plant, _Trial(plant, box or {}), LAWS, seed)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A plant with the box from which its points are drawn."""

    plant: Plant
    box: Mapping[str, tuple[float, float]]

    @property
    def names(self) -> list[str]:
        return [*self.plant.state.elements, *input_columns(self.plant)]

    @property
    def parameters(self) -> dict[str, np.ndarray]:
        return {"approximate": self.plant.approximate, "exact": self.plant.exact}

    def points(self, generator: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray, str]]:
        """States and inputs, and both in words."""
        for _ in range(_POINTS):
            z = np.array([generator.uniform(*self.box.get(n, (-1.0, 1.0))) for n in self.names])
            where = "at " + ", ".join(f"{n} = {v:.4g}" for n, v in zip(self.names, z, strict=True))
            yield z[: self.plant.state.size], z[self.plant.state.size :], where


def _numbers(function: ca.Function, *arguments: Any) -> np.ndarray:
    return np.asarray(function(*arguments).full())[:, 0]


def response_is_finite(trial: _Trial, generator: np.random.Generator) -> None:
    """The response is finite at every point of the box, with the approximate and with the exact parameters."""
    plant = trial.plant
    for x, u, where in trial.points(generator):
        for which, p in trial.parameters.items():
            response = _numbers(plant.equations.response, x, u, p)
            for name, value in zip(plant.names, response, strict=True):
                finite = bool(np.isfinite(value))
                hold(finite, f"the response of '{name}' ({which} parameters) is {value} {where}")


def both_parameter_sets_enter(trial: _Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A parameter whose values differ enters the response or an output, or else model and plant are the same."""
    plant = trial.plant
    size = len(plant.parameters)
    for which, values in trial.parameters.items():
        hold(values.shape == (size,), f"the {which} parameters have shape {values.shape}, expected ({size},)")
    x, u, p = plant.symbols()
    seen = plant.equations.response(x, u, p), plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names)))
    pattern = ca.DM(ca.jacobian_sparsity(ca.vertcat(*seen), p), 1)
    entering = np.asarray(pattern.full()).sum(axis=0) > 0
    for k, name in enumerate(plant.parameters):
        approximate, exact = plant.approximate[k], plant.exact[k]
        hold(
            bool(entering[k]) or approximate == exact,
            f"the response does not depend on parameter '{name}' (approximate {approximate:g}, exact {exact:g}); "
            f"write p.{name} in the response",
        )


def response_is_pure(trial: _Trial, generator: np.random.Generator) -> None:
    """Building the response once more gives the same response: it has no random numbers and no memory."""
    again = replace(trial.plant)
    for x, u, where in trial.points(generator):
        one, other = (_numbers(p.equations.response, x, u, p.exact) for p in (trial.plant, again))
        hold(np.array_equal(one, other), f"built twice, it gives {one} and then {other} {where}")


def derivative_is_the_chain(trial: _Trial, generator: np.random.Generator) -> None:
    """dx/dt holds the next derivative of every coordinate, in the highest place the response plus the forcing."""
    plant = trial.plant
    elements = plant.state.elements
    for x, u, _ in trial.points(generator):
        forcing = generator.normal(size=len(plant.names))
        if plant.steps > 1:  # a forcing of a map acts in each of its steps, and moves the state of the later ones
            forcing[:] = 0
        forced = _numbers(plant.equations.response, x, u, plant.exact) + forcing
        rate = _numbers(plant.equations.forced_rate, x, u, plant.exact, forcing)
        for k, name in enumerate(elements):
            higher = f"{name}'"
            what = x[elements.index(higher)] if higher in elements else forced[plant.names.index(name.rstrip("'"))]
            hold(
                within(rate[k] - what, 1e-12 * max(1.0, abs(what))), f"d{name}/dt is {rate[k]:.6g}, expected {what:.6g}"
            )


def slopes_are_true(trial: _Trial, generator: np.random.Generator) -> None:
    """The derivatives of the response agree with central differences, so that an optimiser can use them."""
    plant = trial.plant
    x, u, p = plant.symbols()
    z = ca.vertcat(x, u)
    slope = ca.Function("slope", [z, p], [ca.densify(ca.jacobian(plant.equations.response(x, u, p), z))])
    split = plant.state.size
    for x0, u0, where in trial.points(generator):
        at = np.concatenate([x0, u0])
        slopes = np.asarray(slope(at, plant.exact).full())
        for k, name in enumerate(trial.names):
            step = 1e-5 * max(1.0, abs(at[k]))
            ends = [at + side * step * np.eye(at.size)[k] for side in (1, -1)]
            up, down = (_numbers(plant.equations.response, end[:split], end[split:], plant.exact) for end in ends)
            expected = (up - down) / (2 * step)
            scale = max(1.0, float(np.abs(expected).max()), float(np.abs(up).max()))
            missed = float(np.abs(slopes[:, k] - expected).max())
            hold(
                within(missed, _SLOPE * scale),
                f"the derivative of the response by '{name}' is {slopes[:, k]}, central differences give {expected} "
                f"{where}",
            )


def inverse_inverts(trial: _Trial, generator: np.random.Generator) -> None:
    """The input that the inverse finds for a response causes that response, with either parameter set."""
    plant = trial.plant
    if plant.controlled is None and len(plant.inputs) != len(plant.chains):
        return
    for x, u, where in trial.points(generator):
        for which, p in trial.parameters.items():
            wanted = _numbers(plant.equations.controlled_response, x, u, p)
            command = _numbers(plant.equations.inverse, x, wanted, p)
            got = _numbers(plant.equations.controlled_response, x, command, p)
            missed = float(np.abs(got - wanted).max())
            hold(
                within(missed, _INVERSE * (1 + float(np.abs(wanted).max()))),
                f"for the response {wanted} the inverse ({which} parameters) gives the input {command}, whose response is "
                f"{got} {where}",
            )


LAWS = (
    response_is_finite,
    both_parameter_sets_enter,
    response_is_pure,
    derivative_is_the_chain,
    slopes_are_true,
    inverse_inverts,
)
