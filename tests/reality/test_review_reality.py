"""A review of a reality: the loop of the real pair, and the rules of a lag and of a resonance at their edges."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import reviewed
from test_reality import lagged, task

import fpirhc as fp
from fpirhc.report.html import chart_data

TAU, FREQUENCY = 0.02, 300.0  # s, rad/s


def resonant(damping: float) -> fp.Plant:
    """Y'' = f with f'' = w0^2 (u - f) - 2 zeta w0 f'."""
    return fp.Plant(
        coordinates={"y": "m", "f": "m/s^2"},
        inputs={"u": "N"},
        parameters={"zeta": fp.Parameter(damping, damping, "1")},
        response=lambda q, v, u, p: {"y": q.f, "f": FREQUENCY**2 * (u.u - q.f) - 2 * p.zeta * FREQUENCY * v.f},
    )


def adapted(rate: float, gain: float) -> fp.ComputedTorque:
    """The increment form with an effective gain."""
    return fp.ComputedTorque(fp.Exponential(rate=rate), fp.Increment(fp.Affine(gain=-2 * gain), cycles=0))


def quick(plant: fp.Plant, **settings: Any) -> fp.Problem:
    """The model y'' = u beside a reality."""
    return task(
        plant=fp.Plant(
            {"y": "m"}, {"u": "N"}, {"b": fp.Parameter(1.0, 1.0, "1/kg")}, lambda q, v, u, p: {"y": p.b * u.u}
        ),
        reality=fp.Reality(plant, integrator=fp.RungeKutta4(4)),
        **settings,
    )


def answer(problem: fp.Problem, controller: fp.ComputedTorque, question: str) -> fp.Answer:
    """The answer to one question of a review."""
    one: fp.Answer = reviewed.answer(problem, controller, question)
    return one


def test_review_names_an_exact_model_that_cannot_be():
    answers = fp.review(quick(resonant(0.3)), {"it": fp.ExactModel(adapted(6.0, 0.01))}, mismatch=0.0, seed=0)
    [only] = answers.controllers["it"]
    assert "the coordinate f, which the controller is not given" in only.evidence


def test_comparison_shows_belief_beside_reality():
    """The page's charts have the force that the model does not know, and expected and real responses; not so without a reality."""
    problem = task(reality=fp.Reality(lagged()))
    pair = {"CTC": fp.ComputedTorque(fp.Exponential(rate=6.0)), "CTC+FPI": adapted(6.0, 0.1)}
    titles = {}
    for name, one in {"real": problem, "model": problem.of_model}.items():
        shipped = fp.load_problem("two_mass")
        file = replace(shipped, problem=one, controllers=pair, headline=("CTC", "CTC+FPI"))
        comparison = fp.compare(file, seed=0, compiled=False)
        titles[name] = [chart["title"] for chart in chart_data(comparison)["charts"]]
        factor = comparison.entries[1].metrics.values["contraction.predicted"][""]
        reached = 1 - np.exp(-1e-3 / 0.01) if name == "real" else 1.0
        assert factor == pytest.approx(1 - 0.1 * 2.0 * reached, abs=1e-6)
    assert {"reality: F", "CTC+FPI: response of y, observer and reality"} <= set(titles["real"]) - set(titles["model"])


def test_comparison_shows_the_responses_of_slots_that_a_reality_has():
    """Behind encoders the response of the slot on q1 is found from samples, and the log has that of the controlled q2 alone."""
    file = fp.load_problem("mass_spring_slots")
    sensing, real = fp.Sensing(estimator=fp.PositionDifference()), fp.Reality(file.problem.plant)
    problem = replace(
        file.problem, reality=real, sensing=sensing, horizon=None, cost=None, duration=0.5, measure_from=0.0
    )
    names = "slots", "slots+FPI"
    file = replace(file, problem=problem, controllers={n: file.controllers[n] for n in names}, headline=names)
    charts = chart_data(fp.compare(file, seed=0, compiled=False))["charts"]
    titles = {chart["title"] for chart in charts}
    assert "slots+FPI: response of q2, observer and reality" in titles
    assert {"slots+FPI: responses of q1", "slots+FPI: responses of q2"} < titles


def test_pole_that_is_fast_away_from_the_start():
    """An actuator whose lag shrinks with its force is followed at the start, not on the way, and then with the sub-steps named."""

    def response(q, v, u, p):
        return {"y": p.b * q.F, "F": (u.u - q.F) * (100 + 3000 * q.F**2)}

    plant = replace(lagged(), response=response)
    coarse = task(reality=fp.Reality(plant), start={"y": 0.0, "y'": 3.0})
    one = reviewed.answer(coarse, None, "reality")
    assert one.verdict == "no"
    assert "makes it grow" in one.evidence
    substeps = int(one.change.split("substeps=")[1].split(")")[0])
    fine = replace(coarse, reality=fp.Reality(plant, integrator=fp.RungeKutta4(substeps)))
    two = reviewed.answer(fine, None, "reality")
    assert two.verdict == "yes"


def test_a_right_parameter_is_no_right_model():
    """Beside a reality the exact parameters of the model move nothing, and two runs on the reality answer in their place."""
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.5, scale=50.0))
    real = quick(resonant(0.8))
    for question in ("Does adaptation lower the response error?", "Does the deformation reach the wrong parameters?"):
        beside, alone = (answer(one, controller, question) for one in (real, replace(real, reality=None)))
        assert "run" in beside.evidence
        assert "run" not in alone.evidence
        assert str(alone.verdict) != "unknown"
        assert beside.numbers["with"] != beside.numbers["without"]
