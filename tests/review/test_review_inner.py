"""What a review states about what moves by itself: inner states, neutral ones, and filters that estimate what the model lacks."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from plants import heavy
from reviewed import answer

import fpirhc as fp
from fpirhc.review.grid import inner_motion, inner_places, review_grid
from fpirhc.review.questions.convergence import rates_inside, zero_dynamics
from fpirhc.review.questions.margins import SLOWER
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


@pytest.mark.parametrize(
    ("rate", "controller", "verdict", "begin"),
    [
        (-32.9, LAW, "yes", "stable: while the reference is followed they decay at 32.9 1/s"),
        (309.0, LAW, "no", "unstable: while the reference is followed they grow at up to 309 1/s"),
        (-32.9, PLAN, "yes", "stable: while the reference is followed they decay at 32.9 1/s"),
        (19.0, PLAN, "no", "unstable: while the reference is followed they grow at up to 19 1/s"),
        (0.0, LAW, "yes", "the slowest of them neither grows nor decays"),
        (0.0, PLAN, "yes", "the slowest of them neither grows nor decays"),
    ],
)
def test_zero_dynamics_have_a_rate_and_a_sign(rate, controller, verdict, begin):
    """The rate is an eigenvalue by construction; a neutral one that nothing reads is no fault."""
    one = answer(companion(rate), controller, "zero dynamics")
    assert (one.verdict, one.evidence[: len(begin)]) == (verdict, begin)
    assert one.numbers["rate"] == pytest.approx(rate, abs=1e-9)


def test_unstable_zero_dynamics_that_a_plan_holds_are_told_as_both():
    """The answer is yes, and its evidence does not begin with the opposite."""
    held: Any = SimpleNamespace(loops=(None,), radii=np.array([0.99]), learns=False)
    one = zero_dynamics(companion(19.0), 19.0, True, held)
    assert one.verdict == "yes"
    assert one.evidence == (
        "unstable by themselves and held by the plan: while the reference is followed they grow at up to 19 1/s; the slowest mode "
        "of the linear loop is multiplied by 0.99 per cycle"
    )


@pytest.mark.parametrize(
    ("rate", "planned", "radius", "learns", "verdict"),
    [
        (19.0, True, 0.999, False, "yes"),  # the plan holds them
        (19.0, True, 1 + 1e-9, False, "caution"),  # a mode that neither grows nor decays
        (19.0, True, 1.0003, False, "caution"),  # growth of 8 % over the 250 cycles of the run does not show
        (19.0, True, 1.01, False, "no"),
        # By themselves they grow by 5 % in the run, and no plan needs to hold them.
        (0.01, True, 1.01, False, "caution"),
        (19.0, True, 1.01, True, "unknown"),  # what learns changes the loop
        (1e-6, False, 1.01, False, "caution"),  # neutral
        (19.0, False, 0.9, False, "no"),  # a law that does not see them holds none
        (0.01, False, 1.01, False, "unknown"),
        (-1.0, True, 1.01, False, "yes"),
    ],
)
def test_zero_dynamics_that_grow_are_a_no_where_nothing_holds_them_and_the_run_shows_it(
    rate, planned, radius, learns, verdict
):
    found: Any = SimpleNamespace(loops=(None,), radii=np.array([0.9, radius]), learns=learns)
    assert zero_dynamics(companion(rate), rate, planned, found).verdict == verdict


@pytest.mark.parametrize(
    ("rate", "radius", "verdict", "change"),
    [
        (-32.9, 0.999, "yes", ""),
        (-32.9, 1.0 + 1e-9, "caution", "A mode neither grows nor decays"),
        (-32.9, 1.2, "no", "Lower the rate, or shorten the period."),
        (19.0, 1.4, "caution", "It is the mode of the zero dynamics"),  # e^(19 x .02) = 1.46
        (19.0, 1.6, "no", "Lower the rate, or shorten the period."),
    ],
)
def test_the_ideal_loop_says_whether_the_sampling_is_fast_enough(rate, radius, verdict, change):
    """A mode that grows faster than the zero dynamics is the law's, and a slower one theirs."""
    loops: Any = SimpleNamespace(ideal=SimpleNamespace(radius=radius), reason="")
    one = rates_inside(review_grid(companion(rate), 0.0, 0), LAW, loops)
    assert (one.verdict, one.change[: len(change)]) == (verdict, change)
    assert (one.numbers["ideal_radius"], one.numbers["rate_period"]) == pytest.approx((radius, 0.04))
    assert bool(one.change) == bool(change)


@pytest.mark.parametrize("rate", [19.0, -32.9])
def test_a_plan_that_is_tracked_has_the_sign_too(rate):
    """A plan that is restarted and tracked holds no state that its cost does not weigh: stable is yes, unstable is no."""
    tracked = replace(PLAN, replanning=fp.FromMeasurementTracked(fp.Exponential(rate=2.0)))
    one = answer(companion(rate), tracked, "zero dynamics")
    assert one.verdict == ("yes" if rate < 0 else "no")
    assert f"{abs(rate):.3g} 1/s" in one.evidence


@pytest.mark.parametrize("controller", [LAW, PLAN])
@pytest.mark.parametrize("words", ["sampling fast enough", "margin"])
def test_an_integral_that_nobody_judges_is_no_fault(controller, words):
    """It stays where it is put, and no judged coordinate shows it; the horizon is not said to diverge either."""
    one = answer(companion(0.0), controller, words)
    assert one.verdict == "yes", one
    assert answer(companion(0.0), controller, "horizon long").verdict == "yes"


def test_an_integral_that_is_judged_is_not_called_stable():
    """The same integral among the judged coordinates: its error stays, which is no yes."""
    assert answer(companion(0.0, judged=("y", "z")), LAW, "zero dynamics").verdict == "caution"
    assert answer(companion(0.0, judged=("y", "z")), LAW, "margin").verdict == "caution"


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


def in_tissue(t: np.ndarray, k: float) -> np.ndarray:
    """Solution of z' = k (2 + sin t - z), z(0) = 0."""
    particular = 2 + k * (k * np.sin(t) - np.cos(t)) / (k**2 + 1)
    return np.asarray(particular - (2 - k / (k**2 + 1)) * np.exp(-k * t))


@pytest.mark.parametrize("invented", [0.0, 40.0])
def test_states_without_a_task_are_where_the_plant_takes_them(invented):
    """The tissue fills by its own equation whatever its reference is, and the commands are those of this motion."""
    grid = review_grid(tissue(invented), 20.0, 0)
    assert grid.inner == (1,)
    for k, states, commands in zip(grid.draws[:, 1], grid.drawn_states, grid.commands, strict=True):
        assert states[:, 1] == pytest.approx(in_tissue(grid.times, k), abs=1e-5)
        assert np.isfinite(commands).all()
    y, t = 2 + np.sin(grid.times), grid.times
    assert grid.commands[0, :, 0] == pytest.approx(np.cos(t) + y - in_tissue(t, 0.5), abs=1e-5)
    assert grid.states_at(np.array([3.3]))[0] == pytest.approx(
        [2 + np.sin(3.3), float(in_tissue(np.array(3.3), 0.5))], abs=1e-4
    )
    well = answer(tissue(invented), None, "well posed")
    assert well.evidence.endswith("z has no task and is simulated")


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


@pytest.mark.parametrize(("name", "most"), [("stick_slip", 0.7), ("turbojet", 0.8)])
def test_parameters_of_a_plant_stay_together(name, most):
    """Bristles and the friction that they carry are wrong together: the box needs little more than the plant itself."""
    task = fp.load_problem(f"problems/gallery/{name}.py")
    one = answer(task.problem, None, "commands")
    assert one.verdict == "yes"
    assert one.numbers["share_over_box"] < most


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


def unstable_inverse(target: Any) -> fp.Problem:
    """Y = x1 - x2 of two lags with 1 and 3 1/s: the zero is at +1 1/s, so no input holds y that stays finite."""
    plant = fp.Plant.of_states(
        states={"x1": "m", "x2": "m"},
        inputs={"u": "m"},
        rates=lambda x, u, p: {"x1": p.k * u.u - x.x1, "x2": 2 * 3 * p.k * u.u - 3 * x.x2},
        outputs={"y": fp.Output("m", lambda x, p: x.x2 - x.x1 * 3)},
        parameters={"k": fp.Parameter(1.1, 1.0, "1/s")},
    )
    return fp.Problem(
        plant=plant, reference=fp.Trajectory(target), start={"x1": 0.1, "x2": 0.0}, period=0.02, duration=200.0
    )


def test_a_held_reference_has_a_rest_where_its_inverse_runs_away():
    """At rest x1 = k u, x2 = 2 k u and y = -k u; the draws have their own inputs, and a moving reference has no rest."""
    times = np.linspace(0.0, 200.0, 5)
    held = unstable_inverse(lambda t: {"y": 2.0 + 0 * t})
    for gain, states in zip((1.0, 0.5), inner_motion(held, (0, 1), np.array([[1.0], [0.5]]), times), strict=True):
        assert states is not None, gain
        np.testing.assert_allclose(states, np.tile([-2.0, -4.0], (5, 1)), rtol=1e-9)
    moving = unstable_inverse(lambda t: {"y": 2.0 + ca.sin(t)})
    [one] = inner_motion(moving, (0, 1), np.array([[1.0]]), times)
    assert one is None or np.abs(one).max() > 1e9
    assert "x1, x2 are where the plant rests on the reference" in answer(held, PLAN, "well posed").evidence


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


def test_a_filter_with_little_margin_is_told_to_learn_more_slowly():
    """Its margin is that of the gain L; the rate of the law around it is not the cause."""
    answers = review(cart(1.7), {"filter": FILTER}, mismatch=0.0, seed=0).controllers["filter"]
    [margin] = [one for one in answers if "gain_margin" in one.numbers]
    assert margin.verdict == "caution"
    assert margin.change == SLOWER
