"""A controller against a machine: what a call takes and gives, misuse, threads, failing solvers, clocks, wrong and finite."""

import threading
from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.faults import Failing
from helpers.machine import COMPILER, needs_compiler
from helpers.plants import linear
from helpers.replay import samples, status

import fpirhc as fp
from fpirhc.conformance import two_masses
from fpirhc.contracts import Deformation
from fpirhc.errors import ConcurrentUse, FpirhcError, InvalidValue, NotSupported

TRACK = fp.Exponential(rate=6.0)
SHAPE = fp.Sigmoid(gain=-0.5, scale=50.0)
LAW = fp.ComputedTorque(TRACK, SHAPE)
CONTROLLERS = {"law": LAW, "plan": fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-3))}
PROBLEM = replace(two_masses(), duration=0.4)
PLANT = fp.Plant(
    {"y": "m"}, {"u": "N"}, {"m": fp.Parameter(1.2, 1.0, "kg")}, lambda q, v, u, p: {"y": u.u / p.m - 2.0 * q.y}
)
SMALL = fp.Problem(
    plant=PLANT,
    reference=fp.Trajectory(lambda t: {"y": 0.2 + 0 * t}),
    start={"y": 0.1},
    period=0.01,
    duration=0.2,
    limits=fp.Limits(inputs={"u": (-20.0, 20.0)}),
)
GAINED = fp.ComputedTorque(fp.Exponential(rate=4.0), fp.Affine(gain=-0.6))
SAMPLE = 0.0, np.array([0.1, 0.3]), np.array([0.7])


def small(problem=SMALL, controller=GAINED, **settings) -> fp.Stepper:
    """In the virtual machine, on the small loop."""
    return fp.Stepper(problem, controller, compiled=False, **settings)


@cache
def stepper(name: str = "law", *, compiled: bool = False) -> fp.Stepper:
    """Of two masses, for tests that leave it as it is."""
    return fp.Stepper(PROBLEM, CONTROLLERS[name], compiled=compiled)


# What a call takes and gives


def test_it_says_what_it_is():
    one = small()
    assert one.compiled is False
    assert repr(one) == "Stepper(problem, ComputedTorque, virtual machine)"
    assert one.why_failed == one.why_refused == ""
    assert one.refused == 0
    assert "command" in one.signals
    assert fp.Stepper(SMALL, GAINED).compiled == (COMPILER is not None)


def test_results_are_nobody_elses():
    """Neither the next call nor a change of the results changes what was given before."""
    one = small()
    command, memory = one.step(*SAMPLE, one.start())
    kept = command.copy(), memory.copy()
    shown = one.trace()
    shown["command"][:] = 99.0
    assert one.trace()["command"] == pytest.approx(kept[0])
    one.step(0.01, np.array([0.5, -1.0]), np.array([3.0]), memory)
    np.testing.assert_array_equal(command, kept[0])
    np.testing.assert_array_equal(memory, kept[1])
    memory[:] = 5.0
    np.testing.assert_array_equal(one.step(*SAMPLE, one.start())[0], kept[0])


def test_raw_measurements_are_given_in_their_order():
    """States and then responses where nothing is estimated; with estimators what the sensors show."""
    one = small()
    assert one.measures == ("y", "y'", "y''")
    assert not one.estimates
    expected = one.step(*SAMPLE, one.start())[0]
    np.testing.assert_array_equal(one.step_measured(0.0, np.array([0.1, 0.3, 0.7]), one.start())[0], expected)
    with pytest.raises(InvalidValue):
        one.step_measured(0.0, np.array([0.1, 0.3]), one.start())
    estimating = small(replace(SMALL, sensing=fp.Sensing({}, fp.PositionDifference())))
    assert estimating.measures == ("y",)
    assert estimating.estimates
    memory = estimating.start()
    for k in range(3):
        _, memory = estimating.step_measured(0.01 * k, np.array([0.1 + 0.02 * k]), memory)
    assert estimating.trace()["state"] == pytest.approx([0.14, 2.0])


def test_settings_and_set_points_of_a_call():
    """They hold from that step on; what is refused is counted and named, and the old ones stay."""
    one = small(live=["deformation.gain"])
    assert one.numbers == {"deformation.gain": -0.6}
    memory = one.step(*SAMPLE, one.start())[1]
    again = 0.01, np.array([0.2, 0.1]), np.array([0.4])
    before = one.step(*again, memory)[0]
    changed = one.step(*again, memory, settings={"deformation.gain": -0.3})[0]
    assert changed != before
    assert one.numbers == {"deformation.gain": -0.3}
    assert one.step(*again, memory)[0] == changed
    one.step(*again, memory, settings={"deformation.gain": 0.0})
    assert (one.refused, one.numbers) == (1, {"deformation.gain": -0.3})
    assert one.why_refused
    assert one.change({"deformation.gain": -0.6})
    assert one.step(*again, memory)[0] == before


def test_live_settings_are_named_with_the_interval_that_a_device_may_accept():
    """Gains from that at which 1 - a J = -1, with J = 1.2, up to none; an attribute that is not there is named."""
    one = small(live=["deformation.gain"])
    assert one.settings.columns == ("settings.deformation.gain",)
    assert (one.parameters.columns, one.parameters.start().tolist()) == (("parameters.m",), [1.2])
    assert one.bounds()["deformation.gain"] == pytest.approx((-2 * 2 / 1.2, 0.0), abs=1e-5)
    assert small().settings.names == ()
    assert small().setpoints == small().numbers == {}
    with pytest.raises(AttributeError, match="'Stepper' object has no attribute 'mesures'"):
        one.mesures  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize("cycles", [2, 3, 6])
def test_a_missed_cycle_is_one_without_a_sample(cycles):
    """The commands and memories after it are those of a caller who came in time and had nothing to show."""
    one = small()
    _, memory = one.step(*SAMPLE, one.start())
    by_hand = memory
    for k in range(1, cycles):
        _, by_hand = one.step(0.01 * k, np.full(2, np.nan), SAMPLE[2], by_hand)
    expected, given = (np.concatenate(one.step(0.01 * cycles, *SAMPLE[1:], m)) for m in (by_hand, memory))
    np.testing.assert_allclose(given, expected, rtol=0, atol=1e-12)


# Misuse


@cache
def wider() -> fp.Stepper:
    """The same layout with another scale, so that its memory means something else."""
    return fp.Stepper(PROBLEM, fp.ComputedTorque(TRACK, replace(SHAPE, scale=40.0)), compiled=False)


def misuses(memory: np.ndarray) -> dict[str, tuple[type[FpirhcError], str, tuple[Any, ...]]]:
    """What a caller may get wrong: error, words of the message, arguments."""
    x, r = np.zeros(4), np.zeros(2)
    return {
        "truth value": (InvalidValue, "'state' must be real numbers", (0.0, True, r, memory)),
        "text": (InvalidValue, "'state' must be real numbers", (0.0, "5", r, memory)),
        "no memory": (InvalidValue, "'memory' is not made of numbers", (0.0, x, r, None)),
        "short state": (InvalidValue, "'state' has 4 entries", (0.0, x[:3], r, memory)),
        "matrix": (InvalidValue, "'state' has 4 entries", (0.0, x.reshape(2, 2), r, memory)),
        "ragged": (InvalidValue, "'state' is not made of numbers", (0.0, [[1.0], [1.0, 2.0]], r, memory)),
        "complex": (InvalidValue, "real numbers", (0.0, x + 0j, r, memory)),
        "dictionary": (InvalidValue, "'state' is not made of numbers", (0.0, {"a": 1.0}, r, memory)),
        "short memory": (InvalidValue, "'memory' has", (0.0, x, r, memory[:-1])),
        "masked": (FpirhcError, "masked", (0.0, np.ma.masked_array(x, [True, *3 * [False]]), r, memory)),
        "text in an array": (FpirhcError, "numbers", (0.0, x, np.array(["a", "b"]), memory)),
        "truth value in a list": (InvalidValue, "state", (0.0, [True, 0.0, 0.0, 0.0], r, memory)),
        "memory of another": (InvalidValue, "not this controller's", (0.0, x, r, memory + 1)),
        "memory of another gain, of the same size": (InvalidValue, "another controller", (0.0, x, r, wider().start())),
    }


@pytest.mark.parametrize("which", misuses(np.zeros(9)))
def test_misuse_is_refused_by_name(which):
    """Nothing is broadcast and nothing is guessed; the only token is back, so the next call is not taken for another thread's."""
    one = stepper()
    assert wider().memory.size == one.memory.size
    error, words, arguments = misuses(one.start())[which]
    with pytest.raises(error, match=words):
        one.step(*arguments)
    one.step(0.0, np.zeros(4), np.zeros(2), one.start())
    one.trace()


def test_other_forms_of_numbers_are_taken():
    """Lists, columns, strided views, integers and single precision mean what they say."""
    one = stepper()
    x, r, memory = np.array([0.5, -0.25, 1.0, 2.0]), np.array([1.0, -2.0]), one.start()
    expected, _ = one.step(0.0, x, r, memory)
    forms: list[tuple[Any, Any, Any]] = [
        (list(x), list(r), list(memory)),
        (x[:, None], r[None, :], memory),
        (np.repeat(x, 2)[::2], r, memory),
        (x.astype(np.float32), r.astype(int), memory),
    ]
    for form in forms:
        assert np.array_equal(one.step(0, *form)[0], expected)


def test_second_thread_is_refused():
    """The stepper is entered by another thread while it evaluates: that one is refused and the first finishes."""
    one = stepper()
    evaluate, raised = one._evaluate, []

    def intrude() -> None:
        for work in (lambda: one.step(0.0, np.zeros(4), np.zeros(2), one.start()), one.trace):
            try:
                work()
            except ConcurrentUse as error:
                raised.append(str(error))

    def slow() -> object:
        thread = threading.Thread(target=intrude)
        thread.start()
        thread.join()
        return evaluate()

    expected, _ = one.step(0.0, np.ones(4), np.zeros(2), one.start())
    one._evaluate = slow
    try:
        command, _ = one.step(0.0, np.ones(4), np.zeros(2), one.start())
    finally:
        one._evaluate = evaluate
    assert np.array_equal(command, expected)
    assert len(raised) == 2
    assert "one stepper serves one thread" in raised[0]
    assert np.array_equal(one.step(0.0, np.ones(4), np.zeros(2), one.start())[0], expected)


@pytest.mark.parametrize("first", [True, False])
def test_every_cycle_that_a_solver_fails_is_held_and_counted_once(first, monkeypatch):
    """At the start of a run, where no time is known yet, and within it; in a row and after a step; the reason is told."""
    problem = replace(PROBLEM, horizon=replace(PROBLEM.horizon, replan="cycle"))
    one = fp.Stepper(problem, fp.RecedingHorizon(Failing(iterations=1, tolerance=1e-3)), compiled=False)
    run = fp.simulate(problem, LAW, seed=0, compiled=False)
    rows, memory, at = samples(run), one.start(), 0
    command = np.array(problem.inputs_before)
    if not first:
        command, memory = one.step_measured(0.0, rows[0], memory)
        at = 1
    solving, counts = "ffsfsssffs", []
    for k, how in enumerate(solving):
        monkeypatch.setattr(Failing, "now", how == "f")
        held, memory = one.step_measured(float(run.time[at + k]), rows[at + k], memory)
        assert (status(one) == fp.Status.SOLVER_FAILED) == (how == "f")
        if how == "f":
            assert np.array_equal(held, command)
            assert "solver failed" in one.why_failed
        command = held
        counts.append(int(one.trace()["skipped"][0]))
    assert counts == [solving[: k + 1].count("f") for k in range(len(solving))]


@pytest.mark.parametrize(
    ("optimiser", "words"), [(fp.Fatrop(), "fatrop has no time limit"), (fp.Ipopt(), r"give Ipopt\(time_limit")]
)
def test_solver_without_a_bound_is_refused_on_a_machine(optimiser, words):
    """By name, with a remedy; `bounded=False` accepts it."""
    with pytest.raises(NotSupported, match=words):
        fp.Stepper(PROBLEM, fp.RecedingHorizon(optimiser), compiled=False)
    assert fp.Stepper(PROBLEM, fp.RecedingHorizon(optimiser), compiled=False, bounded=False).start().size


# Wrong but finite


def driven(gain_of_plant: float, deformation: Deformation, *, cycles: int, stuck: bool = False) -> list[fp.Status]:
    """Statuses of computed torque on y'' = g u, believed to be y'' = u; a stuck actuator gives nothing."""
    reference, limits = fp.Trajectory(lambda t: {"y": 1 + 0.2 * ca.sin(3 * t)}), fp.Limits({"u": (-50.0, 50.0)})
    problem = fp.Problem(linear(gain_of_plant, 1.0), reference, {"y": 0.0}, 1e-3, 2.0, limits=limits)
    one = fp.Stepper(problem, fp.ComputedTorque(TRACK, deformation), compiled=False, saturated_after=0.2)
    memory, x, u, statuses = one.start(), np.zeros(2), np.zeros(1), []
    for k in range(cycles):
        acting = 0.0 if stuck else gain_of_plant * float(u[0])
        u, memory = one.step(k * 1e-3, x, np.array([acting]), memory)
        statuses.append(status(one))
        acting = 0.0 if stuck else gain_of_plant * float(u[0])
        x = x + np.array([x[1] * 1e-3 + acting * 0.5e-6, acting * 1e-3])
    return statuses


def test_a_healthy_loop_is_ok_in_every_cycle_and_a_stuck_actuator_saturates():
    """Neither a moving reference nor a wrong model is a fault; where nothing moves the command goes to its limit and stays."""
    assert set(driven(0.8, fp.Affine(gain=-0.5), cycles=1500)) == {fp.Status.OK}
    statuses = driven(0.8, fp.Affine(gain=-0.5), cycles=1500, stuck=True)
    assert fp.Status.SATURATED in statuses[:900]
    assert statuses[0] == fp.Status.OK


def test_every_status_has_a_place_and_a_remedy():
    assert sorted(s.severity for s in fp.Status) == list(range(len(fp.Status)))
    assert all(s.remedy for s in fp.Status)


# The time of a step follows that of the step before; a clock that was set is believed
PERIOD = PROBLEM.period


def stepped(times: list[float], name: str = "law", *, compiled: bool = False) -> list[fp.Status]:
    """Statuses of steps at these times with one sample."""
    own, statuses = stepper(name, compiled=compiled), []
    memory, x, r = own.start(), np.array(PROBLEM.start_state), np.zeros(2)
    for t in times:
        command, memory = own.step(t, x, r, memory)
        assert np.isfinite(command).all()
        assert np.isfinite(memory).all()
        statuses.append(status(own))
    return statuses


WRONG = {
    "repeats": 2.0,
    "repeats almost": 2.4,
    "goes back": 1.0,
    "goes back by far": -1e6,
    "nanoseconds": 3e9,
    "overflows": 1e18 / PERIOD,
    "overflows more": -1e300 / PERIOD,
}


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("which", WRONG)
def test_a_time_that_cannot_follow_is_skipped(name, which):
    """It is BAD_TIME in its own cycle alone: the next good time is that of an ordinary cycle."""
    good = stepped([k * PERIOD for k in range(3)], name)
    assert fp.Status.BAD_TIME not in good
    next_one = 3.0 if "repeats" in which else 4.0
    statuses = stepped([0.0, PERIOD, 2 * PERIOD, WRONG[which] * PERIOD, next_one * PERIOD], name)
    assert statuses[3] == fp.Status.BAD_TIME
    assert fp.Status.BAD_TIME not in (*statuses[:3], statuses[4])


def test_a_skipped_time_changes_nothing():
    """Command, count and later commands are those of a bad sample."""
    own, x, r = stepper(), np.array(PROBLEM.start_state), np.zeros(2)
    command, memory = own.step(0.0, x, r, own.start())
    held, after = own.step(1e18, x, r, memory)
    assert np.array_equal(held, command)
    assert own.trace()["skipped"] == 1
    one, other = (own.step(2 * PERIOD, x, r, m)[0] for m in (after, memory))
    assert np.array_equal(one, other)


@pytest.mark.parametrize(("first", "fits"), [(1.7e9, True), (-5.0, True), (1.7e18, False), (1e18, False)])
def test_the_first_time_resolves_the_period_and_jitter_within_half_of_it_is_fine(first, fits):
    """Seconds since 1970 do; nanoseconds since then do not."""
    assert (stepped([first])[0] != fp.Status.BAD_TIME) == fits
    for jitter in (-0.45, 0.45):
        assert fp.Status.BAD_TIME not in stepped([k * PERIOD + (k % 2) * jitter * PERIOD for k in range(12)])


@pytest.mark.parametrize("to", [-1000.0, 0.0, 1e6])
def test_a_clock_that_was_set_is_believed(to):
    """Twenty regular times are no glitch; a clock that stands still is never believed."""
    times = [5.0 + k * PERIOD for k in range(3)] + [to + k * PERIOD for k in range(25)]
    statuses = stepped(times)
    assert all(s == fp.Status.BAD_TIME for s in statuses[3:22])
    assert fp.Status.BAD_TIME not in statuses[23:]
    still = stepped([5.0 + k * PERIOD for k in range(3)] + [5.0] * 30)
    assert all(s == fp.Status.BAD_TIME for s in still[3:])


@needs_compiler
def test_compiled_clock_is_the_same():
    """The statuses of C and of the virtual machine, over glitches and a set clock."""
    generator = np.random.default_rng(1)
    times = [k * PERIOD * (1 if generator.random() < 0.8 else 10.0 ** generator.integers(-2, 15)) for k in range(80)]
    times += [-7.0 + k * PERIOD for k in range(30)]
    assert stepped(times) == stepped(times, compiled=True)
    assert {fp.Status.OK, fp.Status.BAD_TIME} <= set(stepped(times))
