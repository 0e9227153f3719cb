"""The null test of a review: with its own model as the plant a controller with adaptation must not do worse than without."""

from __future__ import annotations

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from reviewed import answer
from test_review_laws import moving

import fpirhc as fp
from fpirhc.deformation import Deformation
from fpirhc.review.prediction import NominalRuns
from fpirhc.review.question import Verdict
from fpirhc.review.questions.right_model import forms_of, map_inside

POLE = 86.7  # 1/s
MAP = fp.Affine(gain=-1.0)


def drifting(period: float, *, exact: float = POLE, wrong: float = POLE) -> fp.Problem:
    """Y' = -p y + p u behind a pole that is fast against the period, along a sine."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "m"},
        order=1,
        parameters={"p": fp.Parameter(wrong, exact, "1/s")},
        response=lambda y, u, p: {"y": p.p * (u.u - y.y)},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"y": ca.sin(8 * t)}),
        start={"y": 0.0},
        period=period,
        duration=2.0,
        horizon=fp.Horizon(stages=10, step=0.005),
        cost=fp.Quadratic(states={"y": 1.0}, deviation={"u": 1e-3}),
        measure_from=1.0,
    )


def planned(deformation: Deformation | None = None) -> fp.RecedingHorizon:
    """A plan with a deformation."""
    optimiser = fp.FixedPoint(iterations=1, tolerance=1e-3)
    return fp.RecedingHorizon(optimiser) if deformation is None else fp.RecedingHorizon(optimiser, deformation)


def alone(problem: fp.Problem, controller: fp.RecedingHorizon | fp.ComputedTorque) -> fp.Answer:
    """The answer to the null test."""
    one: fp.Answer = answer(problem, controller, "right model alone")
    return one


def rms(problem: fp.Problem, controller: fp.RecedingHorizon | fp.ComputedTorque) -> float:
    """Rms tracking error of a run."""
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    assert run.stop is None
    return float(np.sqrt(np.mean(run["error"][run.time >= problem.measure_from] ** 2)))


@pytest.mark.slow
def test_a_period_that_is_long_against_the_plant_fails():
    """P T = 0.43: the plain form takes the drift within a cycle for an error. The answer has the errors that runs show."""
    problem = drifting(0.005)
    answer = alone(problem, planned(MAP))
    assert answer.verdict == "no"
    assert answer.numbers["without"] == pytest.approx(rms(problem, planned()), rel=0.02)
    assert answer.numbers["with"] == pytest.approx(rms(problem, planned(MAP)), rel=0.02)
    assert answer.numbers["with"] > 5 * answer.numbers["without"]
    assert answer.numbers["response_with"] > 0
    assert "model-referenced form passes: in a run of at most 1000 cycles the rms error of y is " in answer.change
    told, passed = (float(words.split()[0]) for words in answer.change.split(" is ")[1].split(" adaptation, "))
    assert passed == pytest.approx(told, rel=0.01)


def test_the_form_that_passes_passes():
    """The advice is followed: yes, and equal to no adaptation to rounding. The wrong model is what the null test must not see."""
    problem = drifting(0.005, exact=0.8 * POLE)
    answer = alone(problem, planned(fp.ModelReferenced(MAP)))
    assert answer.verdict == "yes"
    model = drifting(0.005)
    assert rms(model, planned(fp.ModelReferenced(MAP))) == pytest.approx(rms(model, planned()), rel=1e-9)


def test_the_period_that_is_named_would_do():
    """At the named period, rounded to a part of the stage, the same form passes."""
    answer = alone(drifting(0.005), planned(MAP))
    times = math.ceil(0.005 / answer.numbers["period"])
    assert 2 <= times <= 20
    assert alone(drifting(0.005 / times), planned(MAP)).verdict == "yes"


def test_masses_that_do_not_drift_pass():
    """A mass without a spring has no drift within a cycle: the plain form leaves a right model as it is."""
    assert alone(moving(1.5), fp.ComputedTorque(fp.Exponential(rate=20.0), fp.Affine(gain=-1.0))).verdict == "yes"


def test_dead_time_that_is_not_paired_fails():
    """The prediction does not cover dead time; the runs do. An outer loop that does not converge is not the deformation's fault."""
    late = replace(moving(), dead_time=fp.DeadTime(inputs={"u": 0.01}))
    wrong = alone(late, fp.ComputedTorque(fp.Exponential(rate=5.0), fp.Affine(gain=-0.4)))
    assert wrong.verdict == "no"
    assert "response_with" not in wrong.numbers
    assert "form passes" in wrong.change
    outer = alone(late, fp.ComputedTorque(fp.Exponential(rate=200.0), fp.Affine(gain=-0.4)))
    assert outer.verdict == "unknown"
    assert "without adaptation" in outer.evidence


def test_forms_are_around_the_map_itself():
    """Forms are taken off and put on; they are told the dead times of the problem."""
    late = replace(drifting(0.005), dead_time=fp.DeadTime(inputs={"u": 0.01}, measurement=0.005))
    inner = fp.Filtered(MAP, pole=0.3)
    for form in (fp.Increment(inner, cycles=0), fp.ModelReferenced(inner), fp.Paired(inner, cycles=2), inner):
        assert map_inside(form) == inner
    forms = forms_of(late, inner)
    assert forms == {
        "increment": fp.Increment(inner, cycles=3.0),
        "model-referenced": fp.ModelReferenced(inner, cycles=2.0, measurement=1.0),
    }
    assert list(forms_of(drifting(0.005), inner)) == ["plain", "increment", "model-referenced"]


def test_errors_of_rounding_are_called_so():
    """A motor held at its speed with a right model: 4e-15 without adaptation and 4e-14 with it are no errors."""
    task = fp.load_problem("noisy_motor")
    found = answer(task.problem, task.controllers["RHC+FPI"], "right model alone")
    assert found.verdict == Verdict.YES
    assert found.evidence == (
        "run on its own model, rms error of speed 0 to rounding without adaptation and with it, without noise and disturbances"
    )


def test_targets_that_cure_more_than_they_spoil_do_no_harm():
    """A heat exchanger: on a right model .135 K after .037, with the wrong one .066 after .69; no other form can be tried."""
    task = fp.load_problem("heat_exchanger")
    found = answer(task.problem, task.controllers["Cascade, last target"], "right model alone")
    assert found.verdict == Verdict.CAUTION
    assert found.evidence.endswith("+4.1 % of its range, less than what the wrong model costs without it")
    assert found.change == "Change the gain, or leave the deformation out."


def test_a_null_test_of_commands_at_a_limit_has_the_exact_values():
    """A wrong map asks for more than the light lets in, the exact one does not; where both do, equal errors are no yes."""
    task = fp.load_problem("problems/gallery/freeway.py")
    one = answer(task.problem, task.controllers["static map+FPI"], "right model alone")
    assert one.verdict == "yes"
    assert one.evidence == (
        "the model has the exact values here, because with its own the command stands at a limit; "
        "run on its own model, rms error of emission 0 to rounding without adaptation and with it"
    )
    low = replace(task.problem, limits=fp.Limits(inputs={"r": (0.0, 0.15)}), input_before={"r": 0.1})
    one = answer(low, task.controllers["static map+FPI"], "right model alone")
    assert one.verdict == "unknown"
    assert "stands at a limit in 100 % of the cycles, where no adaptation can act" in one.evidence
    assert one.change == "Run it where the commands are free."


def test_a_null_test_goes_on_until_errors_count():
    """The input is too weak for the start, so the first 2000 cycles show nothing; the plain form disturbs a right model later."""
    plant = fp.Plant(
        {"y": "m"}, {"u": "m/s"}, {"b": fp.Parameter(1.0, 1.5, "1")}, lambda y, u, p: {"y": p.b * u.u}, order=1
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"y": 0.1 * ca.sin(t)}),
        start={"y": 1.0},
        period=1e-3,
        duration=10.0,
        limits=fp.Limits(inputs={"u": (-0.4, 0.4)}),
        measure_from=8.0,
    )
    law = fp.ComputedTorque(fp.Exponential(rate=5.0, integral=False, bumpless=False), fp.Affine(gain=-0.05))
    assert NominalRuns(replace(problem, duration=2.0, measure_from=1.0)).null(law).stuck
    found = NominalRuns(problem).null(law)
    assert not found.stuck
    right = replace(problem, plant=replace(plant, parameters={"b": fp.Parameter(1.0, 1.0, "1")}))
    pair = [
        fp.measure(right, fp.simulate(right, one, seed=0, compiled=False)).rms_error["y"]
        for one in (fp.ComputedTorque(law.tracking), law)
    ]
    assert [found.without["y"], found.adapted["y"]] == pytest.approx(pair, rel=1e-6)
