"""Recursive least squares on the response equation, with exponential forgetting and bounds.

    S = lambda I + H P H',    K = P H' S^-1,    z <- z + K e,    P <- (P - K H P) / lambda,    lambda = exp(-period / time),

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.learning.estimators.base import (
    Correct,
    Learner,
    Memory,
    Seen,
    Uncertain,
    between,
    bounds_of,
    deviations,
    forgetting_factor,
)
from fpirhc.symbolic.layout import Expression, Kind, Layout, Signal
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class RecursiveLeastSquares(Learner):
    """Learn parameters from every pair of command and response.

    Args:
        parameters: name -> Uncertain(lower, upper, deviation) of every learned parameter.
        noise: controlled coordinate -> deviation of the part of its response that the model lacks, in the response's unit.
        time: time constant of forgetting, s; math.inf: no pair is forgotten.

    Raises:
        InvalidValue: no parameter.
    """

    time: Memory

    def memory(self, problem: Problem) -> Layout:  # noqa: ARG002
        size = len(self.parameters)
        return Layout((_estimate(self.learned()), _covariance(size)))

    def step(self, problem: Problem) -> Correct:
        plant, size = problem.plant, len(self.parameters)
        residual = self.residual(plant)
        factor = forgetting_factor(self.time, problem.period)

        def correct(seen: Seen, memory: Mapping[str, Expression]) -> tuple[Expression, dict[str, Expression]]:
            z, p = memory["least_squares_estimate"], ca.reshape(memory["least_squares_covariance"], size, size)
            error, slope = residual(z, seen.state, seen.command, seen.response, seen.parameters)
            error, slope = seen.valid * error, seen.valid * slope
            innovation = factor * ca.DM.eye(error.numel()) + slope @ p @ slope.T
            gain = ca.solve(innovation, slope @ p).T
            lower, upper = bounds_of(problem, self.parameters, seen.parameters)
            estimate = between(z + gain @ error, lower, upper)
            covariance = (p - gain @ slope @ p) / factor
            covariance = (covariance + covariance.T) / 2 * ca.fmin(1, size / ca.trace(covariance))
            next_memory = {"least_squares_estimate": estimate, "least_squares_covariance": ca.vec(covariance)}
            return deviations(self.parameters) * estimate, next_memory

        return correct


def _estimate(names: tuple[str, ...]) -> Signal:
    return Signal("least_squares_estimate", names)


def _covariance(size: int) -> Signal:
    entries = tuple(f"{i},{j}" for j in range(size) for i in range(size))
    return Signal("least_squares_covariance", entries, start=tuple(np.eye(size).ravel()), kinds=(Kind.ADAPTED,))


EXAMPLES = (RecursiveLeastSquares({"m": Uncertain(0.5, 3.0, 0.5)}, noise={"a": 0.1, "b": 0.1}, time=1.0),)
