"""What a review says about speed, lag, two-cycles and benefit, against runs and closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import reviewed
from chains import chain, errors_after_request
from sampled import lag, poles

import fpirhc as fp
from fpirhc.contraction.delayed import least_product
from fpirhc.controllers.base import Controller
from fpirhc.deformation import Deformation
from fpirhc.simulation.model_as_plant import shortened

RATE, PERIOD = 20.0, 1e-3  # 1/s, s


def moving(eigenvalue: float = 1.5, **settings) -> fp.Problem:
    """A mass along a sine, the model's inertia wrong by the factor."""
    return replace(
        chain(2, eigenvalue, **settings),
        reference=fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}),
        duration=2.0,
        measure_from=1.0,
    )


def answer(problem: fp.Problem, deformation: Deformation, words: str) -> Any:
    """The answer to the question with these words, None where it is not asked."""
    return reviewed.answer(problem, fp.ComputedTorque(fp.Exponential(rate=RATE), deformation), words)


@pytest.mark.parametrize(("ratio", "verdict"), [(0.9, "no"), (2.0, "caution"), (4.0, "yes")])
def test_slow_iterations_are_told(ratio, verdict):
    """Below what the plain form needs: no; less than three times: unknown. The increment form is not asked."""
    slow = fp.Affine(gain=-2 * ratio * least_product(3, RATE, PERIOD) / 1.5)
    one_answer = answer(moving(), slow, "keep up with its tracking law")
    assert one_answer.verdict == verdict
    assert one_answer.numbers["ratio"] == pytest.approx(ratio, rel=1e-6)
    assert answer(moving(), fp.Increment(slow, cycles=0), "keep up with its tracking law") is None
    assert answer(moving(), fp.Filtered(slow, pole=0.1), "keep up with its tracking law") is not None


@pytest.mark.parametrize(("eigenvalue", "larger"), [(1.5, True), (1.02, False)])
def test_a_larger_gain_is_proposed_where_a_run_with_the_wrong_model_speaks_for_it(eigenvalue, larger):
    """3.3 times the gain of the plain form has a seventh of the error of no adaptation, or twice it beside a model nearly right."""
    problem, ratio = moving(eigenvalue), 0.9
    slow = fp.Affine(gain=-2 * ratio * least_product(3, RATE, PERIOD) / eigenvalue)
    forms = "Use a form that passes the desired response at once (ModelReferenced, Increment), or "
    said = answer(problem, slow, "keep up with its tracking law").change
    assert said == forms + f"use gain = {3 * slow.gain / ratio:.3g}, or " * larger + "lower rate x period."
    law = fp.ComputedTorque(fp.Exponential(rate=RATE))
    faster = fp.Affine(gain=slow.gain * 3 / ratio)
    runs = (fp.simulate(problem, one, seed=0, compiled=False) for one in (law, law.with_deformation(faster)))
    without, adapted = (fp.measure(problem, run).rms_error["y"] for run in runs)
    assert (adapted < 0.2 * without) if larger else (adapted > 2 * without)


def test_lag_that_is_said_to_be_borne_is_borne():
    """At the longest lag the loop is stable, at twice the limit not; a large gain bears less than three cycles."""
    one_answer = answer(moving(1.0), fp.Affine(gain=-0.2), "small lag")
    assert one_answer.verdict == "yes"
    for tau, stable in ((one_answer.numbers["lag"], True), (2 * one_answer.numbers["limit"], False)):
        radius = np.abs(poles(lag(tau), 2, RATE, PERIOD, 0.1, plain=False)).max()
        assert (radius < 1) == stable
    assert answer(moving(1.0), fp.Affine(gain=-2.0), "small lag").verdict == "caution"


def test_two_cycle_that_is_said_to_exist_is_there():
    """A secant beyond the limit is a no, with the size of the errors that a run then shows; below it a yes."""
    sigmoid = fp.Sigmoid(gain=-1.0, scale=5.0)
    problem = chain(2, 1.5)
    limit = answer(problem, sigmoid, "two-cycles").numbers["limit"]
    for share, verdict in ((0.99, "yes"), (1.01, "no")):
        deformation = sigmoid.with_effective_gain(share * limit * sigmoid.effective_gain() / sigmoid.secant_gain())
        one_answer = answer(problem, deformation, "two-cycles")
        assert one_answer.verdict == verdict
        requests = np.random.default_rng(0).uniform(-10, 10, size=(12, 1))
        errors = errors_after_request(
            problem, fp.ComputedTorque(fp.Exponential(rate=RATE), deformation), requests, 4000
        )
        sizes = np.abs(errors[-50:, 0]).max(axis=0)
        if verdict == "yes":
            assert sizes.max() < 1e-6
        else:
            assert sizes.max() == pytest.approx(one_answer.numbers["amplitude"], rel=1e-6)
            assert one_answer.evidence.endswith(f"alternates with the size {sizes.max():.3g}")


def test_the_basin_grows_with_the_step_of_the_map_and_four_times_the_error_is_wanted():
    """Only of the plain form with a bounded step; the proposed scale is just enough."""

    def asked(scale: float) -> Any:
        return answer(moving(), fp.Sigmoid(gain=-0.5, scale=scale), "come back")

    first = asked(1.0)
    error, basin = first.numbers["error"], first.numbers["basin"]
    for ratio, verdict in ((4.01, "yes"), (3.99, "caution"), (2.49, "no")):
        one = asked(ratio * error / basin)
        assert one.verdict == verdict
        assert one.numbers["basin"] == pytest.approx(ratio * error, rel=1e-6)
        told = f"Raise the map's scale at least {4 / ratio:.2g} times."
        assert one.change == ("" if verdict == "yes" else told)
        assert ("times are wanted" in one.evidence) == (verdict != "yes")
    assert answer(moving(), fp.Affine(gain=-0.5), "come back") is None
    assert answer(moving(), fp.Increment(fp.Sigmoid(gain=-0.5, scale=1.0), cycles=0), "come back") is None


def test_the_basin_is_asked_of_laws_with_two_poles_and_compared_with_jumps():
    """One pole has no basin to leave; 40 N on a mass of 1 / 1.5 kg are a larger error than any of the run."""
    sigmoid = fp.Sigmoid(gain=-0.5, scale=1.0)
    law = fp.ComputedTorque(fp.Exponential(rate=RATE, integral=False), sigmoid)
    assert reviewed.answer(moving(), law, "come back") is not None
    assert reviewed.answer(replace(chain(1, 1.5), duration=0.5), law, "come back") is None
    pushed = moving(disturbances={"u": fp.Step(at=1.0, size=40.0)})
    gain = float(pushed.plant.equations.response(np.zeros(2), 1.0, pushed.plant.exact))
    assert answer(pushed, sigmoid, "come back").numbers["error"] == pytest.approx(40.0 * gain)


@pytest.mark.parametrize(("period", "harmful"), [(PERIOD, False), (0.02, True)])
def test_half_of_the_limit_of_two_cycles_is_proposed_after_a_run(period, harmful):
    """A model that is 2 % wrong: in a long period the plain form at half of the limit loses what the tracking law holds."""
    problem, sigmoid = replace(moving(1.02), period=period), fp.Sigmoid(gain=-1.0, scale=5.0)
    limit = answer(problem, sigmoid, "two-cycles").numbers["limit"] / sigmoid.secant_gain() * sigmoid.gain
    change = answer(problem, replace(sigmoid, gain=-1.01 * abs(limit)), "two-cycles").change
    law = fp.ComputedTorque(fp.Exponential(rate=RATE))
    run = fp.simulate(problem, law.with_deformation(replace(sigmoid, gain=-abs(limit) / 2)), seed=0, compiled=False)
    lost = fp.measure(problem, run).rms_error["y"]
    if harmful:
        assert f"The limit is gain = {-abs(limit):.3g}, but no gain is proposed" in change
        assert f"{lost:.3g} m with it" in change
        assert lost > 1.0
    else:
        assert change == f"Use gain = {-abs(limit) / 2:.3g}, half of the limit."
        assert lost < 0.01


def test_benefit_is_told_from_harm():
    """A wrong inertia: yes. A right one, which the plain form disturbs: no. A slightly wrong one: not sure."""
    verdicts = {1.5: "yes", 1.0: "no", 1.005: "caution"}
    for eigenvalue, verdict in verdicts.items():
        one_answer = answer(moving(eigenvalue), fp.Affine(gain=-1.0), "lower the response error")
        assert one_answer.verdict == verdict
        assert one_answer.numbers["with"] == pytest.approx(one_answer.numbers["null"], rel=1.0)


@pytest.mark.parametrize(("eigenvalue", "verdict"), [(1.5, "yes"), (1.0, "unknown")])
def test_runs_decide_on_the_benefit_under_dead_time(eigenvalue, verdict):
    """The recursion pairs a response with the last request, so nothing predicts it; the errors are those of two runs."""
    late = moving(eigenvalue, dead_time=fp.DeadTime(inputs={"u": PERIOD}))
    paired = fp.Paired(fp.Affine(gain=-0.5), cycles=1)
    one_answer = answer(late, paired, "lower the response error")
    assert one_answer.verdict == verdict
    assert "no prediction with dead time" in one_answer.evidence
    short = shortened(late, 1000)
    runs = [
        fp.simulate(short, fp.ComputedTorque(fp.Exponential(rate=RATE), map_), seed=0, compiled=False)
        for map_ in (fp.Identity(), paired)
    ]
    without, adapted = (fp.measure(short, run).rms_error["y"] for run in runs)
    assert (adapted < without) == (verdict == "yes")
    assert one_answer.numbers == pytest.approx({"without": without, "with": adapted}, rel=1e-9)
    assert answer(late, fp.Paired(fp.Affine(gain=-0.5), cycles=1), "two-cycles") is None
    assert answer(late, fp.Paired(fp.Affine(gain=-0.5), cycles=1), "small lag") is None


def steps_in_a_run(problem: fp.Problem, controller: Controller) -> float:
    """Rms step per cycle that noise makes at rest; there is nothing else that moves the command."""
    rest = replace(problem, reference=fp.Trajectory(lambda t: {"y": 0 * t}), start={"y": 0.0}, duration=10.0)
    steps = np.diff(fp.simulate(rest, controller, seed=0, compiled=False)["command"][2000:, 0])
    return float(np.sqrt(np.mean(steps**2)))


@pytest.mark.parametrize(
    ("noise", "sensor", "controller"),
    [
        (fp.Noise(1.0), "y''", fp.ComputedTorque(fp.Exponential(rate=RATE), fp.Affine(gain=-1.0))),
        (fp.Noise(1.0), "y''", fp.ComputedTorque(fp.Exponential(rate=RATE), fp.ModelReferenced(fp.Affine(gain=-2.0)))),
        (fp.ColouredNoise(1.0, 0.01), "y''", fp.ComputedTorque(fp.Exponential(rate=RATE), fp.Affine(gain=-1.0))),
        (fp.Noise(1e-3), "y", fp.ComputedTorque(fp.Exponential(rate=RATE))),
    ],
    ids=["plain", "model-referenced", "coloured", "without adaptation"],
)
def test_chatter_is_that_of_a_run(noise, sensor, controller):
    """White and coloured noise, with adaptation and without: the discrete Lyapunov equation of the loop itself."""
    noisy = moving(sensing=fp.Sensing({sensor: fp.Sensor(noise=noise)}))
    one = reviewed.answer(noisy, controller, "chatter")
    assert one.numbers["step_u"] == pytest.approx(steps_in_a_run(noisy, controller), rel=0.03)


def test_chatter_is_not_asked_without_noise():
    """A quiet sensor."""
    assert answer(moving(), fp.Affine(gain=-1.0), "chatter") is None


@pytest.mark.parametrize(("stiffness", "verdict"), [(30.0, "yes"), (20.0, "no")])
def test_an_inverse_of_another_response_is_told(stiffness, verdict):
    """M y'' = u - 30 y with the inverse u = M r + k y: the response to it is off by 10 y of 23.5 y where k is 20."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(1.5, 1.0, "kg")},
        response=lambda q, v, u, p: {"y": (u.u - 30.0 * q.y) / p.m},
        inverse=lambda q, v, r, p: {"u": p.m * r.y + stiffness * q.y},
    )
    one = answer(replace(moving(), plant=plant), fp.Identity(), "inverse exist")
    assert one.verdict == verdict
    if verdict == "no":
        responses = (
            abs(10.0 + 9.0 * 1.5) / 1.5
        )  # those that the wrong command has along y = sin(3 t), whose y'' is -9 y
        assert one.numbers["missed"] == pytest.approx(10.0 / 1.5 / responses, rel=0.02)
