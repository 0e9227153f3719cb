"""Laws that every plant keeps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.conformance.laws import Array, Broken, Draw, keep, within
from fpirhc.errors import Mistakes
from fpirhc.plant.plant import Plant

_POINTS = 20
_INVERSE = 1e-6  # relative to the response; Newton's method is stopped at 1e-8
_SLOPE = 1e-5  # relative, of central differences


def check_plant(plant: Plant, *, seed: int, box: Mapping[str, tuple[float, float]] | None = None) -> None:
    """Check every law on a plant at random points.

    Args:
        box: intervals of states (q1, q1', ...) and inputs by name, from which the points are drawn; (-1, 1) for every other name.
    """
    names, mistakes = [*plant.state.elements, *plant.inputs], Mistakes("box")
    mistakes.unknown("state or input", box or {}, names)
    mistakes.raise_if_any()
    box = dict.fromkeys(names, (-1.0, 1.0)) | dict(box or {})
    keep(_Trial(plant, {name: box[name] for name in names}), seed)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A plant with the box from which its points are drawn."""

    plant: Plant
    box: Mapping[str, tuple[float, float]]  # of every state and input, in their order

    @property
    def parameters(self) -> dict[str, Array]:
        return {"approximate": self.plant.approximate, "exact": self.plant.exact}

    def points(self, draw: Draw) -> Iterator[tuple[Array, Array, str]]:
        """States and inputs, and both in words."""
        for _ in range(_POINTS):
            z = np.array([draw.uniform(*interval) for interval in self.box.values()])
            where = "at " + ", ".join(f"{n} = {v:.4g}" for n, v in zip(self.box, z, strict=True))
            yield z[: self.plant.state.size], z[self.plant.state.size :], where


def _numbers(function: ca.Function, *arguments: Any) -> Array:
    return np.asarray(function(*arguments).full())[:, 0]


def response_is_finite(trial: _Trial, draw: Draw) -> Broken:
    """The response is finite at every point of the box, with the approximate and with the exact parameters."""
    for x, u, where in trial.points(draw):
        for which, p in trial.parameters.items():
            response = _numbers(trial.plant.equations.response, x, u, p)
            for name, value in zip(trial.plant.names, response, strict=True):
                if not np.isfinite(value):
                    yield f"the response of '{name}' ({which} parameters) is {value} {where}"


def both_parameter_sets_enter(trial: _Trial, draw: Draw) -> Broken:
    """A parameter whose values differ enters the response or an output, or else model and plant are the same."""
    plant, (x, u, p) = trial.plant, trial.plant.symbols()
    seen = plant.equations.response(x, u, p), plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names)))
    pattern = ca.DM(ca.jacobian_sparsity(ca.vertcat(*seen), p), 1)
    entering = np.asarray(pattern.full()).sum(axis=0)
    for name, approximate, exact, enters in zip(
        plant.parameters, plant.approximate, plant.exact, entering, strict=True
    ):
        if not enters and approximate != exact:
            values = f"(approximate {approximate:g}, exact {exact:g})"
            yield f"the response does not depend on parameter '{name}' {values}; write p.{name} in the response"


def response_is_pure(trial: _Trial, draw: Draw) -> Broken:
    """Building the response once more gives the same response: it has no random numbers and no memory."""
    again = replace(trial.plant)
    for x, u, where in trial.points(draw):
        one, other = (_numbers(p.equations.response, x, u, p.exact) for p in (trial.plant, again))
        if not np.array_equal(one, other):
            yield f"built twice, it gives {one} and then {other} {where}"


def slopes_are_true(trial: _Trial, draw: Draw) -> Broken:
    """The derivatives of the response agree with central differences, so that an optimiser can use them."""
    (x, u, p), response, exact = trial.plant.symbols(), trial.plant.equations.response, trial.plant.exact
    z = ca.vertcat(x, u)
    slope = ca.Function("slope", [z, p], [ca.densify(ca.jacobian(response(x, u, p), z))])
    for x0, u0, where in trial.points(draw):
        at = np.concatenate([x0, u0])
        slopes = np.asarray(slope(at, exact).full())
        for k, name in enumerate(trial.box):
            step = 1e-5 * max(1.0, abs(at[k]))
            ends = (np.split(at + side * step * (np.arange(at.size) == k), [x0.size]) for side in (1, -1))
            up, down = (_numbers(response, *end, exact) for end in ends)
            expected = (up - down) / (2 * step)
            scale = max(1.0, float(np.abs(expected).max()), float(np.abs(up).max()))
            if not within(slopes[:, k] - expected, _SLOPE * scale):
                words = f"the derivative of the response by '{name}' is {slopes[:, k]}"
                yield f"{words}, central differences give {expected} {where}"


def inverse_inverts(trial: _Trial, draw: Draw) -> Broken:
    """The input that the inverse finds for a response causes that response, with either parameter set."""
    plant, equations = trial.plant, trial.plant.equations
    for x, u, where in trial.points(draw) if plant.controlled or len(plant.inputs) == len(plant.chains) else ():
        for which, p in trial.parameters.items():
            wanted = _numbers(equations.controlled_response, x, u, p)
            command = _numbers(equations.inverse, x, wanted, p)
            got = _numbers(equations.controlled_response, x, command, p)
            if not within(got - wanted, _INVERSE * (1 + float(np.abs(wanted).max()))):
                words = f"for the response {wanted} the inverse ({which} parameters) gives the input {command}"
                yield f"{words}, whose response is {got} {where}"
