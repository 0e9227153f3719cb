"""Plans that count as solved in a local optimum, found in a run: IPOPT, from the middle of the limits, decides who is right."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.studies.comparison.optimality import measure_optimality

EXACT = "RHC exact model"


def emptied(task):
    """The tanks, to be emptied at 60 s and filled again at 90 s: an empty tank flows out as before, whatever the pump adds."""

    def levels(t):
        level = 0.12 * (1 - 1 / (1 + ca.exp(-2 * (t - 60))) + 1 / (1 + ca.exp(-2 * (t - 90))))
        return {"h1": (4.0 / 5.5) ** 2 * level, "h2": level}

    problem = replace(task.problem, reference=fp.Trajectory(levels), duration=120.0, measure_from=0.0, disturbances={})
    return replace(task, problem=problem)


@pytest.fixture(scope="module")
def task():
    return emptied(fp.load_problem("leaking_tanks"))


def cheaper(problem, run, row):
    """Cost of the plan that IPOPT finds with the exact model from the middle of the limits, at a cycle of the run."""
    plant = replace(
        problem.plant, parameters={n: replace(p, approximate=p.exact) for n, p in problem.plant.parameters.items()}
    )
    ocp = transcribe(plant, problem.reference, problem.horizon, problem.cost, problem.limits, start=problem.start_state)
    data = stage_data(plant, problem.reference, problem.horizon, problem.cost)(run.time[row], plant.exact).full()
    first = np.asarray(ocp.start(run["state"][row], run["command"][row - 1]).full()).ravel()
    plan = fp.solve(ocp, fp.Ipopt(tolerance=1e-6), first, data, start=np.full((1, ocp.stages), 100.0))
    assert plan.feasibility is not None
    assert plan.feasibility < 1e-6  # so its cost can be had, whether the last digit converged or not
    return plan.cost


def test_plans_that_stay_at_limits_are_counted_where_ipopt_finds_a_cheaper_one(task):
    """Each plan that is counted has status OK, its input at a limit, and one that costs a tenth less; elsewhere none is counted."""
    run = fp.simulate(task.problem, task.controllers[EXACT], seed=0, compiled=False)
    found = measure_optimality(task.problem, task.controllers[EXACT], run, compiled=False)
    assert found is not None
    assert 5 <= len(found.stuck) < found.plans
    assert min(found.stuck) > 50.0
    rows = [int(np.searchsorted(run.time, time - 1e-9)) for time in found.stuck]
    for row in rows:
        assert run["status"][row] == fp.Status.OK
        assert run["command"][row, 0] in (0.0, 200.0)
        assert cheaper(task.problem, run, row) < 0.91 * run["solve.cost"][row]
    for row in (10, 20):
        assert run["status"][row] == fp.Status.OK
        assert cheaper(task.problem, run, row) > 0.9 * run["solve.cost"][row]


def test_the_verdict_says_so_of_a_run_whose_status_is_ok(task):
    """The tank stays empty: the sentence has the count, the first time, and what to do; a run that fills it again has none."""
    compared = fp.compare(task, seed=0, controllers=["RHC+FPI", EXACT], compiled=False)
    known = compared[EXACT].optimality
    assert known is not None
    stuck = known.stuck
    [text] = [t for t in compared.verdict if "local optimum" in t]
    assert text.startswith(f"{EXACT}: its plans stay in a local optimum: {len(stuck)} of the ")
    assert f"the first at t = {stuck[0]:g} s" in text
    assert "Limits(states=...)" in text
    assert compared[EXACT].run["state.h2"][-1] < -0.1
    assert compared[EXACT].metrics.statuses["OK"] > 0.7 * compared[EXACT].run.cycles


@pytest.mark.slow
def test_a_limit_of_the_level_is_what_helps(task):
    """What the sentence advises: with levels of at least a millimetre in the plan, the exact model fills the tank again."""
    kept = replace(
        task.problem,
        limits=replace(task.problem.limits, states={"h1": (1e-3, 1.0), "h2": (1e-3, 1.0)}, soft={"h1": 1e6, "h2": 1e6}),
    )
    run = fp.simulate(kept, task.controllers[EXACT], seed=0, compiled=False)
    found = measure_optimality(kept, task.controllers[EXACT], run, compiled=False)
    assert run["state.h2"][-1] == pytest.approx(0.12, abs=0.02)
    assert found is None or not found.stuck
