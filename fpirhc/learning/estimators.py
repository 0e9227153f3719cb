"""The contract of estimators, a change of the model's parameters from commands and measurements, and recursive least squares.

At t_k an estimator receives the state, and the response just before t_k to the command held since t_{k-1}; both are older behind
dead time. It returns a change of the parameters that it learns. A disturbance is a parameter too: see `disturbed`.
Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Deviation, Range
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression, Layout, Signal
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


@dataclass(frozen=True, eq=False)
class RecursiveLeastSquares(ParameterEstimator):
    """Learn parameters from every pair of command and response, with exponential forgetting and bounds.

        S = lambda I + H P H',    K = P H' S^-1,    z <- z + K e,    P <- (P - K H P) / lambda,    lambda = exp(-period / time)

    Args:
        parameters: name -> Uncertain(lower, upper, deviation) of every learned parameter.
        noise: controlled coordinate -> deviation of the part of its response that the model lacks, in the response's unit.
        time: time constant of forgetting, s; math.inf: no pair is forgotten.

    Raises:
        InvalidValue: no parameter.
    """

    parameters: Mapping[str, Uncertain]
    noise: Mapping[str, Deviation]
    time: Annotated[float, Range("a positive number of seconds, or math.inf", lambda v: v > 0)]

    def __post_init__(self) -> None:
        if not self.parameters:
            raise InvalidValue("RecursiveLeastSquares(parameters={}): name at least one parameter to learn")

    def learned(self) -> tuple[str, ...]:
        return tuple(self.parameters)

    def check(self, problem: Problem) -> None:
        """Raise if names do not fit the plant, an approximate value lies outside its bounds, or a parameter has no effect."""
        plant, mistakes = problem.plant, Mistakes("RecursiveLeastSquares")
        mistakes.unknown("parameters:", self.parameters, plant.parameters)
        for name, prior in self.parameters.items():
            parameter = plant.parameters.get(name)
            if parameter is not None and not prior.lower <= parameter.approximate <= prior.upper:
                mistakes.add(
                    f"parameters: '{name}' is {parameter.approximate:g} in the model, outside [{prior.lower:g}, {prior.upper:g}]; "
                    "widen its bounds or correct the approximate value"
                )
        mistakes.unknown("noise: controlled coordinate", self.noise, plant.controlled_names)
        for name in plant.controlled_names:
            if name not in self.noise:
                mistakes.add(f"noise: the response of '{name}' has no deviation; add '{name}': ...")
        mistakes.raise_if_any()
        x, u, p = plant.symbols()
        effects = ca.jacobian_sparsity(plant.equations.controlled_response(x, u, p), p)
        reaching = {plant.parameter.elements[k] for k in effects.get_triplet()[1]}
        for name in (n for n in self.parameters if n not in reaching):
            responses = " and ".join(f"'{c}'" for c in plant.controlled_names)
            mistakes.add(
                f"parameters: '{name}' does not enter the response of {responses}, which it is learned from; leave it out"
            )
        mistakes.raise_if_any()

    def memory(self, problem: Problem) -> Layout:  # noqa: ARG002
        size = len(self.parameters)
        entries = tuple(f"{i},{j}" for j in range(size) for i in range(size))
        first = tuple(np.eye(size).ravel())
        covariance = Signal("least_squares_covariance", entries, start=first)
        return Layout((Signal("least_squares_estimate", self.learned()), covariance))

    def step(self, problem: Problem) -> Correct:
        plant, size = problem.plant, len(self.parameters)
        if self.time < problem.period:
            raise InvalidValue(f"the time of forgetting {self.time:g} is below the control cycle of {problem.period:g}")
        residual, factor = self._residual(plant), math.exp(-problem.period / self.time)
        places = [plant.parameter.elements.index(name) for name in self.parameters]
        lower, upper, deviation = (
            ca.DM([getattr(prior, name) for prior in self.parameters.values()])
            for name in ("lower", "upper", "deviation")
        )

        def correct(seen: Seen, memory: Mapping[str, Expression]) -> tuple[Expression, dict[str, Expression]]:
            z, p = memory["least_squares_estimate"], ca.reshape(memory["least_squares_covariance"], size, size)
            error, slope = residual(z, seen.state, seen.command, seen.response, seen.parameters)
            error, slope = seen.valid * error, seen.valid * slope
            innovation = factor * ca.DM.eye(error.numel()) + slope @ p @ slope.T
            gain = ca.solve(innovation, slope @ p).T
            least, most = ((end - seen.parameters[places]) / deviation for end in (lower, upper))
            free = z + gain @ error
            # NaN stays NaN, which fmin and fmax would turn into a bound.
            estimate = ca.if_else(free < least, least, ca.if_else(free > most, most, free))
            covariance = (p - gain @ slope @ p) / factor
            covariance = (covariance + covariance.T) / 2 * ca.fmin(1, size / ca.trace(covariance))
            next_memory = {"least_squares_estimate": estimate, "least_squares_covariance": ca.vec(covariance)}
            return deviation * estimate, next_memory

        return correct

    def _residual(self, plant: Plant) -> ca.Function:
        """Function (z, state, input, response, model's parameters) -> (e, H) of one pair, in units of the noise."""
        x, u, p = plant.symbols()
        z, f = ca.SX.sym("z", len(self.parameters)), ca.SX.sym("f", len(plant.controlled_names))
        believed = ca.SX(p)
        for k, (name, prior) in enumerate(self.parameters.items()):
            believed[plant.parameter.elements.index(name)] += prior.deviation * z[k]
        noise = ca.DM([self.noise[c] for c in plant.controlled_names])
        error = (f - plant.equations.controlled_response(x, u, believed)) / noise
        return ca.Function("fpirhc_residual", [z, x, u, f, p], [ca.densify(error), ca.densify(-ca.jacobian(error, z))])


EXAMPLES = (RecursiveLeastSquares({"m": Uncertain(0.5, 3.0, 0.5)}, noise={"a": 0.1, "b": 0.1}, time=1.0),)
