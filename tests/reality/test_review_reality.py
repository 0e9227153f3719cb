"""A review of a reality: the loop of the real pair, and the rules of a lag and of a resonance at their edges."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import reviewed
from test_reality import lagged, slow_sensor, task

import fpirhc as fp
from fpirhc.deformation.base import Iteration
from fpirhc.report.html import chart_data
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along
from fpirhc.review.prediction import NominalRuns
from fpirhc.review.questions.margins import MARGINS
from fpirhc.review.questions.reality import LAG, LOOP, RESONANCE, extra_modes, real_loops, real_points

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


def radius(problem: fp.Problem, controller: fp.ComputedTorque) -> float:
    """The largest pole of the real pair."""
    grid = review_grid(problem, 0.0, 0)
    return max(one.radius for one in real_loops(grid, controller))


def test_real_pair_of_the_same_plant_is_the_plant_itself():
    """With the plant as its own reality the linear loop has the poles that the review without a reality finds."""
    plain, real = task(), task(reality=fp.Reality(task().plant))
    controller = adapted(6.0, 0.3)
    expected = np.sort(np.abs(loops_along(review_grid(plain, 0.0, 0), controller).loops[0].poles))
    grid = review_grid(real, 0.0, 0)
    poles = np.sort(np.abs(real_loops(grid, controller)[0].poles))
    assert np.allclose(poles, expected, atol=1e-9)


@pytest.mark.parametrize("order", [1, 2])
def test_lag_rule_at_its_edge(order):
    """(n + 1) Lambda tau < 1: a fast iteration converges 3 % below the edge and not 3 % above it."""
    real: dict[int, Any] = {
        1: lambda q, u, p: {"y": q.F, "F": (u.u - q.F) / p.tau},
        2: lambda q, v, u, p: {"y": q.F, "F": (u.u - q.F) / p.tau},
    }
    law: dict[int, Any] = {1: lambda q, u, p: {"y": p.b * u.u}, 2: lambda q, v, u, p: {"y": p.b * u.u}}
    tau = {"tau": fp.Parameter(TAU, TAU, "s")}
    plant = fp.Plant({"y": "m", "F": "N"}, {"u": "N"}, tau, real[order], order={"y": order, "F": 1})
    model = fp.Plant({"y": "m"}, {"u": "N"}, {"b": fp.Parameter(1.0, 1.0, "1/kg")}, law[order], order=order)
    problem = task(plant=model, reality=fp.Reality(plant), cost=None, horizon=None, period=2e-4)
    edge = 1 / ((order + 1) * TAU)
    assert radius(problem, adapted(0.97 * edge, 1.0)) < 1 < radius(problem, adapted(1.03 * edge, 1.0))
    below, above = (answer(problem, adapted(share * edge, 1.0), LAG) for share in (0.99, 1.01))
    assert below.numbers["lag"] == pytest.approx(TAU, rel=1e-9)
    assert below.numbers["room"] == pytest.approx(0.99, rel=1e-9)
    assert (below.verdict, above.verdict) == ("caution", "no")


def test_margins_of_the_real_pair():
    """With the plant as its own reality they are those of the model; a lag that the model lacks takes phase, 70 to 18 degrees."""
    controller = adapted(6.0, 0.3)
    own, own_plant, late = (
        answer(problem, controller, question).numbers
        for problem, question in (
            (task(), MARGINS),
            (task(reality=fp.Reality(task().plant)), LOOP),
            (task(reality=fp.Reality(lagged())), LOOP),
        )
    )
    for name in ("gain_margin", "phase_margin", "delay_margin"):
        assert own_plant[name] == pytest.approx(own[name], rel=1e-6)
    assert late["phase_margin"] < 0.5 * own["phase_margin"]
    assert late["delay_margin"] < 0.9 * own["delay_margin"]


@pytest.mark.parametrize("damping", [0.2, 0.3])
def test_resonance_rule_within_ten_percent(damping):
    """The limit of the gain that the answer names: the loop converges 10 % below it and not 10 % above it."""
    problem = quick(resonant(damping))
    limit = answer(problem, adapted(6.0, 0.01), RESONANCE).numbers["limit"]
    assert limit == pytest.approx(1e-3 * (2 * damping * FREQUENCY - 3 * 6.0), rel=0.01)
    assert radius(problem, adapted(6.0, 0.9 * limit)) < 1 < radius(problem, adapted(6.0, 1.1 * limit))
    assert answer(problem, adapted(6.0, 1.1 * limit), RESONANCE).verdict == "no"
    assert answer(problem, adapted(6.0, 0.9 * limit), LOOP).verdict == "yes"


def test_law_that_excites_the_resonance_alone():
    """With little damping there is no gain left: 3 Lambda > 2 zeta w0."""
    one = answer(quick(resonant(0.02)), adapted(6.0, 0.01), RESONANCE)
    assert one.verdict == "no"
    assert "the tracking law alone excites it" in one.evidence


def test_loop_question_agrees_with_runs():
    """What it says converges ends with a calm command; what it says grows swings between the limits of the command."""
    problem = task(
        reality=fp.Reality(lagged()), duration=2.0, reference=fp.Trajectory(lambda t: {"y": 0.1 * ca.sin(t)})
    )
    for rate, verdict in ((6.0, "yes"), (60.0, "no")):
        controller = adapted(rate, 0.4)
        assert answer(problem, controller, LOOP).verdict == verdict
        command = fp.simulate(problem, controller, seed=0, compiled=False)["command"][-200:]
        assert (np.ptp(command) < 0.1) == (verdict == "yes")
        assert (np.ptp(command) > 10.0) == (verdict == "no")


def test_slow_sensor_is_a_lag():
    """The pole of the sensor is what the reality has beyond its settled self; the settled gain is that of the plant."""
    grid = review_grid(task(reality=fp.Reality(slow_sensor(0.01), seen={"y": "s"})), 0.0, 0)
    modes = extra_modes(grid, real_points(grid)[0], grid.problem.plant.approximate, Iteration())
    assert modes.poles == pytest.approx([-100.0])
    assert np.abs(modes.eigenvalues) == pytest.approx([2.0], rel=0.01)


def test_what_is_behind_a_spring_moves_along():
    """A load behind a motor: below the resonance the command moves both masses, whatever is measured."""
    load, motor, k = 0.7, 0.3, 300.0**2 * 0.21
    plant = fp.Plant(
        {"y": "m", "motor": "m"},
        {"u": "N"},
        {"m": fp.Parameter(1.0, 1.0, "1")},
        lambda q, v, u, p: {"y": k * (q.motor - q.y) / load, "motor": (u.u - k * (q.motor - q.y)) / motor},
    )
    grid = review_grid(quick(plant), 0.0, 0)
    modes = extra_modes(grid, real_points(grid)[0], grid.problem.plant.approximate, Iteration())
    assert sorted(modes.poles.imag) == pytest.approx([-300.0, 300.0])
    assert np.abs(modes.eigenvalues) == pytest.approx([1 / (load + motor)], rel=0.01)


def test_no_question_without_a_reality():
    assert not any(reviewed.answer(task(), adapted(6.0, 0.3), text) for text in (LAG, LOOP, RESONANCE))


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


def test_null_runs_are_those_of_the_model():
    """Adaptation has nothing to do on the right model, whatever the reality is: the model-referenced form adds nothing."""
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.ModelReferenced(fp.Affine(gain=-0.5)))
    problem = task(reality=fp.Reality(lagged()), cost=None, horizon=None)
    models = NominalRuns(problem)
    assert models.model.of(controller).reality is None
    runs = models.null(controller)
    assert runs.adapted["y"] == pytest.approx(runs.without["y"], rel=1e-9)


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
