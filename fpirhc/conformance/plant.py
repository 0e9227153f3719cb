"""Laws that every plant keeps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.conformance.laws import hold, keep, within
from fpirhc.errors import Mistakes
from fpirhc.plant.motion import input_columns, sampling
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
    """Along the motion, or a map's steps, y changes by y', this by y'', ... up to the response; a forcing adds to the highest."""
    plant, equations, p, names = trial.plant, trial.plant.equations, trial.plant.exact, trial.plant.output.elements
    held = plant.controlled is not None or len(plant.inputs) == len(plant.chains)
    for x, u, where in trial.points(generator):
        rate, forcing = _numbers(equations.rate, x, u, p), generator.normal(size=len(plant.names))
        step = 1e-5 / max(1.0, float(np.abs(rate).max())) if plant.step is None else sampling(plant)
        back = step if plant.step is None else 0.0
        later, earlier, now = (_numbers(equations.output, x + t * rate, u, p, 0) for t in (step, -back, 0.0))
        known = dict(zip((*names, *plant.state.elements), (*now, *x), strict=True))
        if held:
            responses = _numbers(equations.controlled_response, x, u, p)
            known |= {n + "'" * r: v for (n, r), v in zip(plant.response_orders.items(), responses, strict=True) if r}
        size = max(1.0, float(np.abs([*now, *rate]).max()))
        for name, slope in zip(names, (later - earlier) / (step + back), strict=True):
            want = known.get(f"{name}'", slope)
            fits = within(slope - want, _SLOPE * max(size, abs(want)))
            hold(fits, f"d{name}/dt is {slope:.6g}, expected {want:.6g} {where}")
        forced = _numbers(equations.forced_rate, x, u, p, forcing) - rate
        added = plant.steps > 1 or within(
            forced.sum() - forcing.sum(), 1e-9 * size
        )  # it moves the later steps of a map
        hold(added, f"a forcing of {forcing} adds {forced} to the derivatives of the states {where}")


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
