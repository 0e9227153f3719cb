"""Reviews of plants that are not shipped, answer by answer against what is known of them and against runs; see `tests/abroad`."""

from __future__ import annotations

import importlib
from dataclasses import replace
from functools import cache
from typing import Any

import abroad
import numpy as np
import pytest
from abroad import load
from reviewed import answer

import fpirhc as fp
from fpirhc.review.questions.right_model import forms_of


@cache
def about(name: str, words: str, controller: str = "RHC+FPI", variant: str = "problem") -> Any:
    """The answer to the question with these words."""
    task = abroad.load(name, variant)
    return answer(task.problem, task.controllers[controller], words)


@cache
def reviewed(name: str) -> tuple[fp.Answer, ...]:
    """All answers about RHC+FPI."""
    task = abroad.load(name)
    return fp.review(task.problem, {"RHC+FPI": task.controllers["RHC+FPI"]}, mismatch=0.0, seed=0).answers


# The quadruple tank


def test_upper_tanks_are_simulated_and_not_taken_from_the_reference():
    """They have no task: the commands follow the two pumps' balance over a swing and not that of levels at rest."""
    commands = about("quadruple_tank", "commands")
    assert commands.verdict == "yes"
    problem = abroad.load("quadruple_tank").problem
    exact = fp.ExactModel(fp.ComputedTorque(fp.Exponential(rate=0.1)))
    run = fp.simulate(problem, exact, seed=0)
    middle, half = 6.0, 6.0  # V, of the limits
    share = (np.abs(run["command"][20:] - middle) / half).max()
    assert commands.numbers["share_of_limits"] == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize(("variant", "zero", "verdict"), [("problem", -0.018, "yes"), ("nonminimum", 0.013, "no")])
def test_zeros_of_the_tanks_are_those_of_johansson(variant, zero, verdict):
    """The slower published zero of each point; the levels move by 2 cm, which moves it by some thousandths."""
    one = about("quadruple_tank", "zero dynamics", "CTC+FPI", variant)
    assert one.verdict == verdict
    assert one.numbers["rate"] == pytest.approx(zero, abs=4e-3)
    assert one.evidence.startswith("stable" if zero < 0 else "unstable")


@pytest.mark.slow
def test_tanks_are_ready_and_their_run_agrees():
    """Every answer about RHC+FPI is yes or advice, and the run is better by a factor."""
    answers = {a.question: a.verdict for a in reviewed("quadruple_tank")}
    assert "no" not in answers.values()
    assert answers["Does the deformation converge?"] == "yes"
    assert answers["Does the deformation reach the wrong parameters?"] == "yes"
    task = abroad.load("quadruple_tank")
    errors = [
        np.abs(fp.simulate(task.problem, task.controllers[n], seed=0)["error"][200:]).max() for n in ("RHC", "RHC+FPI")
    ]
    assert errors[1] < 0.5 * errors[0]


# The flexible servo


@pytest.mark.slow
def test_the_servo_has_nothing_to_adapt():
    """The Jacobian is 1, the load's parameters are named, and adaptation does not lower the response error."""
    review = {a.question: a for a in reviewed("flexible_servo")}
    signs = review["Do the eigenvalues of the response Jacobian have one sign?"]
    assert (signs.numbers["smallest_over_box"], signs.numbers["largest_over_box"]) == pytest.approx((1.0, 1.0))
    reach = review["Does the deformation reach the wrong parameters?"]
    assert (reach.verdict, reach.evidence) == ("no", "the response does not depend on J_L, b_L")
    assert review["Does adaptation lower the response error?"].verdict == "no"


@pytest.mark.slow
def test_the_weighed_change_of_the_voltage_leaves_no_answer_out():
    """The cost weighs the change of the voltage: margins, rates and convergence have numbers.

    Plans are made every 10 cycles, and between them the deformation acts on: a voltage of half the size is too little for it
    (`test_plan_period`), where a plan in every cycle would bear a nineteenth.
    """
    for words in ("margin", "sampling fast enough", "zero dynamics"):
        for controller in ("RHC", "RHC+FPI", "RHC exact model"):
            wanted = "caution" if (words, controller) == ("margin", "RHC+FPI") else "yes"
            assert about("flexible_servo", words, controller).verdict == wanted, (words, controller)
    assert about("flexible_servo", "margin", "RHC+FPI").numbers["gain_margin"] == pytest.approx(1.74, rel=0.02)
    assert about("flexible_servo", "horizon long").verdict == "yes"


# The infusion of propofol


def test_compartments_are_filled_by_the_plasma():
    """The largest share of the pump is that of the exact kinetics with compartments that begin empty."""
    commands = about("drug_infusion", "commands")
    problem = abroad.load("drug_infusion").problem
    exact = fp.ExactModel(fp.ComputedTorque(fp.Exponential(rate=2.0)))
    run = fp.simulate(replace(problem, start={**problem.start, "C1": 3.0}), exact, seed=0)
    share = (np.abs(run["command"][18:] - 100.0) / 100.0).max()
    assert commands.numbers["share_of_limits"] == pytest.approx(share, abs=0.02)


def test_a_slow_compartment_is_not_the_deformation_s():
    """Fat fills at 0.0035 1/min whatever the gain is; the deformation converges within the run all the same."""
    slow = about("drug_infusion", "zero dynamics", "CTC+FPI")
    assert slow.verdict == "yes"
    assert slow.numbers["rate"] == pytest.approx(-0.836 / 238, rel=0.01)
    for name in ("CTC+FPI", "RHC+FPI"):
        one = about("drug_infusion", "Does the deformation converge", name)
        assert one.verdict == "yes"
        assert one.numbers["radius"] < 0.95
        assert "beside those of the states that move by themselves, 0.9994" in one.evidence


def test_kinetics_of_states_without_a_task_are_not_missed():
    """The rates of the outer compartments are in no response that matters: named, and no fault."""
    one = about("drug_infusion", "reach the wrong parameters", "CTC+FPI")
    assert one.verdict == "yes"
    assert one.evidence.endswith("k21, k31, ke0 (k21, k31, ke0: only in states without a task)")
    assert one.numbers["effect_V1"] > one.numbers["effect_k10"] > one.numbers["effect_k13"] > 0


def test_minutes_are_minutes():
    """No text about the infusion has a second in it."""
    texts = [f"{a.evidence} {a.change}" for a in reviewed("drug_infusion")]
    assert not [t for t in texts if " 1/s" in t or " s " in t or "per second" in t]
    assert any(" 1/min" in t for t in texts)


# The half-rule model of Skogestad's process


@pytest.mark.parametrize(("gain", "stable"), [(-1.9, True), pytest.param(-2.4, False, marks=pytest.mark.slow)])
def test_the_limit_of_the_gain_is_that_of_a_run_without_the_valve(gain, stable):
    """The limit holds for every plant of the box, so also for the right model; the lag of the valve alone doubles it."""
    limit = about("half_rule", "gain admissible")
    assert limit.numbers["recommended"] == pytest.approx(-1.08, rel=0.02)
    task = abroad.load("half_rule")
    file = importlib.import_module("abroad.half_rule")
    right = replace(task.problem, reality=None, plant=file.process(1.0), duration=70.0)
    adaptive = file.plain.with_deformation(replace(file.paired, map=fp.Affine(gain=gain)))
    run = fp.simulate(right, fp.Predicted(adaptive, inputs=file.LATE), seed=0, compiled=False)
    swings = np.abs(np.diff(run["command"][-300:, 0])).sum() > 20
    assert swings != stable


def test_the_loop_without_prediction_is_refused_before_a_run():
    """It plans with a dead time of 11 cycles that it does not know of: a pole outside, and a run in a limit cycle."""
    margin = about("half_rule", "margin", "RHC, not predicted", "swinging")
    assert margin.verdict == "no"
    assert margin.numbers["radius"] == pytest.approx(1.0159, abs=1e-3)
    assert about("half_rule", "margin", "RHC").verdict == "yes"


@pytest.mark.slow
def test_a_lag_that_is_stated_costs_nothing_with_the_right_model():
    """What is equal is said to be equal, and not by how many billionths it differs."""
    null = about("half_rule", "right model alone")
    assert null.verdict == "yes"
    assert null.evidence == "run on its own model, rms error of y 0.0627 without adaptation and with it"


# What a review says of the reactor and of a cart behind a dead time with a user's own map, against runs


@pytest.mark.slow
def test_the_reactor_drifts_within_a_cycle():
    """0.43 of the jacket's pole passes in a cycle: with its exact model C_b is thousands of times worse with adaptation.

    Both questions about it are answered no. The model-referenced form leaves C_b as it is.
    """
    task = load("cstr")
    adaptive = task.controllers["RHC+FPI"]
    null = answer(task.problem, adaptive, "right model alone")
    assert null.verdict == "no"
    assert null.numbers["response_with"] > 1e-3
    assert null.numbers["without"] < 1e-4
    assert 0.3 < null.numbers["with"] < 0.6
    run = fp.simulate(task.problem, adaptive, seed=0, compiled=False)
    late = run["error.C_b"][run.time >= task.problem.measure_from]
    assert null.numbers["with"] == pytest.approx(float(np.sqrt(np.mean(late**2))), rel=0.01)
    assert "model-referenced form passes" in null.change
    assert answer(task.problem, adaptive, "lower the response error").verdict == "no"
    referenced = forms_of(task.problem, adaptive.deformation)["model-referenced"]
    assert answer(task.problem, adaptive.with_deformation(referenced), "right model alone").verdict == "yes"


@pytest.mark.parametrize(
    ("name", "verdict"),
    [
        pytest.param("unpaired", "unknown", marks=pytest.mark.slow),
        pytest.param("RHC+FPI", "no", marks=pytest.mark.slow),
        ("RHC+FPI, increment", "yes"),
    ],
)
def test_a_map_of_one_s_own_behind_a_dead_time(name, verdict):
    """Unpaired its gain is beyond 2 sin(pi / 18); paired, the plain form is too slow for the plan; the increment converges.

    The loop of the unpaired map is asked where the map is saturated, so its poles decide nothing; the question about the gain
    does. The increment does not bear a dead time that is wrong by a cycle, because plans are made every four: a run says so.
    """
    task = load("own_map")
    unpaired = importlib.import_module("abroad.own_map").unpaired
    controller = task.controllers.get(name, unpaired)

    def about(words: str) -> fp.Answer:
        one: fp.Answer = answer(task.problem, controller, words)
        return one

    assert about("Does the deformation converge").verdict == verdict
    assert (about("right model alone").verdict == "yes") == (verdict == "yes")
    if name == "unpaired":
        gain = about("gain admissible")
        assert gain.verdict == "no"
        assert 1.5 * gain.numbers["linear_limit"] == pytest.approx(2 * np.sin(np.pi / 18), rel=0.1)
    if name == "RHC+FPI":
        assert about("keep up").verdict == "no"
    if verdict == "yes":
        assert about("wrong by a cycle").numbers["borne"] == 0
        later = fp.DeadTime(inputs={"F": task.problem.dead_time.inputs["F"] + task.problem.period})
        late = fp.simulate(replace(task.problem, dead_time=later), controller, seed=0, compiled=False)
        assert np.abs(late["realised"] - late["desired"])[-400:].max() > 20  # m/s^2; .53 with the dead time as it is
    run = fp.simulate(task.problem, controller, seed=0, compiled=False)
    sizes = np.abs(run["realised"] - run["desired"])[:, 0]
    assert (run.stop is None and sizes[-400:].max() < 0.5 * sizes[:400].max()) == (verdict == "yes")
