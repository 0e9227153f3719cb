"""The time of a step follows that of the step before: what cannot is skipped with a status; a clock that was set is believed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.machine import needs_compiler
from helpers.replay import status

import fpirhc as fp
from fpirhc.conformance import two_masses

PROBLEM = replace(two_masses(), duration=0.4)
PERIOD = PROBLEM.period
CONTROLLERS = {
    "computed torque": fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.5, scale=50.0)),
    "plan": fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-3)),
}


@cache
def stepper(name: str = "computed torque", *, compiled: bool = False) -> fp.Stepper:
    return fp.Stepper(PROBLEM, CONTROLLERS[name], compiled=compiled)


def stepped(times: list[float], name: str = "computed torque", *, compiled: bool = False) -> list[fp.Status]:
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


@pytest.mark.parametrize("jitter", [-0.45, 0.45])
def test_jitter_within_half_a_period_is_fine(jitter):
    assert fp.Status.BAD_TIME not in stepped([k * PERIOD + (k % 2) * jitter * PERIOD for k in range(12)])


@pytest.mark.parametrize(("first", "fits"), [(1.7e9, True), (-5.0, True), (1.7e18, False), (1e18, False)])
def test_the_first_time_resolves_the_period(first, fits):
    """Seconds since 1970 do; nanoseconds since then do not."""
    assert (stepped([first])[0] != fp.Status.BAD_TIME) == fits


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
