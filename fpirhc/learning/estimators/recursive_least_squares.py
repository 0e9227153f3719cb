"""Recursive least squares on the response equation, with exponential forgetting and bounds.

    S = lambda I + H P H',    K = P H' S^-1,    z <- z + K e,    P <- (P - K H P) / lambda,    lambda = exp(-period / time),

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.kinds import Deviation, Range
from fpirhc.learning.estimators.base import Correct, ParameterEstimator, Seen, Uncertain
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression, Kind, Layout, Signal
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class RecursiveLeastSquares(ParameterEstimator):
    """Learn parameters from every pair of command and response.

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
        covariance = Signal("least_squares_covariance", entries, start=first, kinds=(Kind.ADAPTED,))
        return Layout((Signal("least_squares_estimate", self.learned()), covariance))

    def step(self, problem: Problem) -> Correct:
        plant, size = problem.plant, len(self.parameters)
        residual, factor = self._residual(plant), self._forgetting(problem.period)
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

    def _forgetting(self, period: float) -> float:
        """Factor of a pair's weight from one cycle to the next, exp(-period / time)."""
        if self.time < period:
            raise InvalidValue(f"the time of forgetting is {self.time:g}, shorter than the control cycle of {period:g}")
        return math.exp(-period / self.time)

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
