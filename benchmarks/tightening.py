"""Limits of states with a wrong model: plans that keep a computed margin from them, in closed loop on other people's plants.

    python benchmarks/tightening.py [PLANT ...]     prints the table; --write puts it into docs/theory-robust.md

Receding-horizon control by converged SQP with the right model is the yardstick. The others have the same wrong model: the same
control, with adaptation by converged fixed point, and that with the margins of `fpirhc.tightened`. Violation: the largest one of
any limit of a state after the first second (or minute), when adaptation has found the plant, as share of half the limit's range.
Cost: the mean of the stage cost in that time.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
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
        input_before=case.before,
        period=loop.period,
        duration=loop.duration,
        measure_from=SETTLED,
        limits=case.limits,
        horizon=case.horizon,
        cost=case.cost,
    )


RIGHT, WRONG = "RHC, SQP, right model", "RHC, SQP"


def ways(problem: fp.Problem, gain: float) -> dict[str, tuple[fp.Problem, Controller]]:
    """Problem and controller by name."""
    adaptive = fp.RecedingHorizon(fp.FixedPoint(iterations=200, tolerance=1e-7), fp.Affine(gain))
    plain = fp.RecedingHorizon(fp.SequentialQuadratic(tolerance=1e-7))
    return {
        RIGHT: (right(problem), plain),
        WRONG: (problem, plain),
        "RHC+FPI": (problem, adaptive),
        "RHC+FPI, tightened": (problem, fp.tightened(problem, adaptive)),
    }


def right(problem: fp.Problem) -> fp.Problem:
    """The problem with a model whose parameters are those of the plant."""
    exact = {k: replace(p, approximate=p.exact) for k, p in problem.plant.parameters.items()}
    return replace(problem, plant=replace(problem.plant, parameters=exact))


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
            pairs = ways(problem, LOOPS[name].gain)
        except fp.FpirhcError as error:
            print(f"{name}: {error}")
            continue
        runs = {label: fp.simulate(p, c, seed=0) for label, (p, c) in pairs.items()}
        best = [mean_cost(runs[label]) for label in (WRONG, RIGHT)]
        for label, run in runs.items():
            costs = ("stopped",) * 2 if run.stop else (f"{mean_cost(run) / b:.3g}" for b in best)
            rows.append([name, label, f"{violation(problem, run):.1e}", *costs])
            print(rows[-1], flush=True)
    heads = ["plant", "controller", "largest violation", f"cost / {WRONG}", f"cost / {RIGHT}"]
    write_table("tightening", heads, rows, PAGE)


if __name__ == "__main__":
    main()
