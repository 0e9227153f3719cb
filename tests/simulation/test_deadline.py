"""Late steps are counted and told, in constant memory; the clock of the tests is a list."""

from __future__ import annotations

import sys
from itertools import chain, repeat

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance.loops import two_masses
from fpirhc.errors import FpirhcError, InvalidValue
from fpirhc.simulation.clock import Deadline

PROBLEM = two_masses()
LIMIT = 1e-3


def timed(durations: list[float] | np.ndarray) -> Deadline:
    """A deadline that has seen steps of these durations."""
    clock = chain.from_iterable((0.0, float(d)) for d in durations)
    deadline = Deadline(LIMIT, lambda: next(clock))
    for _ in durations:
        deadline.begin()
        deadline.end()
    return deadline


def test_late_steps_are_counted_and_told():
    deadline = timed([1e-4, 2e-3, 1e-3, 5e-3, 1e-4, 1.1e-3, 9e-4])
    assert (deadline.cycles, deadline.late, deadline.worst, deadline.last) == (7, 3, 5e-3, 9e-4)
    assert str(deadline) == "deadline 1 ms: 3 of 7 cycles late, worst 5 ms, 99.9 % within 5 ms"


@pytest.mark.parametrize("percent", [50.0, 99.0, 99.9])
def test_percentiles_are_those_of_all_steps(percent):
    """To the width of a class above, and never below, numpy's of everything that was measured."""
    durations = 1e-4 * np.exp(np.random.default_rng(0).standard_normal(20_000))
    exact = float(np.percentile(durations, percent, method="inverted_cdf"))
    assert 1.0 <= timed(durations).percentile(percent) / exact <= 2 ** (1 / 32) * (1 + 1e-12)


def test_memory_does_not_grow():
    few, many = timed([1e-4]), timed(np.linspace(1e-6, 1e-2, 5000))
    assert sys.getsizeof(few._counts) == sys.getsizeof(many._counts)
    assert len(vars(few)) == len(vars(many))


def test_durations_beyond_the_classes():
    """A clock that stands still or goes back is no time, and an hour is in the last class."""
    assert timed([0.0, -1.0]).worst == 0
    assert timed([3600.0]).percentile() == 3600.0
    assert timed([]).percentile() == 0


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, np.inf, "1", True])
def test_a_deadline_is_a_positive_number(limit):
    with pytest.raises(InvalidValue, match="expected a positive number of seconds"):
        Deadline(limit, lambda: 0.0)


def test_a_stepper_times_its_steps_and_says_so():
    """Also a step that is refused has its time; without a deadline nothing is timed, and the commands are the same."""
    ticks = chain([0.0, 0.5e-3, 1.0, 1.002, 2.0, 2.0001], repeat(3.0))
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0))
    stepper = fp.Stepper(PROBLEM, controller, compiled=False, deadline=LIMIT, clock=lambda: next(ticks))
    plain = fp.Stepper(PROBLEM, controller, compiled=False)
    assert "no cycle yet" in repr(stepper)
    first, memory = stepper.step(0.0, np.ones(4), np.zeros(2), stepper.start())
    stepper.step(PROBLEM.period, np.ones(4), np.zeros(2), memory)
    assert stepper.deadline is not None
    assert stepper.deadline.last > LIMIT
    with pytest.raises(FpirhcError):
        stepper.step(0.0, np.ones(3), np.zeros(2), memory)
    assert (stepper.deadline.cycles, stepper.deadline.late) == (3, 1)
    assert "1 of 3 cycles late, worst 2 ms" in repr(stepper)
    assert "deadline" not in repr(plain)
    assert np.array_equal(plain.step(0.0, np.ones(4), np.zeros(2), plain.start())[0], first)
