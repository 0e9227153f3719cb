"""What cannot be kept is named with its reason: a double integrator |u| <= 1 m/s2, whose best braking is known by hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidProblem
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe

SLEDGE = fp.Plant(
    coordinates={"y": "m"},
    inputs={"u": "N"},
    parameters={"m": fp.Parameter(1.0, 1.0, "kg")},
    response=lambda q, v, u, p: {"y": u.u / p.m},
)
STEP = 0.1  # s


def plan_of(
    start: tuple[float, float], states: dict[str, tuple[float, float]], stages: int, at: float = 0.0, **more: Any
) -> fp.Plan:
    """The plan from (y, y') towards y = `at`."""
    reference = fp.Trajectory(lambda t: {"y": at + 0 * t})
    terminal = more.pop("terminal", ())
    horizon = fp.Horizon(stages=stages, step=STEP, terminal=terminal)
    cost = fp.Quadratic(states={"y": 1.0, "y'": 0.1}, effort={"u": 0.01})
    limits = fp.Limits(inputs={"u": (-1.0, 1.0)}, states=states, **more)
    ocp = transcribe(SLEDGE, reference, horizon, cost, limits)
    data = np.asarray(stage_data(SLEDGE, reference, horizon, cost)(0.0, SLEDGE.approximate).full())
    first = np.asarray(ocp.start(list(start), [0.0]).full()).ravel()
    return fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=1e-7), first, data)


def test_a_start_too_fast_to_stop_says_how_far_it_overshoots_and_when_it_is_back():
    """From .9 m at 1 m/s full braking stops at 1.4 m after 1 s, and is back at 1 m after 1.894 s, in stage 19."""
    plan = plan_of((0.9, 1.0), {"y": (-5.0, 1.0)}, 25)
    assert plan.status == fp.Status.INFEASIBLE
    (reason,) = plan.reasons()
    assert reason.startswith(
        "'y' above 1: begins inside, passes it by 0.4 m and cannot be back before stage 19 (1.9 s)"
    )
    assert "with 'u' at the limit" in reason
    assert "softening helps: with Limits(soft={'y': ...})" in reason


def test_a_soft_limit_does_help_where_that_is_said():
    """The same start with the soft limit is solved, and inside from stage 20 on."""
    plan = plan_of((0.9, 1.0), {"y": (-5.0, 1.0)}, 25, soft={"y": 1e4})
    assert plan.status == fp.Status.OK
    assert plan.reasons() == ()
    assert plan.states[0, 10] == pytest.approx(1.4, abs=1e-3)
    assert plan.states[0, 20:].max() < 1.0 + 1e-3


def test_a_start_outside_a_limit_says_by_how_much():
    """From 1.3 m at rest it takes .775 s to come back: stage 8."""
    plan = plan_of((1.3, 0.0), {"y": (-5.0, 1.0)}, 25)
    (reason,) = plan.reasons()
    assert reason.startswith(
        "'y' above 1: begins 0.3 m beyond it, cannot be back before stage 8 (0.8 s) with 'u' at the limit"
    )


def test_a_start_outside_that_is_back_after_one_stage_is_no_fault():
    plan = plan_of((1.001, -0.1), {"y": (-5.0, 1.0)}, 25)
    assert plan.status == fp.Status.OK
    assert plan.reasons() == ()


def test_a_horizon_too_short_to_come_back_says_what_is_left():
    """After 1.5 s of braking y is 1.275 m: softening does not help."""
    plan = plan_of((0.9, 1.0), {"y": (-5.0, 1.0)}, 15)
    (reason,) = plan.reasons()
    assert "is still 0.275 m beyond at the end of 15 stages (1.5 s) with 'u' at the limit" in reason
    assert "softening would only let it leave. Give the inputs more range, lengthen the horizon, or widen" in reason


def test_limits_that_no_input_reaches_are_named():
    """In .5 s the sledge moves .125 m at most; a limit at 3 m is out of reach."""
    plan = plan_of((0.0, 0.0), {"y": (3.0, 4.0)}, 5)
    assert plan.status == fp.Status.INFEASIBLE
    (reason,) = plan.reasons()
    assert reason.startswith(
        "'y' below 3: begins 3 m beyond it and is still 2.88 m beyond at the end of 5 stages (0.5 s)"
    )
    assert "softening would not bring it inside" in reason


def test_an_end_out_of_reach_names_the_horizon():
    """In .3 s at 1 m/s2 the sledge moves .045 m, and the reference is at .5 m."""
    plan = plan_of((0.0, 0.0), {}, 3, at=0.5, terminal=("y",))
    (reason,) = plan.reasons()
    assert reason.startswith(
        "'y at the end' misses the reference by 0.455 m with 'u' at the limit: a horizon of 3 stages (0.3 s)"
    )
    assert "take 'y' out of Horizon(terminal=...)" in reason


def test_limits_that_contradict_one_another_are_named_together():
    """A path keeps y below .6 m and the state's limit above .8 m: neither is kept by an input at its limit."""
    paths = {"low": fp.PathConstraint(lambda v: v.state.y, upper=0.6, unit="m")}
    plan = plan_of((0.7, 0.0), {"y": (0.8, 5.0)}, 25, at=0.7, paths=paths)
    assert plan.status == fp.Status.INFEASIBLE
    assert any("contradict one another" in r for r in plan.reasons())


@pytest.mark.parametrize(
    "make", [lambda: {"y": (1.0, -1.0)}, lambda: {"speed": (0.0, 1.0)}], ids=["crossed", "unknown"]
)
def test_limits_that_cannot_be_meant_are_refused_before_any_solve(make: Callable[[], dict[str, tuple[float, float]]]):
    with pytest.raises(InvalidProblem, match=r"lower 1.0 above upper -1.0; swap them|'speed'"):
        plan_of((0.0, 0.0), make(), 5)


def test_a_run_whose_plans_cannot_keep_a_limit_says_so_when_it_is_shown():
    """A start outside a limit does not stop a run: its text names the outcome, how often, and since when."""
    problem = fp.Problem(
        plant=SLEDGE,
        start={"y": 1.3, "y'": 0.0},
        reference=fp.Trajectory(lambda t: {"y": 0 * t}),
        period=STEP,
        duration=0.3,
        limits=fp.Limits(inputs={"u": (-1.0, 1.0)}, states={"y": (-5.0, 1.0)}),
        horizon=fp.Horizon(stages=12, step=STEP),
        cost=fp.Quadratic(states={"y": 1.0, "y'": 0.1}, effort={"u": 0.01}),
    )
    run = fp.simulate(problem, fp.RecedingHorizon(fp.FixedPoint(iterations=20, tolerance=1e-6)), seed=0)
    assert run.stop is None
    assert "HELD in 3 cycles, first at 0 s" in repr(run)  # the policy's name for every plan that is not usable as it is
