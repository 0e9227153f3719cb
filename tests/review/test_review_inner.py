"""What a review states about what moves by itself: inner states, neutral ones, and filters that estimate what the model lacks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from plants import heavy

import fpirhc as fp
from fpirhc.review.grid import inner_motion, inner_places, review_grid
from fpirhc.review.review import review

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


def test_times_have_the_unit_of_the_problem():
    """Rates, delays and horizons of a problem in minutes are in minutes."""
    problem = companion(-0.5)
    problem = replace(problem, plant=replace(problem.plant, time_unit="min"))
    every = fp.review(problem, {"it": LAW}, mismatch=0.0, seed=0).answers
    text = " ".join(a.evidence for a in every)
    assert "0.4 min" in text
    assert "0.5 1/min" in text
    assert " s " not in text
    assert " 1/s" not in text


# Inner states without a task


def tissue(invented: float, **settings: Any) -> fp.Problem:
    """A drug in the blood, y' = u - y + z, and in a tissue, z' = (y - z) / 2; the reference of the tissue is invented."""
    plant = fp.Plant(
        coordinates={"y": "mg/l", "z": "mg/l"},
        inputs={"u": "mg/l/h"},
        order=1,
        controlled=("y",),
        time_unit="h",
        parameters={"a": fp.Parameter(1.5, 1.0, "1/h"), "k": fp.Parameter(1.0, 0.5, "1/h")},
        response=lambda q, u, p: {"y": u.u - p.a * q.y + q.z, "z": p.k * (q.y - q.z)},
    )
    usual: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {"y": 2 + ca.sin(t), "z": invented + 0 * t}),
        "start": {"y": 2.0, "z": 0.0},
        "period": 0.02,
        "duration": 12.0,
    }
    return fp.Problem(plant=plant, **(usual | settings))


@pytest.mark.parametrize(
    "settings",
    [
        {"judged": ("y", "z")},
        {
            "horizon": fp.Horizon(stages=5, step=0.1),
            "cost": fp.Quadratic(states={"y": 1.0, "z": 0.1}, effort={"u": 1e-3}),
        },
    ],
)
def test_states_with_a_task_are_on_their_reference(settings):
    """A judged or a weighed state has a reference that is meant."""
    grid = review_grid(tissue(1.0, **settings), 0.0, 0)
    assert inner_places(grid.problem) == ()
    assert (grid.drawn_states[..., 1] == 1.0).all()


def test_states_that_leave_every_bound_are_left_on_the_reference(capfd):
    """The motion z' = z^2 + y escapes in finite time, and the integrator tells the terminal nothing of its attempts."""
    plant = fp.Plant(
        coordinates={"y": "m", "z": "m"},
        inputs={"u": "m/s"},
        order=1,
        controlled=("y",),
        parameters={"a": fp.Parameter(1.2, 1.0, "1/s")},
        response=lambda q, u, p: {"y": u.u - p.a * q.y, "z": q.z**2 + q.y},
    )
    problem = replace(companion(-1.0), plant=plant)
    assert inner_motion(problem, [1], plant.exact[None, :], np.array([0.0, 5.0])) == [None]
    grid = review_grid(problem, 0.0, 0)
    assert grid.inner == ()
    assert (grid.states[:, 1] == 0).all()
    assert capfd.readouterr() == ("", "")


def test_currents_of_the_nerve_cell_are_those_of_a_run():
    """The gates move with the voltage: the exact model's commands in a run without a pulse, and not those of gates at rest."""
    task = fp.load_problem("problems/gallery/hodgkin_huxley.py")
    problem = replace(task.problem, disturbances={}, start={**task.problem.start, "V": -65.0})
    run = fp.simulate(problem, fp.ExactModel(fp.ComputedTorque(fp.Exponential(rate=1.0))), seed=0)
    grid = review_grid(problem, 0.0, 0)
    needed = grid.commands[0, 1:-1, 0]
    issued = np.interp(grid.times[1:-1], run.time, run["command"][:, 0])
    assert needed == pytest.approx(issued, abs=1.0)
    assert (needed.min(), needed.max()) == pytest.approx((-43.6, 71.4), abs=0.2)


def test_draws_are_between_the_range_and_the_model():
    """Every draw is a mean of a point of the range and the approximate parameters, with one weight for all parameters."""
    problem = tissue(0.0)
    for mismatch, spread in ((0.0, 0.0), (20.0, 0.2)):
        draws = review_grid(problem, mismatch, 3).draws
        assert any(np.array_equal(row, problem.plant.approximate) for row in draws)
        for row in draws:
            # p - s p_approximate = (1 - s) p_exact (1 + d) with |d| within the mismatch, for some s that both share
            shares = np.linspace(0.0, 1.0, 2001)[:-1]
            rests = row - shares[:, None] * problem.plant.approximate
            deviations = rests / ((1 - shares[:, None]) * problem.plant.exact) - 1
            fits = (np.abs(deviations) <= spread + 1e-2).all(axis=1)
            assert fits.any() or np.array_equal(row, problem.plant.approximate)


def test_a_filter_that_works_is_not_refused_for_a_state_that_nobody_reads():
    """An integral that is not measured leaves the rank condition of the rest alone: the filter removes the offset in a run."""
    problem = replace(companion(0.0), disturbances={"y": fp.Step(at=1.0, size=0.5)}, measure_from=3.0)
    free = fp.Estimating(PLAN, fp.DisturbanceKalman(drift={"y": 10.0}, measured={"y": 1e-3}))
    every = fp.review(problem, {"free": free}, mismatch=0.0, seed=0).answers
    assert not [a for a in every if "fit the problem" in a.question]
    errors = [fp.simulate(problem, one, seed=0)["error"][150:] for one in (PLAN, free)]
    assert np.abs(errors[1]).max() < 0.1 * np.abs(errors[0]).max()


@pytest.mark.parametrize(("rate", "settings"), [(0.0, {"judged": ("y", "z")}), (0.2, {})])
def test_a_filter_is_refused_for_a_state_that_is_judged_or_grows(rate, settings):
    """What nothing measured depends on must be harmless."""
    free = fp.Estimating(PLAN, fp.DisturbanceKalman(drift={"y": 10.0}, measured={"y": 1e-3}))
    every = fp.review(companion(rate, **settings), {"free": free}, mismatch=0.0, seed=0).answers
    [refused] = [a for a in every if "fit the problem" in a.question]
    assert refused.verdict == "no"


# A filter that estimates what the model lacks is judged with the loop: it is the iteration, and has its limit


DEVIATIONS = {"y''": 1e-3, "y'": 1.0, "y": 1.0}  # the response is measured far better: L is near 1


def cart(gain: float) -> fp.Problem:
    """A mass whose response is `gain` times the model's."""
    sine = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    return fp.Problem(heavy(1.0, 1 / gain, q="y"), sine, start={"y": 0.0}, period=1e-2, duration=5.0)


def spring(gain: float) -> fp.Problem:
    """The same with a spring and a damper that the model has half."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(1.0, 1 / gain, "kg"), "k": fp.Parameter(2.0, 4.0, "N/m")},
        response=lambda q, v, u, p: {"y": (u.u - p.k * q.y - 0.1 * p.k * v.y) / p.m},
    )
    return replace(cart(gain), plant=plant)


COMPUTED = fp.ComputedTorque(fp.Exponential(3.0))
FILTER = fp.Estimating(COMPUTED, fp.DisturbanceKalman({"y": 1.0}, DEVIATIONS), at_once=True)


@pytest.mark.parametrize(("gain", "stable"), [(0.5, True), (1.5, True), (1.9, True), (2.1, False), (3.0, False)])
def test_a_filter_of_the_response_has_the_limit_of_the_iteration(gain, stable):
    """With L near 1 the factor per cycle is 1 - L gain: no beyond a gain of 2 / L, and the gain margin is the rest up to there."""
    problem = cart(gain)
    answers = review(problem, {"filter": FILTER}, mismatch=0.0, seed=0).controllers["filter"]
    [numbers] = [one.numbers for one in answers if "radius" in one.numbers and "margin" in one.question]
    assert (numbers["radius"] < 1) == stable
    assert (fp.simulate(problem, FILTER, seed=0, compiled=False).stop is None) == stable
    if gain > 1:
        assert any(one.verdict == "no" for one in answers) != stable
    if stable and gain > 1:
        assert gain * numbers["gain_margin"] == pytest.approx(1.92, rel=0.01)  # the law around it takes 4 % of 2 / L


@pytest.mark.parametrize("drift", [1e-3, 1.0])
@pytest.mark.parametrize("gain", [0.5, 1.0, 1.9])
def test_a_filter_of_responses_alone_is_the_model_referenced_form_of_its_gain(gain, drift):
    """It has the measured state in place of one of its own: commands are equal to rounding, whatever the model lacks."""
    problem = spring(gain)
    kalman = fp.DisturbanceKalman({"y": drift}, {"y''": 1e-4})
    alone = fp.Estimating(COMPUTED, kalman, at_once=True)
    filtered = kalman.gain(alone.inner_problem(problem))
    assert not filtered[:2].any()
    form = fp.ComputedTorque(COMPUTED.tracking, fp.ModelReferenced(fp.Affine(-2 * filtered[2, 0])))
    one, other = (fp.simulate(problem, c, seed=0, compiled=False) for c in (alone, form))
    assert np.abs(one["command"] - other["command"]).max() < 1e-12 * np.abs(one["command"]).max()
