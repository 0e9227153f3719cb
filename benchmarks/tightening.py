"""Limits of states with a wrong model: plans that keep a computed margin from them, in closed loop on other people's plants.

    python benchmarks/tightening.py [PLANT ...]     prints the table; --write puts it into docs/theory-robust.md

Three controllers with the same wrong model: receding-horizon control by converged SQP, the same with adaptation by converged fixed
point, and that with the margins of `fpirhc.tightened`. Violation: the largest one of any limit of a state after the first second
(or minute), when adaptation has found the plant, as share of half the limit's range. Cost: the mean of the stage cost in that time.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from foreign import FOREIGN, Foreign
from table import write_table

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.simulation.run import Run

PAGE = Path(__file__).resolve().parents[1] / "docs" / "theory-robust.md"
SETTLED = 1.0  # in the problem's unit of time


@dataclass(frozen=True)
class Loop:
    """Control period, duration, and gain of the affine map."""

    period: float
    duration: float
    gain: float


LOOPS = {
    "quadrotor": Loop(0.01, 8.0, -1.0),
    "arm": Loop(0.01, 6.0, -1.0),
    "reactor": Loop(0.01, 8.0, -1.0),
    "tanks": Loop(0.02, 8.0, -1.0),
    "body": Loop(0.02, 8.0, -1.0),
}


def problem_of(case: Foreign, loop: Loop) -> fp.Problem:
    """The closed loop's problem."""
    return fp.Problem(
        plant=case.plant,
        reference=case.reference,
        start={**dict.fromkeys(case.plant.names, 0.0), **case.start},
        period=loop.period,
        duration=loop.duration,
        measure_from=SETTLED,
        limits=case.limits,
        horizon=case.horizon,
        cost=case.cost,
    )


def controllers(problem: fp.Problem, gain: float) -> dict[str, Controller]:
    """The three controllers."""
    fixed = fp.FixedPoint(iterations=200, tolerance=1e-7)
    adaptive = fp.RecedingHorizon(fixed, fp.Affine(gain))
    return {
        "RHC, SQP": fp.RecedingHorizon(fp.SequentialQuadratic(tolerance=1e-7)),
        "RHC+FPI": adaptive,
        "RHC+FPI, tightened": fp.tightened(problem, adaptive),
    }


def violation(problem: fp.Problem, run: Run) -> float:
    """The largest violation after SETTLED, relative to half the range."""
    lower, upper = problem.limits.state_bounds(problem.plant)
    half = 0.5 * (upper - lower)
    states = run["state"][round(SETTLED / run.period) :]
    beyond = np.maximum(states - upper, lower - states) / np.where(np.isfinite(half), half, 1.0)
    return max(float(beyond.max()), 0.0)


def mean_cost(run: Run) -> float:
    """The mean of the stage cost after SETTLED."""
    return float(run["cost"].sum(axis=1)[round(SETTLED / run.period) :].mean())


def main() -> None:
    """Run and print."""
    names = [a for a in sys.argv[1:] if not a.startswith("--")] or list(LOOPS)
    rows = []
    for name in names:
        problem = problem_of(FOREIGN[name](), LOOPS[name])
        try:
            ways = controllers(problem, LOOPS[name].gain)
        except fp.FpirhcError as error:
            print(f"{name}: {error}")
            continue
        runs = {label: fp.simulate(problem, c, seed=0) for label, c in ways.items()}
        best = mean_cost(runs["RHC, SQP"])
        for label, run in runs.items():
            cost = "stopped" if run.stop else f"{mean_cost(run) / best:.3f}"
            rows.append([name, label, f"{violation(problem, run):.1e}", cost])
            print(rows[-1], flush=True)
    write_table("tightening", ["plant", "controller", "largest violation", "cost / RHC, SQP"], rows, PAGE)


if __name__ == "__main__":
    main()
