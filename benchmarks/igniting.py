"""Cold starts far from the optimum: unstable reactors that already ignite, with limits of inputs only.

    python benchmarks/igniting.py [--plans=100] [--write]     prints the table; --write puts it into docs/theory-optimisers.md

Every first state is planned for from nothing. Solved is a plan that the judge of `judging.py` finds converged: to 1e-6, and (in
brackets) to 1e-4. Counted are horizons that some optimiser solves; `finite` is how many have any plan at all among 135 simple ones
(constant, one switch, random) whose states stay finite. A solved plan that costs more than the best one by 1e-4 is in a worse
optimum. Interior is the iteration with limits by itself, FixedPoint what a solve does: the plain iteration, then that one.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
from constrained import WORSE, Answers, Solve, answered, cold_set, problem_of, tolerance_of
from foreign import Foreign, reactor
from optimisers import rival
from table import write_table

import fpirhc as fp
from fpirhc.horizon.problem import OptimalControl, rollout
from fpirhc.optimisers.limited import limited_step
from fpirhc.symbolic.native import native

MOST = 1000  # iterations of one call of interior steps
PAGE = Path(__file__).resolve().parents[1] / "docs" / "theory-optimisers.md"


def case(step: float, about: float, weights: fp.Quadratic) -> Foreign:
    """The reactor with limits of its input only, and first states up to `about` K from its set-point."""
    base = reactor()
    return replace(
        base,
        reference=fp.Trajectory(lambda t: {"C": 0.5 + 0 * t, "T": 350 + 0 * t}),
        horizon=fp.Horizon(stages=30, step=step),
        cost=weights,
        limits=fp.Limits(inputs={"Tc": (280.0, 320.0)}),
        spread={"T": about / 0.6, "C": 0.4},
    )


RATE = fp.Quadratic(states={"T": 1.0, "C": 10.0}, rate={"Tc": 0.1})
EFFORT = fp.Quadratic(states={"T": 1.0, "C": 10.0}, effort={"Tc": 1e-4})
CASES = {
    "1.5 min, 12 K": case(0.05, 12.0, RATE),
    "1.5 min, 35 K": case(0.05, 35.0, RATE),
    "3 min, 12 K": case(0.1, 12.0, RATE),
    "3 min, 35 K": case(0.1, 35.0, RATE),
    "3 min, 35 K, no rate": case(0.1, 35.0, EFFORT),
}


def rows_of(name: str, count: int) -> list[tuple[str, ...]]:
    """One row per optimiser."""
    ocp = problem_of(CASES[name])
    horizons = cold_set(CASES[name], ocp, count)
    fixed = fp.FixedPoint(iterations=1, tolerance=tolerance_of(ocp))
    limited = native(limited_step(ocp, fixed._limited(MOST))).function
    solvers = {"FixedPoint": whole(fixed, ocp), "interior": from_nothing(limited, ocp, np.zeros(limited.size1_in(4)))}
    if "--alone" not in sys.argv:
        solvers["IPOPT"] = rival(fp.Ipopt(accuracy=1e-9), ocp, {})
    answers_by_way = {way: answered(ocp, solve, horizons, cold=True) for way, solve in solvers.items()}
    best = np.min([np.where(a.solved, a.costs, np.inf) for a in answers_by_way.values()], axis=0)
    title = f"{name} ({sum(has_plan(ocp, *h) for h in horizons)} finite)"
    return [(title, way, *_row(answers, best)) for way, answers in answers_by_way.items()]


def whole(fixed: fp.FixedPoint, ocp: OptimalControl) -> Solve:
    """The plain iteration, and interior steps where it does not converge."""
    first, second = native(fixed.converging(ocp)).function, native(fixed.rescue(ocp)).function
    return from_nothing(lambda *a: second(*a, *first(*a)), ocp, np.asarray(fixed.memory(ocp).start()))


def from_nothing(step: Callable[..., Sequence[ca.DM]], ocp: OptimalControl, memory: np.ndarray) -> Solve:
    """One call without a plan to begin with."""

    def solve(s0: np.ndarray, data: np.ndarray, **_: bool) -> tuple[np.ndarray, float, np.ndarray]:
        begin = time.perf_counter()
        inputs, diagnostics, _memory = step(s0, data, ocp.input_lower, ocp.input_upper, memory)
        return np.asarray(inputs.full()), time.perf_counter() - begin, np.asarray(diagnostics.full()).ravel()

    return solve


def has_plan(ocp: OptimalControl, s0: np.ndarray, data: np.ndarray) -> bool:
    """Whether the states of a simple plan stay finite."""
    n, low, high = ocp.stages, ocp.input_lower[0], ocp.input_upper[0]
    stages, random = np.arange(n), np.random.default_rng(0)
    plans = [np.full(n, u) for u in np.linspace(low, high, 5)]
    plans += [np.where(stages < k, a, b) for k in range(1, n, 2) for a, b in ((low, high), (high, low))]
    plans += list(random.uniform(low, high, (100, n)))
    predict = rollout(ocp)
    return any(np.isfinite(predict(s0, plan[None, :], data)[0].full()).all() for plan in plans)


def _row(answers: Answers, best: np.ndarray) -> tuple[str, ...]:
    counted = np.isfinite(best)
    solved = answers.solved & counted
    worse = int((answers.costs[solved] > best[solved] + WORSE * np.abs(best[solved])).sum())
    false = int((answers.claimed & ~answers.solved).sum())
    its, microseconds = answers.iterations, 1e6 * np.median(answers.seconds)
    iterations = f"{np.median(its):.0f} / {its.max():.0f}" if np.isfinite(its).all() else ""
    shares = f"{solved.sum()} ({answers.roughly.sum()}) of {counted.sum()}"
    return shares, str(worse), str(false), f"{microseconds:.3g}", iterations


def main() -> None:
    """Run and print."""
    count = next((int(a.partition("=")[2]) for a in sys.argv if a.startswith("--plans=")), 100)
    rows = []
    for name in CASES:
        rows += rows_of(name, count)
        print(*(" | ".join(r) for r in rows[-3:]), sep="\n", flush=True)
    heads = ("horizon", "optimiser", "solved", "worse optimum", "called OK, not solved", "median us", "iterations")
    write_table("igniting", heads, rows, PAGE)


if __name__ == "__main__":
    main()
