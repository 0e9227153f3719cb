"""What is known beforehand of a parameter that is to be learned, and the response equation around the estimate.

With z_i = (p_i - p_i given) / deviation_i, so that all unknowns are of the order of one, and residuals divided by the
deviation of their noise, every learner here minimises a sum of |e - H dz|^2 with

    e = (f - f^(x, u, p)) / sigma,      H = (1 / sigma) df^/dp diag(deviation).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression
from fpirhc.task.problem import Problem


@dataclass(frozen=True)
class Uncertain:
    """A parameter to be learned.

    Parameters:
        lower, upper: what it cannot be below and above (physics: a mass is positive), in its own unit.
        deviation: how far from the approximate value it may well be, in its own unit.

    Raises:
        InvalidValue: bounds or a deviation that are not finite, swapped, or not positive.
    """

    lower: float
    upper: float
    deviation: float

    def __post_init__(self) -> None:
        if not -math.inf < self.lower < self.upper < math.inf:
            raise InvalidValue(f"Uncertain(lower={self.lower!r}, upper={self.upper!r}): expected finite lower < upper")
        if not 0 < self.deviation < math.inf:
            raise InvalidValue(f"Uncertain(deviation={self.deviation!r}): expected a positive number")


def require_positive(owner: str, values: Mapping[str, float]) -> None:
    """Check that every value is a finite positive number.

    Raises:
        InvalidValue: naming every value that is not.
    """
    wrong = [f"{n}={v!r}" for n, v in values.items() if not (isinstance(v, int | float) and 0 < v < math.inf)]
    if wrong:
        raise InvalidValue(f"{owner}({', '.join(wrong)}): expected finite positive numbers")


def check_learner(owner: str, plant: Plant, parameters: Mapping[str, Uncertain], noise: Mapping[str, float]) -> None:
    """Raise if names do not fit the plant, or an approximate value lies outside its bounds.

    Raises:
        InvalidProblem: all mistakes together.
    """
    mistakes = Mistakes(owner)
    mistakes.unknown("parameters:", parameters, plant.parameters)
    for name, known in parameters.items():
        given = plant.parameters.get(name)
        if given is not None and not known.lower <= given.approximate <= known.upper:
            mistakes.add(
                f"parameters: '{name}' is {given.approximate:g} in the model, outside [{known.lower:g}, {known.upper:g}]; "
                "widen its bounds or correct the approximate value"
            )
    mistakes.unknown("noise: controlled coordinate", noise, plant.controlled_names)
    for name in plant.controlled_names:
        if name not in noise:
            mistakes.add(f"noise: the response of '{name}' has no deviation; add '{name}': ...")
    mistakes.raise_if_any()


def residual_function(plant: Plant, parameters: Mapping[str, Uncertain], noise: Sequence[float]) -> ca.Function:
    """Return Function (z, state, input, response, given parameters) -> (e, H) of one pair."""
    x, u, p = plant._symbols()
    z, f = ca.SX.sym("z", len(parameters)), ca.SX.sym("f", len(plant.controlled_names))
    believed = ca.SX(p)
    for k, name in enumerate(parameters):
        believed[plant.parameter.elements.index(name)] += parameters[name].deviation * z[k]
    error = (f - plant.controlled_response_function(x, u, believed)) / ca.DM(list(noise))
    return ca.Function("fpirhc_residual", [z, x, u, f, p], [ca.densify(error), ca.densify(-ca.jacobian(error, z))])


def bounds_of(
    problem: Problem, parameters: Mapping[str, Uncertain], given: Expression
) -> tuple[Expression, Expression]:
    """Lower and upper bounds of z for the given parameters."""
    places = [problem.plant.parameter.elements.index(name) for name in parameters]
    deviation = deviations(parameters)
    lower = (ca.DM([known.lower for known in parameters.values()]) - given[places]) / deviation
    upper = (ca.DM([known.upper for known in parameters.values()]) - given[places]) / deviation
    return lower, upper


def between(value: Expression, lower: Expression, upper: Expression) -> Expression:
    """The value within its bounds; NaN stays NaN, which fmin and fmax would turn into a bound."""
    return ca.if_else(value < lower, lower, ca.if_else(value > upper, upper, value))


def deviations(parameters: Mapping[str, Uncertain]) -> ca.DM:
    """Deviations of the learned parameters, a column."""
    return ca.DM(np.array([known.deviation for known in parameters.values()]))


def forgetting_factor(time: float, period: float) -> float:
    """Weight that a pair keeps from one cycle to the next, exp(-period / time)."""
    return math.exp(-period / time)
