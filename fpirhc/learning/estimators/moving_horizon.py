"""Moving-horizon estimation of parameters: least squares over the last W pairs and a prior for all earlier pairs.

    minimise  |z - z_a|^2_M + sum_{last W} |e_i(z)|^2      within bounds,

Theory: docs/theory-estimation.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np

from fpirhc.fields.kinds import whole
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
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.problem import Problem

MOST = 2000  # pairs in a window: the memory has a fixed size


@dataclass(frozen=True, eq=False)
class MovingHorizon(Learner):
    """Learn parameters from a window of pairs of command and response.

    Args:
        parameters: name -> Uncertain(lower, upper, deviation) of every learned parameter.
        noise: controlled coordinate -> deviation of the part of its response that the model lacks, in the response's unit.
        window: number W of pairs.
        time: time constant with which the prior forgets pairs that left the window, s; math.inf: it forgets none.
        iterations: Gauss-Newton steps per cycle.

    Raises:
        InvalidValue: no parameter.
    """

    window: Annotated[int, whole(1, MOST)]
    time: Memory
    iterations: Annotated[int, whole(1, 20)] = 1

    def memory(self, problem: Problem) -> Layout:
        size, names = len(self.parameters), self.learned()
        information = tuple(f"{i},{j}" for j in range(size) for i in range(size))
        row = _row_size(problem)
        window = tuple(f"{k}@{i}" for i in range(1, self.window + 1) for k in range(row))
        return Layout(
            (
                Signal("window_estimate", names),
                Signal("window_prior", names),
                Signal("window_information", information, start=tuple(np.eye(size).ravel())),
                Signal("window_pairs", window),
            )
        ).adapted()

    def step(self, problem: Problem) -> Correct:
        plant, size, row = problem.plant, len(self.parameters), _row_size(problem)
        residual = self.residual(plant)
        pair = _pair_function(problem, residual)
        newton, absorb = _newton_function(size), _absorb_function(size, forgetting_factor(self.time, problem.period))

        def correct(seen: Seen, memory: Mapping[str, Expression]) -> tuple[Expression, dict[str, Expression]]:
            z, parameters = memory["window_estimate"], seen.parameters
            newest = ca.vertcat(seen.valid, seen.state, seen.command, seen.response)
            oldest, rest = memory["window_pairs"][-row:], memory["window_pairs"][:-row]
            window = ca.vertcat(newest, rest)
            prior, information = absorb(
                memory["window_prior"], memory["window_information"], z, *pair(z, oldest, parameters), oldest[0]
            )
            lower, upper = bounds_of(problem, self.parameters, parameters)
            table, same = ca.reshape(window, row, self.window), ca.repmat(parameters, 1, self.window)
            for _ in range(self.iterations):
                squares, slopes = pair.map(self.window)(ca.repmat(z, 1, self.window), table, same)
                z = newton(z, prior, information, ca.sum2(squares), ca.sum2(slopes), lower, upper)
            next_memory = {
                "window_estimate": z,
                "window_prior": prior,
                "window_information": information,
                "window_pairs": window,
            }
            return deviations(self.parameters) * z, next_memory

        return correct


def _row_size(problem: Problem) -> int:
    plant = problem.plant
    return 1 + plant.state.size + plant.input.size + len(plant.controlled_names)


def _pair_function(problem: Problem, residual: ca.Function) -> ca.Function:
    """Function (z, pair, model's parameters) -> (H'H as a column, H'e), zero for a pair that is not valid."""
    plant = problem.plant
    z, row = ca.SX.sym("z", residual.size1_in(0)), ca.SX.sym("row", _row_size(problem))
    p = ca.SX.sym("p", plant.parameter.size)
    x_end, u_end = 1 + plant.state.size, 1 + plant.state.size + plant.input.size
    error, slope = residual(z, row[1:x_end], row[x_end:u_end], row[u_end:], p)
    valid = row[0] > 0.5
    # A choice and not a product: the model may be infinite at the zeros of an empty window.
    squares = ca.if_else(valid, ca.vec(slope.T @ slope), 0)
    slopes = ca.if_else(valid, slope.T @ error, 0)
    return ca.Function("fpirhc_pair", [z, row, p], [ca.densify(squares), ca.densify(slopes)])


def _newton_function(size: int) -> ca.Function:
    """Function (z, prior, information, sum H'H, sum H'e, lower, upper) -> z after one step within the bounds."""
    z, prior, lower, upper = (ca.SX.sym(n, size) for n in ("z", "prior", "lower", "upper"))
    information, squares = ca.SX.sym("information", size * size), ca.SX.sym("squares", size * size)
    slopes = ca.SX.sym("slopes", size)
    prior_matrix = ca.reshape(information, size, size)
    downhill = slopes - prior_matrix @ (z - prior)
    at_bound = ca.logic_or(ca.logic_and(z <= lower, downhill < 0), ca.logic_and(z >= upper, downhill > 0))
    free = ca.diag(1 - at_bound)
    matrix = free @ (prior_matrix + ca.reshape(squares, size, size)) @ free + ca.diag(at_bound)
    step = ca.solve(ca.densify(matrix), free @ downhill)
    z_next = between(z + step, lower, upper)
    return ca.Function("fpirhc_newton", [z, prior, information, squares, slopes, lower, upper], [ca.densify(z_next)])


def _absorb_function(size: int, factor: float) -> ca.Function:
    """Function (prior, information, z, H'H, H'e of the oldest pair, valid) -> (prior, information) with that pair."""
    prior, z, slopes = (ca.SX.sym(n, size) for n in ("prior", "z", "slopes"))
    information, squares, valid = (ca.SX.sym("i", size * size), ca.SX.sym("s", size * size), ca.SX.sym("valid"))
    square = ca.reshape(squares, size, size)
    joined = factor * ca.reshape(information, size, size) + (1 - factor) * ca.SX.eye(size) + square
    mean = prior + ca.solve(ca.densify(joined), slopes + square @ (z - prior))
    results = [ca.if_else(valid > 0.5, mean, prior), ca.if_else(valid > 0.5, ca.vec(joined), information)]
    return ca.Function("fpirhc_absorb", [prior, information, z, squares, slopes, valid], list(map(ca.densify, results)))


EXAMPLES = (MovingHorizon({"m": Uncertain(0.5, 3.0, 0.5)}, noise={"a": 0.1, "b": 0.1}, window=5, time=1.0),)
