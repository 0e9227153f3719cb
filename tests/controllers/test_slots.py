"""Time slots: stability of schedules, relative orders, continuity at switches, and what is refused."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
import tasks
from forms import FORMS
from plants import pendulum
from plants import simulated as run

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.controllers.base import Controller
from fpirhc.controllers.slots.schedules import Schedule
from fpirhc.controllers.slots.slot import output_chain
from fpirhc.controllers.slots.slotted import floquet_radius
from fpirhc.errors import FpirhcError, InvalidProblem, InvalidValue
from fpirhc.review.review import schedule_stable
from fpirhc.status import Status
from fpirhc.symbolic.layout import Named

# Slots and schedules of shipped controllers are read and changed, which the contract of controllers says nothing about.

SHIPPED: Any = tasks


def crane(start: dict[str, float], **changes: Any) -> fp.Problem:
    """The crane from another start, measured from the first cycle."""
    values = {e: start.get(e, 0.0) for e in SHIPPED.crane_slots.problem.plant.state.elements}
    return replace(SHIPPED.crane_slots.problem, start=values, measure_from=0.0, **changes)


def switches(run_: fp.Run) -> np.ndarray:
    """First cycles of all slots but the first."""
    return np.flatnonzero(np.diff(run_["slot"][:, 0])) + 1


# Stability of a schedule


def test_crane_schedule_is_stable_although_no_slot_is():
    """The pendulum swings undamped in a cart slot, the cart rolls on in an angle slot; one period shrinks both."""
    slots = SHIPPED.crane_slots.controllers["slots"]
    floquet = floquet_radius(SHIPPED.crane_slots.problem, slots.slots, slots.schedule, blend=slots.blend)
    assert floquet.radius == pytest.approx(0.0485, abs=5e-4)
    assert floquet.period == pytest.approx(5.3)
    for values in floquet.eigenvalues.values():
        assert values.real.max() == pytest.approx(0.0, abs=1e-6)


def period_map(problem: fp.Problem, controller: Controller, period: float) -> np.ndarray:
    """The linear map of state and last command over one period of the schedule, from runs with one entry disturbed.

    It is taken from the second period on, since a run's first slot begins without an offset; the integral and the offset
    that the next slot begins with follow from state and last command.
    """
    size, cycles, names = 1e-4, round(period / problem.period), problem.plant.state.elements
    before, after = [], []
    for name in names:
        result = run(replace(problem, start={e: size * (e == name) for e in names}), controller)
        at = np.arange(cycles, result.cycles, cycles)
        ends = np.hstack([result["state"][at], result["command"][at - 1]]) / size
        before.append(ends[:-1])
        after.append(ends[1:])
    return np.linalg.lstsq(np.vstack(before), np.vstack(after), rcond=1e-9)[0].T


def test_nonlinear_run_shrinks_by_the_floquet_radius():
    """Near the set-point, by the wrong model with the deformation: 0.0493 at 5 ms and 0.0487 at 1 ms for 0.0485."""
    slots = SHIPPED.crane_slots.controllers["slots+FPI"]
    radius = floquet_radius(SHIPPED.crane_slots.problem, slots.slots, slots.schedule, blend=slots.blend).radius
    away = []
    for period in (5e-3, 1e-3):
        problem = crane({}, period=period, duration=10.6 + 2 * period, limits=fp.Limits())
        result = np.abs(np.linalg.eigvals(period_map(problem, slots, 5.3))).max()
        away.append(abs(result / radius - 1))
    assert away[0] < 0.03
    assert away[1] < 0.01


@pytest.mark.parametrize(
    ("of_cart", "of_angle", "blend", "radius"),
    [(True, False, 1.0, 0.150), (False, True, 0.5, 1.266), (True, True, 0.5, 1.460)],
)
def test_integrals_and_offsets_are_part_of_the_radius(of_cart, of_angle, blend, radius):
    """A slow offset, and an integral that starts anew, change the radius from 0.0485 to either side of 1; the run agrees."""
    slots = SHIPPED.crane_slots.controllers["slots+FPI"]
    laws = fp.Exponential(rate=1.0, integral=of_cart), fp.Exponential(rate=3.0, integral=of_angle)
    pair = tuple(replace(s, tracking=law) for s, law in zip(slots.slots, laws, strict=True))
    slots = replace(slots, slots=pair, blend=blend)
    assert floquet_radius(SHIPPED.crane_slots.problem, pair, slots.schedule, blend=blend).radius == pytest.approx(
        radius, rel=1e-3
    )
    problem = crane({}, period=2e-3, duration=21.3, limits=fp.Limits())
    assert np.abs(np.linalg.eigvals(period_map(problem, slots, 5.3))).max() == pytest.approx(radius, rel=0.02)


def test_an_unstable_schedule_is_seen_and_grows_so():
    """The cart-pole's schedule grows by 1.09 per period by Floquet, and the run grows as it says."""
    slots, problem = SHIPPED.cart_pole_slots.controllers["slots+FPI"], SHIPPED.cart_pole_slots.problem
    radius = floquet_radius(problem, slots.slots, slots.schedule, blend=slots.blend).radius
    assert radius == pytest.approx(1.094, abs=1e-3)
    still = replace(problem, duration=1.21, measure_from=0.0, limits=fp.Limits())
    assert np.abs(np.linalg.eigvals(period_map(still, slots, 0.6))).max() == pytest.approx(radius, rel=0.02)


def test_one_slot_alone_has_the_radius_of_its_eigenvalues():
    """Without a switch one period is e^(A T), whose radius is e^(largest real part T)."""
    for integral in (False, True):
        slot = fp.Slot("q2", fp.Exponential(rate=4.0, integral=integral))
        floquet = floquet_radius(SHIPPED.mass_spring_slots.problem, [slot], fp.Periodic({"q2": 1.5}), blend=0.1)
        assert floquet.eigenvalues["q2"].size == 4 + integral
        assert floquet.eigenvalues["q2"].real.max() == pytest.approx(-0.1, abs=1e-3)
        assert floquet.radius == pytest.approx(np.exp(1.5 * floquet.eigenvalues["q2"].real.max()), rel=1e-9)


def test_no_radius_without_a_set_point_or_a_period():
    slots = SHIPPED.crane_slots.controllers["slots"]
    selection = fp.ByError({"cart": 1.0, "angle": 1.0}, dwell=0.5)
    floquet = floquet_radius(SHIPPED.crane_slots.problem, slots.slots, selection)
    assert floquet.radius is None
    assert floquet.reason == "the schedule is not periodic"
    moving, falling = ((1e-9, 0.0), "still moves"), ((0.0, 1e-9), "no equilibrium")
    for (speed, angle), reason in (moving, falling):
        wrong = fp.Trajectory(partial(lambda s, a, t: {"cart": s * t, "angle": a + 0 * t}, speed, angle))
        problem = replace(SHIPPED.crane_slots.problem, reference=wrong)
        floquet = floquet_radius(problem, slots.slots, slots.schedule)
        assert floquet.radius is None
        assert reason in floquet.reason
        answer = schedule_stable(problem, slots)
        assert answer is not None
        assert answer.change == ""


def test_what_a_radius_is_asked_of_is_checked():
    slots, problem = SHIPPED.crane_slots.controllers["slots"], SHIPPED.crane_slots.problem
    for schedule, what in (
        (fp.Periodic({"cart": 1.0, "angel": 1.0}), "'angel' is unknown"),
        (fp.Periodic({"cart": 1.0}), "never active"),
    ):
        with pytest.raises(InvalidProblem, match=what):
            floquet_radius(problem, slots.slots, schedule)


def test_slots_that_get_no_turn_are_noted():
    slots = SHIPPED.crane_slots.controllers["slots"]
    late = replace(slots, schedule=fp.Periodic({"cart": 30.0, "angle": 1.0})).notes(SHIPPED.crane_slots.problem)
    alone = replace(slots, schedule=fp.ByError({"cart": 1.0, "angle": 1.0}, dwell=30.0)).notes(
        SHIPPED.crane_slots.problem
    )
    assert late[0] == "slot 'angle' gets no turn: it would begin at 30 s, and the run ends at 26.5 s"
    assert alone[0] == "one slot alone gets a turn: it lasts 30 s, and the run ends at 26.5 s"


# Relative orders


def angle_gain(angle: np.ndarray) -> np.ndarray:
    """Size of d angle'' / dF of the crane."""
    p = dict(
        zip(SHIPPED.crane_slots.problem.plant.parameter.elements, SHIPPED.crane_slots.problem.plant.exact, strict=True)
    )
    return np.cos(angle) / p["l"] / (p["M"] + p["m"] * np.sin(angle) ** 2)


CHAINS = (  # order, and what the input does to that derivative, by hand
    ("mass_spring_slots", "q2", 2, lambda x, p: 1 / p["m2"]),
    ("mass_spring_slots", "q1", 4, lambda x, p: p["k2"] / (p["m1"] * p["m2"])),  # through the spring
    ("two_tanks_slots", "h1", 1, lambda x, p: 1 / p["A1"]),
    ("two_tanks_slots", "h2", 2, lambda x, p: p["c1"] / (2 * p["A1"] * p["A2"] * np.sqrt(x["h1"]))),
    ("crane_slots", "cart", 2, lambda x, p: 1 / (p["M"] + p["m"] * np.sin(x["angle"]) ** 2)),
    ("crane_slots", "angle", 2, lambda x, p: -angle_gain(x["angle"])),
)


@pytest.mark.parametrize(("name", "coordinate", "order", "gain"), CHAINS)
def test_order_and_gain(name, coordinate, order, gain):
    """The number of derivatives until the input appears, and its factor, by which the response is affine in it."""
    plant = getattr(SHIPPED, name).problem.plant
    chain = output_chain(plant, coordinate)
    p = dict(zip(plant.parameter.elements, plant.exact, strict=True))
    assert chain.order == order
    for state in np.random.default_rng(1).uniform(0.5, 6.0, size=(5, plant.state.size)):
        by_hand = gain(dict(zip(plant.state.elements, state, strict=True)), p)
        assert float(chain.gain(state, [0.3], plant.exact)) == pytest.approx(by_hand, rel=1e-9)
        ends = [float(chain.response(state, [u], plant.exact, [0, 0])) for u in (0.0, 2.0)]
        assert ends[1] - ends[0] == pytest.approx(2 * by_hand, rel=1e-9)


def test_chain_of_the_lower_tank():
    """h2' = (c1 sqrt(h1) - c2 sqrt(h2)) / A2."""
    plant = SHIPPED.two_tanks_slots.problem.plant
    p = dict(zip(plant.parameter.elements, plant.exact, strict=True))
    for h1, h2 in np.random.default_rng(2).uniform(0.5, 6.0, size=(5, 2)):
        rate = (p["c1"] * np.sqrt(h1) - p["c2"] * np.sqrt(h2)) / p["A2"]
        found = output_chain(plant, "h2").states([h1, h2], plant.exact).full().ravel()
        assert found == pytest.approx([h2, rate], rel=1e-9)


# Schedules


def test_fixed_and_periodic_are_the_same_run():
    problem, slots = crane({"cart": -1.0}, duration=8.0), SHIPPED.crane_slots.controllers["slots+FPI"]
    spans = [("cart", 0.0, 1.4), ("angle", 1.4, 5.3), ("cart", 5.3, 6.7), ("angle", 6.7, 8.0)]
    fixed = run(problem, replace(slots, schedule=fp.FixedSchedule(spans)))
    periodic = run(problem, slots)
    assert np.array_equal(fixed.log, periodic.log)
    assert [(round(a, 9), round(b, 9), k) for a, b, k in fixed.spans()] == [
        (a, b, ("cart", "angle").index(n)) for n, a, b in spans
    ]


def chosen(schedule: Schedule, **changes: Any) -> fp.Run:
    """The crane with slots that are chosen as it goes."""
    return run(
        SHIPPED.crane_slots.problem, replace(SHIPPED.crane_slots.controllers["slots+FPI"], schedule=schedule, **changes)
    )


def test_by_error_keeps_dwell_and_hysteresis():
    """A slot ends when it has lasted the dwell and another weighted error is clearly larger; then and not otherwise."""
    weights, dwell, hysteresis = np.array([1.0, 5.0]), 0.7, 0.2
    result = chosen(fp.ByError({"cart": 1.0, "angle": 5.0}, dwell=dwell, hysteresis=hysteresis))
    slot, scores = result["slot"][:, 0].astype(int), weights * np.abs(result["error"])
    assert len(switches(result)) > 10
    assert min(b - a for a, b, _ in result.spans()[:-1]) == pytest.approx(dwell)
    assert slot[0] == np.argmax(scores[0])
    for start, end, active in result.spans():
        first, last = round(start / result.period), round(end / result.period)
        free = np.arange(first + round(dwell / result.period), min(last + 1, result.cycles))
        clear = scores[free, 1 - active] > (1 + hysteresis) * scores[free, active]
        assert not clear[:-1].any()
        assert not clear.size or clear[-1] == (last < result.cycles)


def test_by_look_ahead_keeps_the_dwell():
    """No slot is shorter; and with a hysteresis that no prediction exceeds the first slot stays for ever."""
    weights = {"cart": 1.0, "angle": 1.0}
    result = chosen(fp.ByLookAhead(weights, dwell=1.0, hysteresis=0.2))
    assert len(switches(result)) > 10
    assert min(b - a for a, b, _ in result.spans()[:-1]) >= 1.0 - 1e-9
    assert len(chosen(fp.ByLookAhead(weights, dwell=1.0, hysteresis=1e9)).spans()) == 1


def test_look_ahead_chooses_what_the_runs_show():
    """The first slot is the one after which the weighted state is smaller, as runs with each slot alone find."""
    weights, dwell, random = {"cart": 3.0, "cart'": 1.0, "angle": 1.0, "angle'": 1.0}, 1.0, np.random.default_rng(4)
    names = SHIPPED.crane_slots.problem.plant.state.elements
    slots = SHIPPED.crane_slots.controllers["slots exact model"].controller
    sizes, firsts = np.array([weights[e] for e in names]), []
    for state in 1e-3 * random.normal(size=(6, 4)):
        problem = crane(dict(zip(names, state, strict=True)), duration=dwell + 2 * SHIPPED.crane_slots.problem.period)
        values = []
        for slot in slots.slots:
            alone = replace(slots, slots=[slot], schedule=fp.Periodic({slot.coordinate: dwell}))
            ended = run(problem, fp.ExactModel(alone))["state"][round(dwell / problem.period)]
            values.append(float(sizes @ ended**2))
        first = int(run(problem, fp.ExactModel(replace(slots, schedule=fp.ByLookAhead(weights, dwell))))["slot"][0, 0])
        assert first == np.argmin(values)
        firsts.append(first)
    assert set(firsts) == {0, 1}


def test_a_slot_without_gain_is_not_chosen():
    """The angle has the larger error; but tilted by 0.2 rad the force's effect on it is below 99 % of that at the start."""
    schedule = fp.ByError({"cart": 1e-6, "angle": 1.0}, dwell=0.01)
    slots = replace(
        SHIPPED.crane_slots.controllers["slots exact model"].controller, schedule=schedule, smallest_gain=0.99
    )
    result = run(crane({"cart": 0.1}, duration=2.0), fp.ExactModel(slots))
    gain = angle_gain(result["state.angle"])
    assert gain.min() > 0.99 * gain[0]
    result = run(crane({"cart": 0.1, "angle'": 0.9}, duration=2.0), fp.ExactModel(slots))
    gain = angle_gain(result["state.angle"])
    low = gain < 0.99 * gain[0]
    # In the dwell of two cycles an active slot may still lose its gain.
    assert (result["slot"][2:, 0][low[2:] & low[1:-1] & low[:-2]] == 0).all()
    assert low.sum() > 20
    assert (result["slot"][:, 0] == 1).any()


def pendulum_problem() -> fp.Problem:
    """A pendulum that follows a ramp with hardly enough torque."""
    return fp.Problem(
        plant=pendulum(),
        reference=fp.Trajectory(lambda t: {"angle": 0.5 * t}),
        start={"angle": 0.4},
        period=2e-3,
        duration=2.0,
        limits=fp.Limits(inputs={"torque": (-1.5, 1.5)}),
    )


@pytest.mark.parametrize("integral", [False, True])
@pytest.mark.parametrize("deformation", [fp.Identity(), fp.Sigmoid(gain=-0.5, shift=0.3, scale=20.0)])
def test_one_slot_is_computed_torque(integral, deformation):
    """A slot that lasts the whole run, of a plant with one coordinate: law, deformation, integral, limits."""
    problem = pendulum_problem()
    law = fp.Exponential(rate=8.0, integral=integral)
    torque = run(problem, fp.ComputedTorque(law, deformation))
    slots = run(problem, fp.Slotted([fp.Slot("angle", law, deformation)], fp.Periodic({"angle": 0.5}), blend=0.1))
    assert torque["clipped"].any()  # so that the anti-windup is compared as well
    for name in ("command", "error", "desired", "deformed", "realised", "state", "clipped"):
        np.testing.assert_allclose(slots[name], torque[name], rtol=1e-7, atol=1e-9, err_msg=name)


MAPS = fp.Sigmoid(gain=-0.2, scale=100.0), fp.ModelReferenced(fp.Affine(gain=-0.2))
ELSEWHERE = "map", "late", "late curve", "encoder", "believed", "outside"  # where y^(r) is not that of equations


@pytest.mark.parametrize("name", ELSEWHERE)
@pytest.mark.parametrize("deformation", MAPS, ids=["plain", "referenced"])
def test_one_slot_is_computed_torque_where_responses_are_measured(name, deformation):
    """On maps, late, behind estimators, of a body outside: the plain form to rounding.

    The model-referenced one begins with the difference of model and plant at the start, and ends in the same motion.
    """
    problem, law = replace(FORMS[name][0], horizon=None, cost=None, duration=1.6), fp.Exponential(rate=6.0)
    slots = fp.Slotted([fp.Slot("y", law, deformation)], fp.Periodic({"y": 0.5}), blend=0.1)
    if deformation.mirror.share and name in ("encoder", "believed"):
        assert "gives a mean over several; use the map inside" in refused(problem, slots)
        return
    torque = run(problem, fp.ComputedTorque(law, deformation))
    slotted = run(problem, slots)
    scale, late = np.abs(torque["command"]).max(), 0 if not deformation.mirror.share else -80
    tolerance = 1e-9 if not late else 2e-3
    np.testing.assert_allclose(slotted["command"][late:], torque["command"][late:], atol=tolerance * scale)
    np.testing.assert_allclose(slotted["realised_of_slots"], slotted["realised"], atol=0)


def in_steps(problem: Any, period: float, orders: int) -> fp.Problem:
    """The problem as a map: Euler's steps, which keep the relative orders."""
    plant, names = problem.plant, problem.plant.names
    chain = [tuple(n + "d" * k for n in names) for k in range(orders)]

    def later(x, u, p):
        named = [Named(names, ca.vertcat(*(x[n] for n in part)), "state") for part in chain]
        rates = plant.response(*named, u, p)
        highest = [*(x[n] for part in chain[1:] for n in part), *(rates[n] for n in names)]
        return {n: x[n] + period * rate for n, rate in zip([n for part in chain for n in part], highest, strict=True)}

    steps = fp.Plant.discrete(
        states={n: "1" for part in chain for n in part},
        inputs=plant.inputs,
        parameters=plant.parameters,
        next=later,
        step=period,
        outputs={n: fp.Output(unit, lambda x, p, n=n: x[n]) for n, unit in plant.coordinates.items()},
        controlled=plant.controlled,
    )
    start = {**{n: 0.0 for part in chain for n in part}, **problem.start}
    return replace(problem, plant=steps, start=start, period=period, horizon=None, cost=None, judged=names)


def masses_in_steps(period: float) -> fp.Problem:
    """The two masses, of orders 2 and 4, towards rest."""
    still = replace(
        SHIPPED.mass_spring_slots.problem,
        reference=fp.Trajectory(lambda t: {"q1": 0 * t, "q2": 0 * t}),
        measure_from=0.0,
    )
    return in_steps(still, period, 2)


SLOW = fp.Exponential(rate=1.0, integral=False)


def slow() -> Any:
    """Slots of the masses whose errors are still there after a period."""
    slots = SHIPPED.mass_spring_slots.controllers["slots"]
    pair = [replace(s, tracking=SLOW) for s in slots.slots]
    return replace(slots, slots=pair, schedule=fp.Periodic({"q2": 0.4, "q1": 0.6}))


def test_slots_on_a_map_shrink_by_the_radius_of_the_map():
    """By the exact model a period of the run is the linear map of the radius, orders 2 and 4, switches and hold included."""
    problem, slots = replace(masses_in_steps(1e-2), duration=3.01), slow()
    floquet = floquet_radius(problem, slots.slots, slots.schedule, blend=slots.blend)
    assert [c.chain.order for c in slots.channels(problem)] == [2, 4]
    away = np.abs(np.linalg.eigvals(period_map(problem, fp.ExactModel(slots), 1.0))).max()
    assert away == pytest.approx(floquet.radius, rel=1e-6)
    assert away != pytest.approx(1.0, abs=1e-2)


def test_a_map_is_the_plant_for_short_steps():
    """The radius of Euler's steps goes to that of the differential equation as the step."""
    slots = SHIPPED.mass_spring_slots.controllers["slots"]
    problems = SHIPPED.mass_spring_slots.problem, masses_in_steps(2e-3), masses_in_steps(1e-3)
    known, *found = (
        floquet_radius(p, slots.slots, slots.schedule, blend=slots.blend).radius or math.nan for p in problems
    )
    away = [abs(one - known) for one in found]
    assert away[1] == pytest.approx(away[0] / 2, rel=0.05)


def referenced(slots: Any, **settings: Any) -> Any:
    """The slots with the model-referenced form."""
    form = fp.ModelReferenced(fp.Affine(gain=-0.3), **settings)
    return replace(slots, slots=[replace(s, deformation=form) for s in slots.slots])


def test_a_wrong_model_of_steps_is_corrected():
    """The masses as a map, with slots of order 2 and 4: the form leaves a hundredth of what the wrong model leaves."""
    problem, slots = (
        in_steps(SHIPPED.mass_spring_slots.problem, 5e-3, 2),
        SHIPPED.mass_spring_slots.controllers["slots"],
    )
    plain, adapted = (rms(problem, run(problem, c)) for c in (slots, referenced(slots)))
    assert (adapted < 0.01 * plain).all()
    assert (plain > 1e-3).all()


def test_slots_behind_a_dead_time_switch_without_a_jump():
    """Predicted, with the dead time in the form, which is told it by the problem; a form that is told none chatters."""
    problem = crane({"cart": -1.0}, duration=10.6, dead_time=fp.DeadTime(inputs={"F": 0.01}))
    slots = referenced(SHIPPED.crane_slots.controllers["slots"])
    largest = []
    for controller in (slots, referenced(slots, cycles=0.0)):
        result = run(problem, fp.Predicted(controller, inputs=0.01))
        steps = np.abs(np.diff(result["command"][:, 0]))
        assert steps[switches(result) - 1].max() < 1e-9
        largest.append(steps.max())
    ideal = run(replace(problem, dead_time=fp.DeadTime()), slots)
    assert largest[0] < 1.2 * np.abs(np.diff(ideal["command"][:, 0])).max() < 0.5 * largest[1]


def test_responses_of_slots_are_differences_of_positions():
    """Of both coordinates, one of which no sensor has a response of: the fourth difference of q1, the second of q2."""
    period = SHIPPED.mass_spring_slots.problem.period
    problem = replace(
        SHIPPED.mass_spring_slots.problem,
        sensing=fp.Sensing(estimator=fp.PositionDifference()),
        duration=1.5,
        measure_from=0.0,
    )
    result = run(problem, SHIPPED.mass_spring_slots.controllers["slots+FPI"])
    at = {name: result[f"plant_state.{name}"] for name in ("q1", "q2")}
    for name, order in (("q1", 4), ("q2", 2)):
        expected = np.diff(at[name], order) / period**order
        own = result[f"realised_of_slots.{name}"][order:]
        np.testing.assert_allclose(own, expected, atol=1e-5 * np.abs(expected).max())


def test_slots_with_encoders_correct_a_wrong_model():
    """Tanks whose levels are counted in thousandths of a decimetre: the error falls as it does without sensors."""
    fine = {name: fp.Sensor(quantum=1e-3) for name in ("h1", "h2")}
    problem = replace(
        SHIPPED.two_tanks_slots.problem,
        sensing=fp.Sensing(sensors=fine, estimator=fp.SavitzkyGolay(window=9, degree=2)),
    )
    slots = SHIPPED.two_tanks_slots.controllers["slots"].with_deformation(fp.Affine(gain=-0.2))
    plain, adapted = (rms(problem, run(problem, c)) for c in (SHIPPED.two_tanks_slots.controllers["slots"], slots))
    assert (adapted < 0.1 * plain).all()


def masses_by_states() -> fp.Plant:
    """The two masses as first-order equations in another order, with extension and sum as states."""
    plant = SHIPPED.mass_spring_slots.problem.plant

    def rates(x, u, p):
        low, pull = (x.total - x.between) / 2, p.k2 * x.between
        return {
            "w2": (u.F - pull - p.b2 * x.w2) / p.m2,
            "w1": (pull - p.k1 * low - p.b1 * x.w1) / p.m1,
            "between": x.w2 - x.w1,
            "total": x.w2 + x.w1,
        }

    outputs = {"q1": lambda x, p: (x.total - x.between) / 2, "q2": lambda x, p: (x.total + x.between) / 2}
    return fp.Plant.of_states(
        states={"w2": "m/s", "w1": "m/s", "between": "m", "total": "m"},
        inputs=plant.inputs,
        parameters=plant.parameters,
        rates=rates,
        outputs={name: fp.Output("m", one) for name, one in outputs.items()},
        controlled=("q2",),
    )


@pytest.mark.parametrize("name", ["slots", "slots+FPI"])
@pytest.mark.parametrize(
    "reality", [lambda: SHIPPED.mass_spring_slots.problem.plant, masses_by_states], ids=["same", "by states"]
)
def test_slots_read_their_responses_from_a_reality(name, reality):
    """A reality that is the plant itself, or its equations in other states, is the plant: over a switch, with a wrong model."""
    problem = replace(SHIPPED.mass_spring_slots.problem, duration=1.5, measure_from=0.0)
    plain = run(problem, SHIPPED.mass_spring_slots.controllers[name])
    real = run(replace(problem, reality=fp.Reality(reality())), SHIPPED.mass_spring_slots.controllers[name])
    assert len(switches(real)) == 1
    for signal in ("state", "command", "realised", "deformed"):
        scale = np.abs(plain[signal]).max()
        np.testing.assert_allclose(real[signal] / scale, plain[signal] / scale, atol=1e-9, err_msg=signal)
    assert (
        "a reality moves"
        in SHIPPED.mass_spring_slots.controllers[name].notes(replace(problem, reality=fp.Reality(reality())))[0]
    )


# Switches


def moved(controller: Controller, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the command of the crane, and the first cycles of its slots."""
    result = run(crane({"cart": -1.0}, period=period, duration=10.6), controller)
    return np.abs(np.diff(result["command"][:, 0])), switches(result)


@pytest.mark.parametrize("name", ["slots", "slots+FPI", "slots exact model"])
def test_command_is_continuous_at_switches(name):
    """A slot begins with the last command, and its steps in the next 0.1 s vanish with the period; a jump would not."""
    largest = []
    for period in (5e-3, 2.5e-3):
        steps, at = moved(SHIPPED.crane_slots.controllers[name], period)
        assert len(at) == 3
        assert steps[at - 1].max() < 1e-12
        largest.append(max(steps[k - 1 : k + round(0.1 / period)].max() for k in at))
    assert largest[1] < 0.6 * largest[0]
    assert largest[0] < 0.08  # N, of commands of 1.3 N


def test_without_blend_the_command_jumps():
    """What `blend` is for: joined at once, the law moves the command by as much at any period."""
    pairs = [moved(replace(SHIPPED.crane_slots.controllers["slots"], blend=0.0), period) for period in (5e-3, 2.5e-3)]
    largest = [steps[at].max() for steps, at in pairs]
    assert largest[1] > 0.9 * largest[0] > 0.5


def own_law(run_: fp.Run, name: str, rate: float) -> np.ndarray:
    """y''^Des = 2 rate e' + rate^2 e towards rest."""
    return -(2 * rate * run_[f"state.{name}'"] + rate**2 * run_[f"state.{name}"])


@pytest.mark.parametrize("name", ["slots", "slots+FPI"])
@pytest.mark.parametrize("blend", [0.1, 0.3])
def test_offset_decays_with_the_blend(name, blend):
    """What the desired response is away from the law falls as e^(-t / blend) and begins at what the plant does."""
    result = run(crane({"cart": -1.0}, duration=5.3), replace(SHIPPED.crane_slots.controllers[name], blend=blend))
    (at,) = switches(result)
    offset = result["desired.angle"] - own_law(result, "angle", 3.0)
    expected = offset[at] * np.exp(-(result.time[at:] - result.time[at]) / blend)
    assert abs(offset[at]) > 0.1
    np.testing.assert_allclose(offset[at:], expected, atol=1e-9)
    np.testing.assert_allclose((result["desired.cart"] - own_law(result, "cart", 1.0))[:at], 0, atol=1e-12)
    begins = result["realised.angle"] if name == "slots+FPI" else result["deformed.angle"]
    assert result["desired.angle"][at] == pytest.approx(begins[at], rel=1e-9)


def test_a_deformation_starts_afresh_with_every_slot():
    """The tuned gain of one slot says nothing of the next: its factor is 1 at every start, and grows to 3 within."""
    sigmoid = fp.Sigmoid(gain=-1.0, shift=0.3, scale=10.0)
    tuned = fp.Tuned(sigmoid, largest_gain=3 * sigmoid.effective_gain())
    slots = SHIPPED.crane_slots.controllers["slots+FPI"]
    slots = replace(slots, slots=[replace(s, deformation=tuned) for s in slots.slots])
    result = run(crane({"cart": -1.0}, duration=10.6), slots)
    assert len(result.spans()) == 4
    for start, end, slot in result.spans():
        first, last = round(start / result.period), round(end / result.period) - 1
        active, other = (result[f"gain_factor_{('cart', 'angle')[k]}"][:, 0] for k in (slot, 1 - slot))
        assert active[first] == 1
        assert active[last] > 1.5
        assert (other[first : last + 1] == 1).all()


def test_an_integral_starts_afresh_with_every_slot():
    """Bumpless: it begins where it cancels the feedback of error and rate, whatever it was at the end of the slot before."""
    slots, problem = (
        SHIPPED.two_tanks_slots.controllers["slots"],
        replace(SHIPPED.two_tanks_slots.problem, duration=480.0, measure_from=0.0),
    )
    result = run(problem, replace(slots, blend=0.0))
    chain = output_chain(problem.plant, "h2")
    of_integral, of_error, of_rate = fp.Exponential(rate=0.1).gains(2)

    def feedback(cycle: int) -> float:
        rate = float(chain.states(result["state"][cycle], problem.plant.approximate)[1])
        return of_error * result["error.h2"][cycle] - of_rate * rate

    lower = [(round(a / result.period), round(b / result.period)) for a, b, slot in result.spans() if slot == 0]
    assert len(lower) == 4
    for (_, ended), (first, _) in pairwise(lower):
        begun = -feedback(first) / of_integral
        # With blend = 0 the law is joined in the second cycle; by then one cycle's error was added.
        used = (result["desired.h2"][first + 1] - feedback(first + 1)) / of_integral
        assert used == pytest.approx(begun + result.period * result["error.h2"][first], rel=1e-9)
        before = (result["desired.h2"][ended - 1] - feedback(ended - 1)) / of_integral
        assert abs(before - begun) > 0.1 * abs(begun)


def test_blanked_cycles_keep_the_distance():
    """In the first cycles of a slot the request keeps its distance from the desired response; without blank it does not."""
    for blank in (0, 4):
        slots = replace(SHIPPED.crane_slots.controllers["slots+FPI"], blank=blank)
        result = run(crane({"cart": -1.0}, duration=10.6), slots)
        away = result["deformed"] - result["desired"]
        for k in switches(result):
            distance = away[k : k + 6, int(result["slot"][k, 0])]
            assert np.ptp(distance[:4]) < 1e-9 if blank else np.ptp(distance[:4]) > 1e-3
            assert abs(distance[4] - distance[3]) > 1e-5


def test_a_map_that_would_never_learn_is_refused():
    slots = replace(SHIPPED.crane_slots.controllers["slots+FPI"], blank=10**6)
    with pytest.raises(
        InvalidProblem, match=r"slot 'cart' lasts .* cycles, and its map learns nothing in the first blank"
    ):
        slots.check(SHIPPED.crane_slots.problem)


def test_too_little_gain_holds_the_command():
    """Held in exactly the cycles in which the active slot's gain is below its share, and the status says so."""
    slots = replace(SHIPPED.crane_slots.controllers["slots exact model"].controller, smallest_gain=0.995)
    result = run(crane({"cart": -1.0}, duration=10.6), fp.ExactModel(slots))
    gain = angle_gain(result["state.angle"])
    cart_gain = gain / np.cos(result["state.angle"])
    share = np.where(result["slot"][:, 0] == 1, gain / gain[0], cart_gain / cart_gain[0])
    held = result["slot_held"][:, 0] > 0.5
    assert 20 < held.sum() < result.cycles / 2
    np.testing.assert_array_equal(held, share < 0.995)
    np.testing.assert_array_equal(result["status"][:, 0], np.where(held, Status.HELD, Status.OK))
    steps = np.diff(result["command"][:, 0])
    assert np.abs(steps[held[1:]]).max() == 0
    assert np.abs(steps[~held[1:]]).max() > 1e-3


def test_inputs_of_other_slots_keep_their_command():
    """Two masses, two forces, a slot for each: the force that does not act stands still."""
    plant = fp.Plant(
        coordinates={"a": "m", "b": "m"},
        inputs={"Fa": "N", "Fb": "N"},
        parameters={"m": fp.Parameter(1.0, 1.3, "kg")},
        response=lambda q, v, u, p: {"a": (u.Fa - q.a) / p.m, "b": (u.Fb - q.b) / p.m},
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"a": 0 * t + 1, "b": 0 * t + 1}),
        start={"a": 0.0, "b": 0.0},
        period=1e-2,
        duration=2.0,
        judged=("a", "b"),
    )
    law = fp.Exponential(rate=2.0)
    deformation = fp.Sigmoid(gain=-1.0, shift=0.3, scale=5.0)
    pair = (fp.Slot("a", law, deformation, input="Fa"), fp.Slot("b", law, deformation, input="Fb"))
    result = run(problem, fp.Slotted(pair, fp.Periodic({"a": 0.5, "b": 0.5}), blend=0.05))
    shifted, slot = np.abs(np.diff(result["command"], axis=0)) > 0, result["slot"][1:, 0].astype(int)
    assert not shifted[slot == 0, 1].any()
    assert not shifted[slot == 1, 0].any()
    assert shifted[slot == 0, 0].sum() > 90
    assert shifted[slot == 1, 1].sum() > 90
    # What the commands mean by the model, of mass 1, is the stored request of both, whether active or not.
    np.testing.assert_allclose(result["deformed"], result["command"] - result["state"][:, :2], atol=1e-12)
    assert "needs the name of its input. Valid: Fa, Fb." in refused(
        problem, fp.Slotted((fp.Slot("a", law),), fp.Periodic({"a": 0.5}), blend=0.05)
    )
    message = refused(problem, fp.Slotted((fp.Slot("a", law, input="Fb"),), fp.Periodic({"a": 0.5}), blend=0.05))
    assert "derivative 2 of 'a' is reached by another input than 'Fb'; choose input='Fa'" in message


# Bad input


def refused(problem: fp.Problem, controller: Controller) -> str:
    """The message with which a controller is refused."""
    with pytest.raises(FpirhcError) as caught:
        run(problem, controller)
    return str(caught.value)


def crane_slots(**changes: Any) -> Any:
    return replace(SHIPPED.crane_slots.controllers["slots"], **changes)


def pole_slots(**changes: Any) -> Any:
    return replace(SHIPPED.cart_pole_slots.controllers["slots"], **changes)


def crane_with(cart: Any = None, angle: Any = None) -> Any:
    """The crane's slots, one of them with this map."""
    maps = zip(SHIPPED.crane_slots.controllers["slots"].slots, (cart, angle), strict=True)
    return crane_slots(slots=tuple(slot if map is None else replace(slot, deformation=map) for slot, map in maps))


def alone(response: Any, *names: str, controlled: tuple[str, ...] = ()) -> fp.Problem:
    """Coordinates that one force moves, at .1 m, to rest."""
    plant = fp.Plant(
        coordinates=dict.fromkeys(names, "m"),
        inputs={"F": "N"},
        controlled=controlled or names,
        parameters={"m": fp.Parameter(1.0, 1.3, "kg")},
        response=response,
    )
    still = fp.Trajectory(lambda t: dict.fromkeys(names, 0 * t))
    return fp.Problem(plant, still, dict.fromkeys(names, 0.1), period=1e-2, duration=1.0, judged=names)


def counted(texts: tuple[str, ...]) -> tuple[str, ...]:
    """With the number of mistakes, where there are several."""
    return texts if len(texts) == 1 else (*texts, f"{len(texts)} mistakes")


def slotted(*names: str) -> fp.Slotted:
    return fp.Slotted(
        [fp.Slot(n, fp.Exponential(rate=2.0)) for n in names], fp.Periodic(dict.fromkeys(names, 0.5)), 0.1
    )


ONE = fp.Exponential(rate=1.0)
NO_PATH = alone(lambda q, v, u, p: {"a": u.F / p.m, "b": -q.b, "c": q.a - q.c}, "a", "b", "c", controlled=("a",))
WRONG_SLOTS = fp.Slot("carts", ONE), fp.Slot("angle", ONE, order=3), fp.Slot("angle", ONE, order=2)
averaged = cache(
    lambda: replace(SHIPPED.two_tanks_slots.problem, sensing=fp.Sensing(estimator=fp.SavitzkyGolay(window=9, degree=2)))
)
FALLS = (
    "slot 'cart' lasts 1.4 s, in which its zero dynamics, diverging at 3.5 1/s, grow e^4.9 times",
    "make it shorter than 1.32 s",
)
MAP = fp.Sigmoid(gain=-0.5, shift=0.3, scale=10.0)
QUEUES = {
    "Paired": fp.Paired(MAP, cycles=2),
    "Increment": fp.Increment(MAP, cycles=2),
    "SelfPaired": fp.SelfPaired(MAP, most=5),
    "Paired, tuned": fp.Tuned(fp.Paired(MAP, cycles=2), largest_gain=5.0),
    "Increment, damped": fp.Damped(fp.Tuned(fp.Increment(MAP, cycles=2), largest_gain=5.0)),
    "SelfPaired, guarded": fp.Guarded(fp.SelfPaired(MAP, most=5), largest_deformation=5.0),
}
SCHEDULES: dict[str, tuple[Schedule, tuple[str, ...]]] = {
    "fixed": (fp.FixedSchedule([("cart", 0.0, 1.4), ("angel", 1.0, 3.0), ("cart", 4.0, 30.0)]), (
        "coordinate 'angel' is unknown. Did you mean 'angle'? Valid: cart, angle.",
        "'angel' from 1 to 3 s overlaps the slot before it, which ends at 1.4 s; let it start there",
        "no slot from 3 to 4 s; let 'cart' start at 3 s",
        "the last slot ends at 30 s, after the run's 26.5 s; let it end there",
    )),
    "late": (fp.FixedSchedule([("cart", 0.5, 2.0), ("angle", 2.0, 26.5)]), ("no slot from 0 to 0.5 s; let 'cart' start at 0 s",)),
    "short": (fp.FixedSchedule([("cart", 0.0, 2.0), ("angle", 2.0, 20.0)]), (
        "no slot from 20 s to the end of the run at 26.5 s; add one",
    )),
    "instant": (fp.FixedSchedule([("cart", 0.0, 2.0), ("angle", 2.0, 2.001), ("cart", 2.001, 26.5)]), (
        "'angle' from 2 to 2.001 s is shorter than one control cycle of 0.005 s; let it end later",
    )),
    "periodic": (fp.Periodic({"cart": -1.0, "angle": 1e-3, "angel": 1.0}), (
        "coordinate 'angel' is unknown. Did you mean 'angle'?",
        "duration of 'cart' must be a positive number, in s, got -1.0",
        "duration of 'angle' is 0.001 s, shorter than one control cycle of 0.005 s",
    )),
    "by error": (fp.ByError({"cart": 0.0, "angel": 1.0}, dwell=0.0, hysteresis=-1.0), (
        "weight of coordinate 'angel' is unknown. Did you mean 'angle'?",
        "the weight of 'cart' must be a positive number, got 0.0",
        "dwell must be a positive number, in s, got 0.0",
        "hysteresis must be a number of at least 0, got -1.0",
    )),
    "by look-ahead": (fp.ByLookAhead({"carts": 1.0, "angle": -1.0}, dwell=1e-3), (
        "weight of state 'carts' is unknown. Did you mean 'cart'?",
        "weights must be numbers of at least 0, one of them positive, got [1.0, -1.0]",
        "dwell is 0.001 s, shorter than one control cycle of 0.005 s",
    )),
}  # fmt: skip
LONG_FALLS = (
    fp.Periodic({"angle": 0.5, "cart": 1.4}),
    fp.FixedSchedule([("angle", 0.0, 0.5), ("cart", 0.5, 1.0), ("cart", 1.0, 1.9), ("angle", 1.9, 6.0)]),
    fp.ByError({"angle": 1.0, "cart": 1.0}, dwell=1.4),
)
refusals = cache(lambda: {  # the problem or its name, the controller, and what is said
    **{f"schedule {n}": ("crane_slots", crane_slots(schedule=one), counted(texts)) for n, (one, texts) in SCHEDULES.items()},
    "slots and schedule": ("crane_slots", crane_slots(slots=WRONG_SLOTS, schedule=fp.Periodic({"carts": 1.0})), counted((
        "coordinate 'angle' has more than one slot",
        "slot 'carts': coordinate 'carts' is unknown. Did you mean 'cart'? Valid: cart, angle.",
        "order=3 is not the relative order from 'F' to 'angle', which is 2; write order=2 or leave it out",
    ))),
    "none": ("crane_slots", crane_slots(slots=()), ("there are no slots",)),
    "nothing to look ahead to": (
        replace(SHIPPED.crane_slots.problem, reference=fp.Trajectory(lambda t: {"cart": 0.1 * t, "angle": 0 * t})),
        crane_slots(schedule=fp.ByLookAhead({"cart": 1.0}, dwell=0.1)),
        ("Slotted: ByLookAhead: the reference still moves at its end, t = 26.5 s; use ByError",),
    ),
    "not judged": (replace(SHIPPED.crane_slots.problem, judged=("cart",)), crane_slots(), (
        "slot 'angle' is not among the coordinates that are judged; write Problem(..., judged=('cart', 'angle'))",
    )),
    "no path from the input": (NO_PATH, slotted("a", "b"), (
        "input 'F' does not reach coordinate 'b'",
        "(relative order by coordinate: a 2, b none, c 4); choose a coordinate that has one",
    )),
    # The pole falls at 3.49 1/s: ln(100) / 3.49 = 1.32 s is the longest cart slot, by any schedule that promises more.
    **{f"falls, {type(one).__name__}": ("cart_pole_slots", pole_slots(schedule=one), FALLS) for one in LONG_FALLS},
    # Pairs of cycles before a switch belong to another coordinate; also where another wrapper hides them.
    **{name: ("crane_slots", crane_with(map), (
        f"slot 'cart': {name.partition(',')[0]} keeps pairs of earlier cycles, which belong to another slot",
    )) for name, map in QUEUES.items()},
    "wrong sign": ("crane_slots", crane_with(angle=fp.Sigmoid(gain=2.0, shift=-0.3, scale=10.0)), (
        "slot 'angle': Sigmoid(gain=2) has the wrong sign",
    )),
    "no scale": ("crane_slots", crane_with(angle=fp.Sigmoid(gain=-2.0)), (
        "slot 'angle': Sigmoid(scale=None): the scale is still to be chosen",
    )),
    "gain behind a mean": (averaged(), SHIPPED.two_tanks_slots.controllers["slots"].with_deformation(fp.Affine(gain=-0.9)), (
        "its response is of several cycles, so the iteration converges only for",
    )),
    "not affine": (alone(lambda q, v, u, p: {"y": (u.F + 0.1 * u.F**3) / p.m}, "y"), slotted("y"), (
        "derivative 2 of 'y' is not affine in 'F', which a slot needs",
    )),
    # In a step of the lower level stands the root of the upper one after a step.
    "steps": (in_steps(SHIPPED.two_tanks_slots.problem, 0.5, 1), SHIPPED.two_tanks_slots.controllers["slots"], (
        "derivative 2 of 'h2' is not affine in 'inflow'",
    )),
})  # fmt: skip


def test_mistakes_are_named():
    """All of them at once, before the run."""
    for name, (problem, slots, texts) in refusals().items():
        message = refused(getattr(SHIPPED, problem).problem if isinstance(problem, str) else problem, slots)
        assert [text for text in texts if text not in message] == [], name


def test_zero_dynamics_that_diverge_little_are_accepted():
    """A cart slot shorter than 1.32 s, or one whose growth is allowed."""
    brief = replace(SHIPPED.cart_pole_slots.problem, duration=0.02, measure_from=0.0)
    run(brief, pole_slots(schedule=fp.Periodic({"angle": 0.5, "cart": 1.31})))
    run(brief, pole_slots(schedule=fp.Periodic({"angle": 0.5, "cart": 1.4}), largest_growth=150.0))


@pytest.mark.parametrize(
    "changed",
    [
        {"blend": -1.0},
        {"blend": "a"},
        {"blank": 1.5},
        {"smallest_gain": 1.0},
        {"smallest_gain": "a"},
        {"largest_growth": 1},
    ],
)
def test_numbers_out_of_range(changed):
    ((name, value),) = changed.items()
    with pytest.raises(InvalidValue, match=rf"Slotted(\({name}={value!r}\)|\.{name}): expected a"):
        replace(SHIPPED.crane_slots.controllers["slots"], **changed)


# The shipped problems


def rms(problem: fp.Problem, run_: fp.Run) -> np.ndarray:
    """Of every judged error, from `measure_from` on."""
    assert run_.stop is None
    return np.sqrt(np.mean(run_["error"][round(problem.measure_from / run_.period) :] ** 2, axis=0))


def test_slots_of_the_cart_pole_are_the_wrong_plan():
    """RHC holds the cart within centimetres where slots drive it away, whatever their model."""
    problem = replace(SHIPPED.cart_pole_slots.problem, duration=3.0)
    planned = rms(problem, run(problem, SHIPPED.cart_pole_slots.controllers["RHC"]))
    assert planned[0] < 0.02
    for name in ("slots", "slots+FPI", "slots exact model"):
        assert rms(problem, run(problem, SHIPPED.cart_pole_slots.controllers[name]))[0] > 10 * planned[0]


# Runs and reports


def test_a_saved_run_keeps_its_slots(tmp_path):
    """The signal, and with it the spans, survive saving; other controllers have none."""
    result = run(crane({"cart": -1.0}, duration=6.0), SHIPPED.crane_slots.controllers["slots+FPI"])
    result.save(tmp_path / "run.npz")
    loaded = fp.load_run(tmp_path / "run.npz")
    np.testing.assert_array_equal(loaded["slot"], result["slot"])
    assert loaded.spans() == result.spans()
    assert np.array(loaded.spans()) == pytest.approx(np.array([(0, 1.4, 0), (1.4, 5.3, 1), (5.3, 6.0, 0)]))
    brief = replace(pendulum_problem(), duration=0.02)
    assert run(brief, fp.ComputedTorque(fp.Exponential(rate=8.0))).spans() == []


def test_compare_says_the_radius_and_draws_the_slots(tmp_path, capsys):
    """The Floquet radius in the text; in the report the bands, their legend, and the times of the slots."""
    arguments = [
        str(Path(__file__).parents[2] / "problems" / "crane_slots.py"),
        "--controllers",
        "slots",
        "slots+FPI",
        "--no-compile",
        "--out",
        str(tmp_path),
    ]
    assert main(["compare", *arguments]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert (
        "slots: Floquet radius 0.0485 per period of 5.3 s: near the set-point errors of ideal slots shrink" in printed
    )
    assert "(largest real part in each slot alone, 1/s: cart 0, angle 0)" in printed
    assert "cart from 0.49 to 0.00479 m (102 times less)" in printed
    report = (tmp_path / "report.html").read_text()
    legend = report.split("<ul id='bands'>")[1].split("</ul>")[0]
    assert "slot cart" in legend
    assert "slot angle" in legend
    assert "(slots, slots+FPI)" in legend
    assert re.search(r'"slots": ?\[\[0\.0, ?1\.4, ?0\], ?\[1\.4, ?5\.3, ?1\]', report)
