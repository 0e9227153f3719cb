"""FixedPoint's closed loops beside IPOPT's, where limits of states are active: what converges, what it costs, how long it takes.

    python benchmarks/state_limited_loops.py [LOOP ...] [--cycles=200] [--write]     --write puts the table into docs/performance.md

A loop plans in every stage, once with a model that has the plant's parameters (right) and once with the wrong ones. FixedPoint and
IPOPT each run a loop of their own. Every plan is judged by `judging.py`, by automatic differentiation of the rolled-out cost and
non-negative least squares: converged is a plan that its optimiser calls OK, with a residual and a violation of 1e-4 of half the
range at most. Where FixedPoint's plan is not, IPOPT is asked about that very horizon, from nothing: of the horizons for which it
has no plan, those are counted that FixedPoint tells INFEASIBLE.

Costs of loops are compared where both find one optimum. They do not where two plans of the same cycle are both stationary and
differ in cost, with the price of violations, by more than 1e-4, although the states until then agree to 1e-3 of half the range.
Times are processor times of the compiled plan call alone, the shortest of three calls with the same arguments.

Exit code 1 where a bar is missed: converged at least IPOPT's share less 1 %; cost and worst violation at most IPOPT's and 1e-4;
INFEASIBLE said where IPOPT has no plan and nowhere else, but for 1 % of the cycles; up to five states, said within 2 ms.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from constrained import problem_of
from foreign import FOREIGN, Foreign
from ipopt_plans import IpoptPlans
from judging import Judge
from limited_loop import OwnPlans, closed
from loop_comparison import Comparison, Judged
from loops_of_machines import MACHINES
from loops_of_processes import PROCESSES
from loops_of_vehicles import VEHICLES
from table import write_table

import fpirhc as fp
from fpirhc.horizon.problem import OptimalControl

LOOPS: dict[str, Callable[[], Foreign]] = {f.__name__: f for f in (*PROCESSES, *MACHINES, *VEHICLES)}
CYCLES = 200
TOLERANCE = 1e-6  # of half the range of the smallest input


def optimiser_of(ocp: OptimalControl) -> fp.FixedPoint:
    """FixedPoint as a loop has it."""
    return fp.FixedPoint(iterations=1, tolerance=TOLERANCE * float((0.5 * (ocp.input_upper - ocp.input_lower)).min()))


def compared(case: Foreign, optimiser: fp.FixedPoint, ocp: OptimalControl, cycles: int, *, right: bool) -> Comparison:
    """Run both loops and judge them."""
    judge = Judge(ocp)

    def ran(planner: OwnPlans | IpoptPlans) -> Judged:
        loop = closed(case, ocp, planner, cycles, right=right)
        return Judged(loop, [judge(p.inputs, s, d) for p, s, d in zip(loop.plans, loop.first, loop.data, strict=True)])

    own, rival = ran(OwnPlans(optimiser, ocp, optimiser.step(ocp))), ran(IpoptPlans(ocp))
    empty = np.array(
        [
            not good and IpoptPlans(ocp)(s0, data).status == fp.Status.INFEASIBLE
            for good, s0, data in zip(own.converged, own.loop.first, own.loop.data, strict=True)
        ]
    )
    return Comparison(ocp, own, rival, empty)


def main() -> int:
    """Run the loops named on the command line, or all; the number of rows with a missed bar decides the exit code."""
    names = [a for a in sys.argv[1:] if not a.startswith("--")] or list(LOOPS)
    cycles = next((int(a.partition("=")[2]) for a in sys.argv if a.startswith("--cycles=")), CYCLES)
    heads = (
        *(
            "loop",
            "model",
            "plans at a limit",
            "converged, %: FixedPoint / IPOPT",
            "infeasible told",
            "cost against IPOPT's",
        ),
        *("worst violation: FixedPoint / IPOPT", "us: median / 95 % / 99 % / most", "iterations, median / most"),
        *("IPOPT's median / FixedPoint's", "missed"),
    )
    rows = []
    for name in names:
        case = (LOOPS | FOREIGN)[name]()
        ocp = problem_of(case)
        for right in (True, False):
            row = compared(case, optimiser_of(ocp), ocp, cycles, right=right)
            title = f"{name} (N = {ocp.stages}, {ocp.state.size} states)"
            rows.append((title, "right" if right else "wrong", *row.cells()))
            print(" | ".join(rows[-1]), flush=True)
    write_table("state-limited loops", heads, rows)
    return int(any(row[-1] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
