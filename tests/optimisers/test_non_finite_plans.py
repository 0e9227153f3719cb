"""A plan that is not finite has no cost and no residual, and never looks like the best one of a table."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.hand_made_runs import CYCLES, SOLVE, problem, run

import fpirhc as fp
from fpirhc import Status, measure
from fpirhc.contracts import Signal
from fpirhc.report.terminal import show_plans
from fpirhc.studies.open_loop import Solved
from fpirhc.studies.view import status_shares


def exploding() -> fp.Problem:
    """Y' = y^3 + u from y = 30: every plan overflows."""
    plant = fp.Plant(
        {"y": "m"}, {"u": "N"}, {"b": fp.Parameter(1.0, 1.0, "1")}, lambda q, u, p: {"y": q.y**3 + p.b * u.u}, order=1
    )
    return fp.Problem(
        plant,
        fp.Trajectory(lambda t: {"y": 0 * t}),
        {"y": 30.0},
        0.1,
        1.0,
        limits=fp.Limits(inputs={"u": (-1.0, 1.0)}),
        horizon=fp.Horizon(stages=40, step=0.1),
        cost=fp.Quadratic(states={"y": 1.0}, effort={"u": 0.1}),
    )


@pytest.fixture(scope="module")
def plan() -> fp.Plan:
    """The first horizon, solved by the default optimiser."""
    from fpirhc.horizon.stage_data import stage_data
    from fpirhc.horizon.transcription import transcribe

    p = exploding()
    assert p.horizon is not None
    assert p.cost is not None
    ocp = transcribe(p.plant, p.reference, p.horizon, p.cost, p.limits)
    data = stage_data(p.plant, p.reference, p.horizon, p.cost)(0.0, p.plant.approximate).full()
    return fp.solve(ocp, fp.FixedPoint(iterations=5, tolerance=1e-6), p.start_state, data, calls=3)


def test_such_a_plan_has_no_numbers(plan):
    """Neither as a value nor in its one line; it is not 0, which would be the least cost of all."""
    assert plan.status == Status.NON_FINITE
    assert (plan.cost, plan.stationarity, plan.feasibility) == (None, None, None)
    assert "cost none, stationarity none, feasibility none" in repr(plan)


def test_the_table_of_plans_shows_none(plan, capsys, tmp_path):
    show_plans("exploding", [Solved("FPI", plan, None)], tmp_path / "plan.png")
    row = next(line for line in capsys.readouterr().out.splitlines() if line.strip().startswith("FPI"))
    assert row.split()[1:3] == ["-", "-"]
    assert "non finite" in row


def test_metrics_of_a_run_leave_such_plans_out():
    """Half of the plans are not finite and logged with zeros: the medians are those of the other half; with all of them, none."""
    rows = np.tile([4.0, 1e-3, 0.0, 2.0, float(Status.OK)], (CYCLES, 1))
    rows[: CYCLES // 2 + 5] = [0.0, 0.0, 0.0, 2.0, float(Status.NON_FINITE)]
    signal = Signal("solve", SOLVE)
    metrics = measure(problem(), run(0.1, solve=(signal, rows)))
    assert metrics["solve.median_stationarity"][""] == 1e-3
    rows[:] = rows[0]
    assert "" not in measure(problem(), run(0.1, solve=(signal, rows)))["solve.median_stationarity"]


@pytest.mark.parametrize(
    ("statuses", "words"),
    [
        ({"OK": 720, "HELD": 0}, "ok"),
        ({"OK": 708, "NOT_CONVERGED": 12}, "not converged 1.67 %"),
        ({"OK": 10, "NON_FINITE": 20, "HELD": 10}, "non finite 50 %, held 25 %"),
    ],
)
def test_the_table_of_controllers_names_what_went_wrong(statuses, words):
    """A share of cycles that are ok does not say what the others were."""
    assert status_shares(statuses) == words
