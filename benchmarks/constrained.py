"""Optimisers on horizons of other people's plants with active limits of states: who solves them, how exactly, how fast.

Called by `python benchmarks/optimisers.py --constrained [PLANT ...] [--plans=200] [--acados] [--write]`; with --acados beside
acados alone, which is installed as `beside_acados.py` says. Warm: a closed loop is recorded, the plant with its exact parameters
and a little noise, planned for with the approximate ones; every optimiser solves its horizons one after the other, warm-started
with its own last plan shifted by one stage. Cold: horizons from random first states, each from
nothing. All plans are judged by the one judge of `judging.py`: solved is a plan with a residual of 1e-6 and a violation of 1e-6 of
the range at most; counted are horizons that some optimiser solved. An optimiser whose solved plan costs more than the best one by
1e-4 or more has ended in a worse local optimum.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from acados_plans import acados_plans, again_with_acados
from deadline import Solve, WithDeadline
from foreign import FOREIGN, Foreign, first_states
from judging import Judge, Judgement
from table import write_table

import fpirhc as fp
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.symbolic.native import native

SOLVED, ROUGHLY, ACADOS = 1e-6, 1e-4, "--acados"
WORSE = 1e-4  # IPOPT relaxes limits by 1e-8, which alone is worth up to 1e-5 of a cost
NOISE = 1e-3  # of the limits' half ranges
DEADLINE = 2.0  # s; fatrop alone does not return from some horizons


@dataclass(frozen=True)
class Answers:
    """What one optimiser made of a set: judgements, seconds, iterations (NaN where it does not tell), and plans called OK."""

    judged: list[Judgement]
    seconds: np.ndarray
    iterations: np.ndarray
    claimed: np.ndarray

    @property
    def solved(self) -> np.ndarray:
        """Which horizons are solved."""
        return np.array([j.residual <= SOLVED and j.violation <= SOLVED for j in self.judged])

    @property
    def roughly(self) -> np.ndarray:
        """Which are solved to 1e-4."""
        return np.array([j.rough <= ROUGHLY and j.violation <= ROUGHLY for j in self.judged])

    @property
    def costs(self) -> np.ndarray:
        """The costs."""
        return np.array([j.cost for j in self.judged])


def problem_of(case: Foreign) -> OptimalControl:
    """The horizon in standard form."""
    return transcribe(case.plant, case.reference, case.horizon, case.cost, case.limits)


def tolerance_of(ocp: OptimalControl) -> float:
    """A tenth of what counts as solved, in the unit of the inputs."""
    return 0.1 * SOLVED * float((0.5 * (ocp.input_upper - ocp.input_lower)).min())


def warm_set(case: Foreign, ocp: OptimalControl, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """First states and data along a loop in which the first input of a converged plan is applied."""
    from optimisers import follow

    optimiser = fp.FixedPoint(iterations=1, tolerance=tolerance_of(ocp))
    solve = follow(optimiser, ocp, native(optimiser.converging(ocp)).function)
    data_of = stage_data(case.plant, case.reference, case.horizon, case.cost)
    advance = fp.RungeKutta4(4).step(case.plant, case.horizon.step)
    random, x = np.random.default_rng(0), np.array([case.start.get(e, 0.0) for e in case.plant.state.elements])
    unit = _noise_unit(case)
    s0, horizons = case.first(ocp, x), []
    for k in range(count):
        data = np.asarray(data_of(k * case.horizon.step, case.plant.approximate).full())
        horizons.append((s0, data))
        u = solve(s0, data)[0][:, 0]
        x = np.asarray(advance(x, u, case.plant.exact, np.zeros(len(case.plant.names))).full()).ravel()
        x += NOISE * unit * random.standard_normal(x.size)
        s0 = np.asarray(ocp.start(x, u).full()).ravel()
    return horizons


def _noise_unit(case: Foreign) -> np.ndarray:
    lower, upper = case.limits.state_bounds(case.plant)
    half = 0.5 * (upper - lower)
    return np.where(np.isfinite(half), half, 0.1)


def cold_set(case: Foreign, ocp: OptimalControl, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Random first states at t = 0."""
    data = stage_data(case.plant, case.reference, case.horizon, case.cost)(0.0, case.plant.approximate)
    values = np.asarray(data.full())
    return [(case.first(ocp, x), values) for x in first_states(case, count, 1).T]


def answered(
    ocp: OptimalControl, solve: Solve, horizons: list[tuple[np.ndarray, np.ndarray]], *, cold: bool
) -> Answers:
    """Let one optimiser solve a set."""
    judge, rows = Judge(ocp), []
    for s0, data in horizons:
        inputs, seconds, diagnostics = solve(s0, data, cold=cold)
        inputs = np.clip(inputs, ocp.input_lower[:, None], ocp.input_upper[:, None])
        rows.append((judge(inputs, s0, data), seconds, diagnostics[3], diagnostics[4] == 0))
    judged, seconds, iterations, claimed = zip(*rows, strict=True)
    return Answers(list(judged), np.array(seconds), np.array(iterations), np.array(claimed))


def ways(ocp: OptimalControl) -> dict[str, Callable[[], Solve]]:
    """Every optimiser; built when it is its turn."""
    from optimisers import JIT, follow, rival

    fixed, accuracy = fp.FixedPoint(iterations=1, tolerance=tolerance_of(ocp)), 1e-9
    shape = ocp.input.size, ocp.stages
    own = {"FixedPoint": lambda: follow(fixed, ocp, native(fixed.converging(ocp)).function)}
    if ACADOS in sys.argv:
        plain = replace(fixed, hessian=fp.GaussNewton())
        return {
            **own,
            "the same, Gauss-Newton": lambda: follow(plain, ocp, native(plain.converging(ocp)).function),
            "acados, SQP with HPIPM": lambda: acados_plans(ocp, exact=False, accuracy=1e-6),
            "acados, exact Hessian": lambda: acados_plans(ocp, exact=True, accuracy=1e-6),
        }
    return {
        **own,
        "IPOPT": lambda: rival(fp.Ipopt(accuracy=accuracy), ocp, {}),
        "fatrop, functions compiled": lambda: WithDeadline(
            rival(fp.Fatrop(accuracy=accuracy), ocp, JIT), shape, DEADLINE
        ),
        "SQP (Gauss-Newton) with qrqp": lambda: rival(fp.SequentialQuadratic(), ocp, {}),
    }


def rows_of(name: str, count: int) -> list[tuple[str, ...]]:
    """One row per set and optimiser."""
    case, rows = FOREIGN[name](), []
    ocp = problem_of(case)
    title = f"{name} (N = {ocp.stages}, {ocp.state.size} states)"
    for cold in (False, True):
        horizons = (cold_set if cold else warm_set)(case, ocp, count)
        answers_by_way = {way: answered(ocp, build(), horizons, cold=cold) for way, build in ways(ocp).items()}
        costs = np.array([np.where(a.solved, a.costs, np.inf) for a in answers_by_way.values()])
        best = costs.min(axis=0)
        counted = np.isfinite(best)
        for way, answers in answers_by_way.items():
            rows.append((title, "cold" if cold else "warm", way, *_row(answers, best, counted)))
            print(" | ".join(rows[-1]), flush=True)
    return rows


def _row(answers: Answers, best: np.ndarray, counted: np.ndarray) -> tuple[str, ...]:
    solved = answers.solved & counted
    worse = int((answers.costs[solved] > best[solved] + WORSE * np.abs(best[solved])).sum())
    violations = [j.violation for j, c in zip(answers.judged, answers.claimed, strict=True) if c]
    its = answers.iterations
    return (
        f"{solved.sum()} of {counted.sum()}",
        str((answers.roughly & counted).sum()),
        str(worse),
        f"{max(violations):.0e}" if violations else "",
        f"{1e6 * np.median(answers.seconds):.3g}",
        f"{1e6 * np.quantile(answers.seconds, 0.95):.3g}",
        f"{np.median(its):.0f} / {its.max():.0f}" if np.isfinite(its).all() else "",
    )


def main() -> None:
    """Measure the plants named on the command line, or all."""
    beside_acados = ACADOS in sys.argv
    if beside_acados:
        again_with_acados()
    names = [a for a in sys.argv[1:] if not a.startswith("--")] or (
        ["arm", "chain"] if beside_acados else list(FOREIGN)
    )
    count = next((int(a.partition("=")[2]) for a in sys.argv if a.startswith("--plans=")), 200)
    heads = (
        *("plant", "set", "optimiser", "solved", "to 1e-4", "in a worse optimum", "worst violation called OK"),
        *("median us", "p95 us", "iterations, median / most"),
    )
    write_table(
        "limits beside acados" if beside_acados else "constrained",
        heads,
        [row for name in names for row in rows_of(name, count)],
    )
