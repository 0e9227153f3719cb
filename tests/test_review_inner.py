"""What a review states about states that move by themselves: rate and sign, neutral ones, where they are linearised."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import pytest

import fpirhc as fp

PLAN = fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-3))
LAW = fp.ComputedTorque(fp.Exponential(rate=2.0))


def companion(rate: float, *, weigh: bool = False, **settings: Any) -> fp.Problem:
    """A speed y' = u - y that is controlled, and a state z' = rate z + y that is not; the response does not read z."""
    plant = fp.Plant(
        coordinates={"y": "m", "z": "m"},
        inputs={"u": "m/s"},
        order=1,
        controlled=("y",),
        parameters={"a": fp.Parameter(1.2, 1.0, "1/s")},
        response=lambda q, u, p: {"y": u.u - p.a * q.y, "z": rate * q.z + q.y},
    )
    usual: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {"y": ca.sin(t), "z": 0 * t}),
        "start": {"y": 0.0, "z": 0.0},
        "period": 0.02,
        "duration": 5.0,
        "horizon": fp.Horizon(stages=20, step=0.02),
        "cost": fp.Quadratic(states={"y": 1.0} | ({"z": 1.0} if weigh else {}), deviation={"u": 1e-3}),
    }
    return fp.Problem(plant=plant, **(usual | settings))


def answer(problem: fp.Problem, controller: fp.Controller, words: str) -> fp.Answer:
    every = fp.review(problem, {"it": controller}, mismatch=0.0, seed=0).answers
    [one] = [a for a in every if words in a.question]
    return one


@pytest.mark.parametrize(
    ("rate", "controller", "verdict", "begin"),
    [
        (-32.9, LAW, "yes", "stable: while the reference is followed they decay at 32.9 1/s"),
        (309.0, LAW, "no", "unstable: while the reference is followed they grow at up to 309 1/s"),
        (-32.9, PLAN, "yes", "stable: while the reference is followed they decay at 32.9 1/s"),
        (309.0, PLAN, "no", "unstable: while the reference is followed they grow at up to 309 1/s"),
        (0.0, LAW, "yes", "they neither grow nor decay"),
        (0.0, PLAN, "yes", "they neither grow nor decay"),
    ],
)
def test_zero_dynamics_have_a_rate_and_a_sign(rate, controller, verdict, begin):
    """The rate is an eigenvalue by construction; a neutral one that nothing reads is no fault."""
    one = answer(companion(rate), controller, "zero dynamics")
    assert (one.verdict, one.evidence[: len(begin)]) == (verdict, begin)
    assert one.numbers["rate"] == pytest.approx(rate, abs=1e-9)


@pytest.mark.parametrize("rate", [309.0, -32.9])
def test_a_plan_without_a_linear_loop_has_the_sign_too(rate):
    """A plan that is restarted and tracked has no linear loop: stable is yes, unstable is unknown with its rate."""
    tracked = replace(PLAN, replanning=fp.FromMeasurementTracked(fp.Exponential(rate=2.0)))
    one = answer(companion(rate), tracked, "zero dynamics")
    assert one.verdict == ("yes" if rate < 0 else "unknown")
    assert f"{abs(rate):.3g} 1/s" in one.evidence


@pytest.mark.parametrize("controller", [LAW, PLAN])
@pytest.mark.parametrize("words", ["rate x period", "margin"])
def test_an_integral_that_nobody_judges_is_no_fault(controller, words):
    """It stays where it is put, and no judged coordinate shows it; the horizon is not said to diverge either."""
    one = answer(companion(0.0), controller, words)
    assert one.verdict == "yes", one
    assert answer(companion(0.0), controller, "horizon long").verdict == "yes"


def test_an_integral_that_is_judged_is_not_called_stable():
    """The same integral among the judged coordinates: its error stays, which is no yes."""
    assert answer(companion(0.0, judged=("y", "z")), LAW, "zero dynamics").verdict == "unknown"
    assert answer(companion(0.0, judged=("y", "z")), LAW, "margin").verdict == "unknown"


def test_times_have_the_unit_of_the_problem():
    """Rates, delays and horizons of a problem in minutes are in minutes."""
    problem = companion(-0.5, time_unit="min")
    every = fp.review(problem, {"it": LAW}, mismatch=0.0, seed=0).answers
    text = " ".join(a.evidence for a in every)
    assert "0.4 min" in text
    assert "0.5 1/min" in text
    assert " s " not in text
    assert " 1/s" not in text
