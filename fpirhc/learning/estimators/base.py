"""The contract of estimators: a change of the model's parameters from commands and measurements.

At t_k an estimator receives the state, and the response just before t_k to the command held since t_{k-1}; both are older behind
dead time. It returns a change of
the parameters that it learns; the rest of the model stays as it is. A disturbance is a parameter too: see `disturbed`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Deviation, Range
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression, Layout
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Seen:
    """Data of an estimator in one cycle."""

    state: Expression  # the measured state at which the response was measured
    command: (
        Expression  # it caused `response` at `state`: the last one, or an older one behind dead time and estimators
    )
    response: Expression  # the measured response
    parameters: Expression  # those of the model without the estimator's change
    # 0 before the first pair of this run (in the first cycle, and until the first sample of the run arrives), then 1
    valid: Expression
    # the measured outputs y, y', ... at that instant; None without outputs, or where the estimator does not read them.
    output: Expression | None = None


Correct = Callable[[Seen, Mapping[str, Expression]], tuple[Expression, dict[str, Expression]]]


class ParameterEstimator(Checked, ABC):
    """Contract: a frozen value that becomes a step for a given problem."""

    def model(self, plant: Plant) -> Plant:
        """The model whose parameters are learned: the plant, or the plant with further parameters after its own."""
        return plant

    def reads_response(self, plant: Plant) -> bool:  # noqa: ARG002
        """Whether it learns from the measured response of this plant; True by default."""
        return True

    @property
    def acts_at_once(self) -> bool:
        """Whether what it learns changes the command in every cycle, also between plans; False by default."""
        return False

    def reads_outputs(self, plant: Plant) -> bool:  # noqa: ARG002
        """Whether it learns from the measured outputs of this plant below their responses; False by default."""
        return False

    @abstractmethod
    def learned(self) -> tuple[str, ...]:
        """Names of the parameters of the model that are learned."""

    @abstractmethod
    def check(self, problem: Problem) -> None:
        """Raise if the estimator cannot serve the problem, whose plant is the model."""

    @abstractmethod
    def memory(self, problem: Problem) -> Layout:
        """Signals that are remembered from cycle to cycle."""

    @abstractmethod
    def step(self, problem: Problem) -> Correct:
        """Function (seen, memory) -> (change of the learned parameters, memory one cycle later)."""


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


Memory: TypeAlias = Annotated[float, Range("a positive number of seconds, or math.inf", 0.0, open_low=True)]


@dataclass(frozen=True, eq=False)
class Learner(ParameterEstimator):
    """What learners of parameters share: the priors, and the noise of the responses."""

    parameters: Mapping[str, Uncertain]  # name -> Uncertain(lower, upper, deviation) of every learned parameter
    # controlled coordinate -> deviation of the part of its response that the model lacks, in the response's unit
    noise: Mapping[str, Deviation]

    def __post_init__(self) -> None:
        if not self.parameters:
            raise InvalidValue(f"{type(self).__name__}(parameters={{}}): name at least one parameter to learn")

    def learned(self) -> tuple[str, ...]:
        return tuple(self.parameters)

    def check(self, problem: Problem) -> None:
        """Raise if names do not fit the plant, an approximate value lies outside its bounds, or a parameter has no effect."""
        _check_names(type(self).__name__, problem.plant, self.parameters, self.noise)
        _check_effects(type(self).__name__, problem.plant, self.parameters)

    def residual(self, plant: Plant) -> ca.Function:
        """Return the Function of `residual_function` in units of the noise."""
        return residual_function(plant, self.parameters, [self.noise[c] for c in plant.controlled_names])


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


def _check_effects(owner: str, plant: Plant, parameters: Iterable[str]) -> None:
    x, u, p = plant.symbols()
    effects = ca.jacobian_sparsity(plant.equations.controlled_response(x, u, p), p)
    reaching = {plant.parameter.elements[k] for k in effects.get_triplet()[1]}
    mistakes = Mistakes(owner)
    for name in parameters:
        if name not in reaching:
            responses = " and ".join(f"'{c}'" for c in plant.controlled_names)
            mistakes.add(
                f"parameters: '{name}' does not enter the response of {responses}, which it is learned from; leave it out"
            )
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
    """Factor of a pair's weight from one cycle to the next, exp(-period / time).

    Raises:
        InvalidValue: a time below the period: a pair would be forgotten before the next one comes.
    """
    if time < period:
        raise InvalidValue(f"the time of forgetting is {time:g}, shorter than the control cycle of {period:g}")
    return math.exp(-period / time)
