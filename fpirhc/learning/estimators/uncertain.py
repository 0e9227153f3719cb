"""Prior of a learned parameter, and the response equation around the estimate.

With z_i = (p_i - p_i,0) / deviation_i, p_i,0 the model's value, all unknowns are of the order of one. Every estimator here
minimises a sum of |e - H dz|^2 with residuals in units of their noise,

    e = (f - f^(x, u, p)) / sigma,      H = (1 / sigma) df^/dp diag(deviation).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Deviation
from fpirhc.learning.estimators.base import ParameterEstimator
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression
from fpirhc.task.problem import Problem


@dataclass(frozen=True)
class Uncertain(Checked):
    """Prior of a learned parameter.

    Args:
        lower: least possible value (of a mass: above zero), in its unit.
        upper: largest possible value, in its unit.
        deviation: usual distance from the approximate value, in its unit.

    Raises:
        InvalidValue: bounds that are not finite, or swapped.
    """

    lower: float
    upper: float
    deviation: Deviation

    def __post_init__(self) -> None:
        if not -math.inf < self.lower < self.upper < math.inf:
            raise InvalidValue(f"Uncertain(lower={self.lower!r}, upper={self.upper!r}): expected finite lower < upper")


@dataclass(frozen=True, eq=False)
class Learner(ParameterEstimator):
    """What learners of parameters share: the priors, and the noise of the responses.

    Args:
        parameters: name -> Uncertain(lower, upper, deviation) of every learned parameter.
        noise: controlled coordinate -> deviation of the part of its response that the model lacks, in the response's unit.
    """

    parameters: Mapping[str, Uncertain]
    noise: Mapping[str, Deviation]

    def learned(self) -> tuple[str, ...]:
        """The named parameters."""
        return tuple(self.parameters)

    def check(self, problem: Problem) -> None:
        """Raise if names do not fit the plant, or an approximate value lies outside its bounds.

        Raises:
            InvalidProblem: all mistakes together.
        """
        _check_names(type(self).__name__, problem.plant, self.parameters, self.noise)

    def residual(self, plant: Plant) -> ca.Function:
        """Return the Function of `residual_function` in units of the noise."""
        return residual_function(plant, self.parameters, [self.noise[c] for c in plant.controlled_names])

    def _require(self, time: float) -> None:
        """Raise unless there is a parameter to learn, and the time constant is positive."""
        owner = type(self).__name__
        if not self.parameters:
            raise InvalidValue(f"{owner}(parameters={{}}): name at least one parameter to learn")
        if not time > 0:
            raise InvalidValue(f"{owner}(time={time!r}): expected a positive number of seconds, or math.inf")


def _check_names(owner: str, plant: Plant, parameters: Mapping[str, Uncertain], noise: Mapping[str, float]) -> None:
    mistakes = Mistakes(owner)
    mistakes.unknown("parameters:", parameters, plant.parameters)
    for name, prior in parameters.items():
        parameter = plant.parameters.get(name)
        if parameter is not None and not prior.lower <= parameter.approximate <= prior.upper:
            mistakes.add(
                f"parameters: '{name}' is {parameter.approximate:g} in the model, outside [{prior.lower:g}, {prior.upper:g}]; "
                "widen its bounds or correct the approximate value"
            )
    mistakes.unknown("noise: controlled coordinate", noise, plant.controlled_names)
    for name in plant.controlled_names:
        if name not in noise:
            mistakes.add(f"noise: the response of '{name}' has no deviation; add '{name}': ...")
    mistakes.raise_if_any()


def residual_function(plant: Plant, parameters: Mapping[str, Uncertain], noise: Sequence[float]) -> ca.Function:
    """Return Function (z, state, input, response, model's parameters) -> (e, H) of one pair."""
    x, u, p = plant.symbols()
    z, f = ca.SX.sym("z", len(parameters)), ca.SX.sym("f", len(plant.controlled_names))
    believed = ca.SX(p)
    for k, name in enumerate(parameters):
        believed[plant.parameter.elements.index(name)] += parameters[name].deviation * z[k]
    error = (f - plant.equations.controlled_response(x, u, believed)) / ca.DM(list(noise))
    return ca.Function("fpirhc_residual", [z, x, u, f, p], [ca.densify(error), ca.densify(-ca.jacobian(error, z))])


def bounds_of(
    problem: Problem, parameters: Mapping[str, Uncertain], values: Expression
) -> tuple[Expression, Expression]:
    """Lower and upper bounds of z around the model's `values` of all parameters."""
    places = [problem.plant.parameter.elements.index(name) for name in parameters]
    deviation = deviations(parameters)
    lower = (ca.DM([prior.lower for prior in parameters.values()]) - values[places]) / deviation
    upper = (ca.DM([prior.upper for prior in parameters.values()]) - values[places]) / deviation
    return lower, upper


def between(value: Expression, lower: Expression, upper: Expression) -> Expression:
    """The value clipped to its bounds; NaN stays NaN, which fmin and fmax would turn into a bound."""
    return ca.if_else(value < lower, lower, ca.if_else(value > upper, upper, value))


def deviations(parameters: Mapping[str, Uncertain]) -> ca.DM:
    """Column of the deviations of the learned parameters."""
    return ca.DM(np.array([prior.deviation for prior in parameters.values()]))


def forgetting_factor(time: float, period: float) -> float:
    """Factor of a pair's weight from one cycle to the next, exp(-period / time)."""
    return math.exp(-period / time)
