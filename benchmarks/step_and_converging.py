"""What a loop runs beside what a single solve runs, on the same horizons with limits of states.

    python benchmarks/step_and_converging.py [--plans=100] [--write]        --write puts the table into docs/performance.md

A loop is recorded, the plant with its exact parameters and a little noise, planned for with the wrong ones. `converging`, which
`fp.solve` calls, and `step`, which a loop calls, then solve its horizons one after the other, each with its own memory. Good is a
plan with a residual and a violation of 1e-4 of half the range at most (`judging.py`) that costs at most 1e-4 more than the best of
these of the two and of IPOPT; counted are horizons that have one. Times are processor times, the shortest of three calls with the
same arguments.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from constrained import problem_of, warm_set
from foreign import quadrotor
from ipopt_plans import IpoptPlans
from judging import Judge
from limited_loop import OwnPlans, Planner
from loop_comparison import CONVERGED, COST
from loops_of_machines import cart_pole_on_a_rail
from loops_of_vehicles import bicycle_past_a_gap
from state_limited_loops import optimiser_of
from table import write_table

from fpirhc.horizon.problem import OptimalControl

CASES = {
    "quadrotor, tilt and speeds limited": quadrotor,
    "bicycle past a gap": bicycle_past_a_gap,
    "cart-pole on a short rail": cart_pole_on_a_rail,
}

Horizons = list[tuple[np.ndarray, np.ndarray]]


def answered(ocp: OptimalControl, planner: Planner, horizons: Horizons) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Costs of the stationary plans inside the limits (infinite for the others), microseconds and iterations."""
    judge, costs, plans = Judge(ocp), [], [planner(s0, data) for s0, data in horizons]
    for plan, (s0, data) in zip(plans, horizons, strict=True):
        judged = judge(plan.inputs, s0, data)
        costs.append(judged.cost if max(judged.rough, judged.violation) <= CONVERGED else np.inf)
    return np.array(costs), np.array([p.microseconds for p in plans]), np.array([p.iterations for p in plans])


def rows_of(title: str, count: int) -> list[tuple[str, ...]]:
    """One row per way."""
    case = CASES[title]()
    ocp = problem_of(case)
    optimiser, horizons = optimiser_of(ocp), warm_set(case, ocp, count)
    ways = {
        "converging": OwnPlans(optimiser, ocp, optimiser.converging(ocp)),
        "step": OwnPlans(optimiser, ocp, optimiser.step(ocp)),
        "IPOPT": IpoptPlans(ocp),
    }
    found = {way: answered(ocp, planner, horizons) for way, planner in ways.items()}
    best = np.min([costs for costs, _, _ in found.values()], axis=0)
    title = f"{title} (N = {ocp.stages}, {ocp.state.size} states)"
    return [(title, way, *_cells(*results, best)) for way, results in found.items()]


def _cells(costs: np.ndarray, times: np.ndarray, iterations: np.ndarray, best: np.ndarray) -> tuple[str, ...]:
    there = np.isfinite(best)
    good = costs[there] <= best[there] + COST * np.abs(best[there])
    return (
        f"{good.sum()} of {there.sum()}",
        " / ".join(f"{v:.0f}" for v in np.quantile(times, (0.5, 0.95, 1.0))),
        f"{np.median(iterations):.0f} / {iterations.max():.0f}",
    )


def main() -> None:
    """Measure the three problems."""
    count = next((int(a.partition("=")[2]) for a in sys.argv if a.startswith("--plans=")), 100)
    rows = [row for title in CASES for row in rows_of(title, count)]
    write_table(
        "step and converging",
        ("horizons", "function", "good", "us: median / 95 % / most", "iterations, median / most"),
        rows,
    )


if __name__ == "__main__":
    main()
