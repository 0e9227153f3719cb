"""Reviews of plants with outputs: the linear loop of plans, and every question, against simulated runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from plants import simulated
from test_outputs import ARM, TRACK, arm, circle, curve, hill, planned, sedated

import fpirhc as fp
from fpirhc.controllers.contract import Controller
from fpirhc.deformation.base import Deformation
from fpirhc.errors import NotContractive
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along
from fpirhc.review.question import Answer, Verdict
from fpirhc.review.questions.slew import effect, slew_enough

LEVEL = 3.0  # mg/l
CONVERGED = fp.RecedingHorizon(fp.FixedPoint(iterations=8, tolerance=1e-9))
LAW = fp.Exponential(rate=1.0)


def resting(**settings: Any) -> fp.Problem:
    """The depth at rest, with a wrong curve and a new plan in every cycle."""
    still = float(curve(LEVEL, 4.0))
    cost = fp.Quadratic(outputs={"depth": 1.0, "depth'": 0.1}, rate={"u": 1e-2})
    changes: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {"depth": still + 0 * t}),
        "start": {"C": LEVEL, "E": LEVEL},
        "period": 0.1,
        "duration": 7.0,
        "measure_from": 0.0,
        "cost": cost,
        "horizon": fp.Horizon(stages=12, step=0.1),
        "input_before": {"u": LEVEL},
    }
    return replace(sedated(hill(5.5)), **{**changes, **settings})


@pytest.mark.parametrize("form", [fp.ModelReferenced(fp.Affine(-1.0))])
def test_the_linear_loop_of_a_plan_is_the_decay_of_a_small_deviation(form: Deformation) -> None:
    problem, controller = resting(), replace(CONVERGED, deformation=form)
    loops = loops_along(review_grid(problem, 0.0, 0), controller)
    starts = ({**problem.start, "E": LEVEL + s} for s in (1e-3, -1e-3))
    one, other = (simulated(replace(problem, start=s), controller)["output.depth"] for s in starts)
    deviation = np.abs(one - other)
    decay = (deviation[60] / deviation[30]) ** (1 / 30)
    assert loops.radii[0] == pytest.approx(decay, rel=3e-3)


def answers(problem: fp.Problem, controller: Controller) -> dict[str, Answer]:
    review = fp.review(problem, {"one": controller}, mismatch=0.0, seed=0)
    return {a.question: a for a in (*review.problem, *review.controllers["one"])}


@pytest.fixture(scope="module")
def adaptive() -> dict[str, Answer]:
    return answers(planned(), fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-2), fp.Affine(-1.5)))


def test_every_question_has_an_answer(adaptive: dict[str, Answer]) -> None:
    """The questions are those about coordinates, and none is left out as not covered."""
    assert not [a.question for a in adaptive.values() if "not covered" in a.evidence]
    for question in (
        "Is the horizon long enough?",
        "Does the discretisation of the horizon follow the plant?",
        "Is the reference free of jumps?",
        "Does the deformation converge?",
        "Is the map fast enough for reference and disturbances?",
        "Has the linear loop enough margin?",
    ):
        assert adaptive[question].verdict == Verdict.YES, adaptive[question].evidence


def test_the_null_test_is_the_run_on_the_model(adaptive: dict[str, Answer]) -> None:
    plain = planned()
    model = replace(plain.plant, parameters={"half": fp.Parameter(5.5, 5.5, "mg/l")})
    same = replace(plain, plant=model)
    stated = adaptive["Does adaptation leave a right model alone?"].numbers
    plan = fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-2))
    for key, controller in (("without", plan), ("with", replace(plan, deformation=fp.Affine(-1.5)))):
        rms = fp.measure(same, simulated(same, controller)).rms_error["depth"]
        assert stated[key] == pytest.approx(rms, rel=1e-6)


def test_the_predicted_response_error_is_that_of_a_run() -> None:
    """Without adaptation the law asks for 1 / J of what the model lacks, which the first order does not have."""
    problem = sedated(hill(5.5))
    prediction = fp.predict_response(problem, fp.ComputedTorque(LAW, fp.Affine(-1.5)), compiled=False)
    run = simulated(problem, fp.ComputedTorque(LAW))
    first = round(problem.measure_from / problem.period)
    rms = np.sqrt(np.mean((run["realised"][1:] - run["desired"][:-1])[first:] ** 2))
    assert prediction.rms(prediction.without)["depth"] == pytest.approx(rms, rel=0.25)
    assert prediction.helps


@pytest.mark.parametrize("plans", [False, True])
def test_a_run_is_inside_the_tube_of_its_outputs(plans: bool) -> None:
    """The depth and its rate, around the run of the right model; the tube is at most ten times as wide as what is needed."""
    controller: Controller = fp.ComputedTorque(LAW, fp.Affine(-1.5))
    if plans:
        controller = fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-2), fp.Affine(-1.5))
    problem = planned() if plans else sedated(hill(5.5))
    prediction = fp.predict_response(problem, controller, compiled=False)
    assert prediction.tube is not None
    first = round(problem.measure_from / problem.period)
    away = np.abs(simulated(problem, controller)["output"] - prediction.nominal.motion)[first:].max(axis=0)
    half = prediction.tube[first:].max(axis=0)
    assert (away < half).all()
    assert (away > 0.1 * half).all()
    assert tuple(prediction.half_width) == problem.plant.output.elements


def test_no_tube_where_the_command_moves_an_output_at_once() -> None:
    plant = replace(hill(5.5), outputs={"depth": fp.Output("1", lambda x, u, p: x.E + 0.1 * u.u)}, inverse=None)
    problem = replace(sedated(hill(5.5)), plant=plant)
    prediction = fp.predict_response(problem, fp.ComputedTorque(LAW, fp.Affine(-0.5)), compiled=False)
    assert prediction.tube is None
    assert "depth is not controlled through a derivative, and moves by itself or at once" in prediction.reason


def test_the_start_off_the_reference_asks_for_a_fast_map() -> None:
    """The request after the start is that of the plan's feedback, in the coordinates of the outputs."""
    off = replace(planned(), start={"C": 1.5, "E": 1.2})
    controller = fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-2), fp.Affine(-1.0))
    grids = [review_grid(p, 0.0, 0) for p in (planned(), off)]
    slow, fast = (slew_enough(g, fp.Affine(-1.0), np.array([5.5]), loops_along(g, controller).ideal) for g in grids)
    assert fast.numbers["needed"] > 3 * slow.numbers["needed"]
    assert "after the start" in fast.evidence


def test_the_effect_of_a_disturbance_is_that_on_the_outputs() -> None:
    """A unit on the rate of a joint moves the hand by the lever; one on the hand moves no response."""
    disturbances = {"b": fp.Step(1.0, 1.0), "x": fp.Step(1.0, 0.1)}
    grid = review_grid(replace(circle(arm()), disturbances=disturbances), 0.0, 0)
    assert effect(grid, "b") == pytest.approx(ARM["l2"], rel=1e-9)
    assert effect(grid, "x") == 0.0


def test_the_lag_of_a_reality_is_found_beside_outputs() -> None:
    """N Lambda tau with the pump's lag, and the loop around the pump: its run comes to rest as the pole says."""
    tau = 0.02  # min
    real = fp.Plant.of_states(
        states={"C": "mg/l", "E": "mg/l", "pump": "mg/l/min"},
        inputs={"u": "mg/l/min"},
        parameters={"half": fp.Parameter(4.0, 4.0, "mg/l")},
        rates=lambda x, u, p: {"C": x.pump - x.C, "E": 0.5 * (x.C - x.E), "pump": (u.u - x.pump) / tau},
        outputs={"depth": fp.Output("1", lambda x, p: curve(x.E, p.half))},
        time_unit="min",
    )
    problem = replace(sedated(hill(5.5)), reality=fp.Reality(real, integrator=fp.RungeKutta4(substeps=4)))
    asked = answers(problem, fp.ComputedTorque(LAW, fp.Affine(-1.0)))
    room = asked["Does the tracking law leave room for the lag of the reality?"]
    assert room.numbers["lag"] == pytest.approx(tau, rel=0.02)
    assert room.numbers["room"] == pytest.approx(3 * tau, rel=0.02)
    assert asked["Does the loop with the reality converge?"].verdict == "yes"
    run = fp.simulate(problem, fp.ComputedTorque(LAW, fp.Affine(-1.0)), seed=0, compiled=False)
    errors = np.abs(run["error"][:, 0])
    assert errors[-50:].max() < 0.1 * errors.max()


def test_a_plan_on_the_hand_of_an_arm_has_a_linear_loop() -> None:
    cost = fp.Quadratic(outputs={"x": 1e3, "y": 1e3, "x'": 1.0, "y'": 1.0}, rate={"A": 1e-3, "B": 1e-3})
    problem = circle(arm(), horizon=fp.Horizon(stages=10, step=0.02), cost=cost)
    loops = loops_along(review_grid(problem, 0.0, 0), replace(CONVERGED, deformation=fp.Affine(-0.5)))
    assert loops.radii.max() < 1
    bare = loops_along(review_grid(problem, 0.0, 0), fp.ComputedTorque(TRACK))
    assert not bare.reason


def test_a_gain_of_the_wrong_sign_is_answered_and_not_refused() -> None:
    """The loop of such a gain is judged as that of a plant with coordinates is: it fits the problem, and its gain does not."""
    wrong = fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-2), fp.Affine(1.5))
    every = answers(planned(), wrong)
    assert not [q for q in every if "fit the problem" in q]
    admissible = every["Is the map's gain admissible?"]
    assert admissible.verdict is Verdict.NO
    assert "gain = 1.5; the smallest limit is -" in admissible.evidence
    with pytest.raises(NotContractive):
        simulated(planned(), wrong)
