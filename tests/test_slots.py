"""Time slots: stability of schedules, relative orders, continuity at switches, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import pendulum

import fpirhc as fp
from fpirhc.errors import FpirhcError
from fpirhc.relative_order import output_chain

CRANE = fp.load_problem("crane_slots")
TANKS = fp.load_problem("two_tanks_slots")
MASSES = fp.load_problem("mass_spring_slots")
POLE = fp.load_problem("cart_pole_slots")


def crane(start: dict[str, float], **changes: object) -> fp.Problem:
    """The crane from another start, measured from the first cycle."""
    given = {e: start.get(e, 0.0) for e in CRANE.problem.plant.state.elements}
    return replace(CRANE.problem, start=given, measure_from=0.0, **changes)


def run(problem: fp.Problem, controller: fp.Controller) -> fp.Run:
    """A run that is too short to be worth compiling."""
    return fp.simulate(problem, controller, seed=0, compiled=False)


def switches(found: fp.Run) -> np.ndarray:
    """First cycles of all slots but the first."""
    return np.flatnonzero(np.diff(found["slot"][:, 0])) + 1


# Stability of a schedule


def test_crane_schedule_is_stable_although_no_slot_is():
    """The pendulum swings undamped in a cart slot, the cart rolls on in an angle slot; one period shrinks both."""
    slots = CRANE.controllers["slots"]
    found = fp.floquet_radius(CRANE.problem, slots.slots, slots.schedule, blend=slots.blend)
    assert found.radius == pytest.approx(0.0485, abs=5e-4)
    assert found.period == pytest.approx(5.3)
    for values in found.eigenvalues.values():
        assert values.real.max() == pytest.approx(0.0, abs=1e-6)


def period_map(problem: fp.Problem, controller: fp.Controller, period: float) -> np.ndarray:
    """The linear map of the state over one period of the schedule, from runs with one entry of the state disturbed.

    It is taken from the second period to the third, since a run's first slot begins without an offset.
    """
    size, cycles, names = 1e-4, round(period / problem.period), problem.plant.state.elements
    after = []
    for name in names:
        states = run(replace(problem, start={e: size * (e == name) for e in names}), controller)["state"]
        after.append(states[[cycles, 2 * cycles]] / size)
    first, second = np.array(after).transpose(1, 2, 0)
    return second @ np.linalg.pinv(first, rcond=1e-9)


def test_nonlinear_run_shrinks_by_the_floquet_radius():
    """Near the set-point, by the wrong model with the deformation: 0.0493 at 5 ms and 0.0487 at 1 ms for 0.0485."""
    slots = CRANE.controllers["slots+FPI"]
    radius = fp.floquet_radius(CRANE.problem, slots.slots, slots.schedule, blend=slots.blend).radius
    away = []
    for period in (5e-3, 1e-3):
        problem = crane({}, period=period, duration=10.6 + 2 * period, limits=fp.Limits())
        found = np.abs(np.linalg.eigvals(period_map(problem, slots, 5.3))).max()
        away.append(abs(found / radius - 1))
    assert away[0] < 0.03
    assert away[1] < 0.01


def test_an_unstable_schedule_is_seen_and_grows_so():
    """The cart-pole's schedule grows by 1.09 per period by Floquet, and the run grows as it says."""
    slots, problem = POLE.controllers["slots+FPI"], POLE.problem
    radius = fp.floquet_radius(problem, slots.slots, slots.schedule, blend=slots.blend).radius
    assert radius == pytest.approx(1.094, abs=1e-3)
    still = replace(problem, duration=1.21, measure_from=0.0, limits=fp.Limits())
    assert np.abs(np.linalg.eigvals(period_map(still, slots, 0.6))).max() == pytest.approx(radius, rel=0.02)


def test_one_slot_alone_has_the_radius_of_its_eigenvalues():
    """Without a switch one period is e^(A T), whose radius is e^(largest real part T)."""
    for integral in (False, True):
        slot = fp.Slot("q2", fp.Exponential(rate=4.0, integral=integral))
        found = fp.floquet_radius(MASSES.problem, [slot], fp.Periodic({"q2": 1.5}), blend=0.1)
        assert found.eigenvalues["q2"].size == 4 + integral
        assert found.eigenvalues["q2"].real.max() == pytest.approx(-0.1, abs=1e-3)
        assert found.radius == pytest.approx(np.exp(1.5 * found.eigenvalues["q2"].real.max()), rel=1e-9)


def test_no_radius_without_a_set_point_or_a_period():
    """The reason is said."""
    slots = CRANE.controllers["slots"]
    chosen = fp.ByError({"cart": 1.0, "angle": 1.0}, dwell=0.5)
    found = fp.floquet_radius(CRANE.problem, slots.slots, chosen)
    assert found.radius is None
    assert found.reason == "the schedule is not periodic"
    moving = replace(CRANE.problem, reference=fp.Trajectory(lambda t: {"cart": 0.1 * t, "angle": 0 * t}))
    found = fp.floquet_radius(moving, slots.slots, slots.schedule)
    assert found.radius is None
    assert "still moves" in found.reason


# Relative orders


@pytest.mark.parametrize(
    ("task", "coordinate", "order"), [(MASSES, "q2", 2), (MASSES, "q1", 4), (TANKS, "h1", 1), (TANKS, "h2", 2)]
)
def test_relative_order(task, coordinate, order):
    """The number of derivatives until the input appears."""
    assert output_chain(task.problem.plant, coordinate).order == order


def test_gains_of_the_masses():
    """F / m2 in q2''; through the spring k2 / (m1 m2) in q1''''."""
    plant, random = MASSES.problem.plant, np.random.default_rng(1)
    p = dict(zip(plant.parameter.elements, plant.exact, strict=True))
    for state in random.normal(size=(5, 4)):
        for name, gain in {"q2": 1 / p["m2"], "q1": p["k2"] / (p["m1"] * p["m2"])}.items():
            assert float(output_chain(plant, name).gain(state, [0.3], plant.exact)) == pytest.approx(gain, rel=1e-12)


def test_gains_and_chain_of_the_tanks():
    """1 / A1 in h1'; c1 / (2 A1 A2 sqrt(h1)) in h2''; and h2' = (c1 sqrt(h1) - c2 sqrt(h2)) / A2."""
    plant, random = TANKS.problem.plant, np.random.default_rng(2)
    p = dict(zip(plant.parameter.elements, plant.exact, strict=True))
    for h1, h2 in random.uniform(0.5, 6.0, size=(5, 2)):
        upper, lower = output_chain(plant, "h1"), output_chain(plant, "h2")
        assert float(upper.gain([h1, h2], [0.3], plant.exact)) == pytest.approx(1 / p["A1"], rel=1e-12)
        gain = p["c1"] / (2 * p["A1"] * p["A2"] * np.sqrt(h1))
        assert float(lower.gain([h1, h2], [0.3], plant.exact)) == pytest.approx(gain, rel=1e-9)
        rate = (p["c1"] * np.sqrt(h1) - p["c2"] * np.sqrt(h2)) / p["A2"]
        assert lower.states([h1, h2], plant.exact).full().ravel() == pytest.approx([h2, rate], rel=1e-9)


def test_response_of_the_crane():
    """y'' = alpha + beta u, with beta = 1 / (M + m sin^2) for the cart and -cos / l times that for the angle."""
    plant, random = CRANE.problem.plant, np.random.default_rng(3)
    p = dict(zip(plant.parameter.elements, plant.exact, strict=True))
    for state in random.normal(size=(5, 4)):
        angle = state[plant.state.elements.index("angle")]
        beta = 1 / (p["M"] + p["m"] * np.sin(angle) ** 2)
        for name, gain in {"cart": beta, "angle": -np.cos(angle) / p["l"] * beta}.items():
            chain = output_chain(plant, name)
            assert float(chain.gain(state, [0.3], plant.exact)) == pytest.approx(gain, rel=1e-12)
            ends = [float(chain.response(state, [u], plant.exact, [0, 0])) for u in (0.0, 2.0)]
            assert ends[1] - ends[0] == pytest.approx(2 * gain, rel=1e-9)


# Schedules


def test_fixed_and_periodic_are_the_same_run():
    """The same slots in the same cycles: bit by bit."""
    problem, slots = crane({"cart": -1.0}, duration=8.0), CRANE.controllers["slots+FPI"]
    spans = [("cart", 0.0, 1.4), ("angle", 1.4, 5.3), ("cart", 5.3, 6.7), ("angle", 6.7, 8.0)]
    fixed = run(problem, replace(slots, schedule=fp.FixedSchedule(spans)))
    periodic = run(problem, slots)
    assert np.array_equal(fixed.log, periodic.log)
    assert [(round(a, 9), round(b, 9), k) for a, b, k in fixed.spans()] == [
        (a, b, ("cart", "angle").index(n)) for n, a, b in spans
    ]


@pytest.mark.parametrize("integral", [False, True])
@pytest.mark.parametrize("deformation", [fp.Identity(), fp.Sigmoid(gain=-0.5, shift=0.3, scale=20.0)])
def test_one_slot_is_computed_torque(integral, deformation):
    """A slot that lasts the whole run, of a plant with one coordinate: law, deformation, integral, limits."""
    problem = fp.Problem(
        plant=pendulum(),
        reference=fp.Trajectory(lambda t: {"angle": 0.5 * t}),
        start={"angle": 0.4},
        period=2e-3,
        duration=2.0,
        limits=fp.Limits(inputs={"torque": (-1.5, 1.5)}),
    )
    law = fp.Exponential(rate=8.0, integral=integral)
    torque = run(problem, fp.ComputedTorque(law, deformation))
    slots = run(problem, fp.Slotted([fp.Slot("angle", law, deformation)], fp.Periodic({"angle": 0.5}), blend=0.1))
    assert torque["clipped"].any()  # so that the anti-windup is compared as well
    for name in ("command", "error", "desired", "deformed", "realised", "state", "clipped"):
        np.testing.assert_allclose(slots[name], torque[name], rtol=1e-7, atol=1e-9, err_msg=name)


# Switches


def test_command_is_continuous_at_switches():
    """The first command of a slot is the last one of the slot before; then it moves no faster than elsewhere."""
    for name in ("slots", "slots exact model"):
        found = run(crane({"cart": -1.0}), CRANE.controllers[name])
        steps = np.abs(np.diff(found["command"][:, 0]))
        at = switches(found)
        assert len(at) == 9
        assert steps[at - 1].max() < 1e-9  # without a deformation nothing moves in the first cycle


# Bad input


def refused(problem: fp.Problem, controller: fp.Controller) -> str:
    """The message with which a controller is refused."""
    with pytest.raises(FpirhcError) as caught:
        run(problem, controller)
    return str(caught.value)


def test_all_mistakes_of_a_schedule_at_once():
    """Unknown, overlapping, gap, and beyond the run, in one message."""
    spans = [("cart", 0.0, 1.4), ("angel", 1.0, 3.0), ("angle", 4.0, 30.0)]
    message = refused(CRANE.problem, replace(CRANE.controllers["slots"], schedule=fp.FixedSchedule(spans)))
    assert "coordinate 'angel' is unknown" in message
    assert "angle" in message.split("'angel'")[1].splitlines()[0]  # the nearest name
    assert "'angel' from 1 to 3 s overlaps what came before, which ends at 1.4 s" in message
    assert "no slot from 3 to 4 s" in message
    assert "the last slot ends at 30 s, after the run's 26.5 s" in message
