"""Cycles by the clock on the wall, which is the test's own: what a bus that fails or is slow costs, and what it does not send."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pytest
from tank import PERIOD, TANK, Tank

import fpirhc as fp
from fpirhc.adapters.real_time import Setup, device

LONG = 2.95  # s, for which a write hangs


class Bus:
    """A link whose third command is `bad`: the times of its commands are kept."""

    def __init__(self, bad: str) -> None:
        self.bad, self.sent, self.times = bad, 0.0, [0.0]
        self.tank = Tank(lambda: self.sent, lambda _level: None)

    def open(self) -> None:
        self.times = []

    def write(self, command: Iterable[float]) -> None:
        (self.sent,) = command
        self.times.append(self.tank.now)
        if self.bad == "refused" and len(self.times) == 3:
            raise ConnectionError
        if self.bad == "hangs" and len(self.times) == 3:
            self.tank.sleep(LONG)

    def read(self) -> Iterator[tuple[float, float]]:
        yield self.tank.level, 0.0


def on(bus: Bus, holds: int = 0) -> fp.ExternalPlant:
    setup = Setup("mine", PERIOD, None, holds, bus.tank.clock, "1")
    return device(setup, TANK, {"h": 1}, {"q": 2}, lambda _sent, _read: bus)


def mistakes(bus: Bus, own: list[float]) -> list[str]:
    """Why the answer of each cycle is bad, or nothing; the controller takes its own time, s, before each."""
    body = on(bus)
    body.first(0)
    found = []
    for k, seconds in enumerate(own):
        bus.tank.sleep(seconds)
        found.append(body.read(k * PERIOD, np.array([0.5])).mistake)
    return found


def test_a_command_that_is_refused_lasts_its_cycle():
    """All `holds` would else be used at one instant, while a buffer is full."""
    bus = Bus("refused")
    assert [bool(mistake) for mistake in mistakes(bus, [0.0] * 5)] == [False, False, True, False, False]
    assert np.diff(bus.times) == pytest.approx([PERIOD] * 4)


def test_a_command_that_hangs_is_told_and_no_burst_follows():
    """The commands of the missed cycles would else go out at one instant, and the run would be complete."""
    bus = Bus("hangs")
    told = mistakes(bus, [0.0] * 6)
    assert [bool(mistake) for mistake in told] == [False, False, True, False, False, False]
    assert "the cycle of 0.1 s ended 2.85 s late; choose a longer period, or a quicker bus or controller" in told[2]
    assert np.diff(bus.times) == pytest.approx([PERIOD, PERIOD, LONG, PERIOD, PERIOD])


def test_a_cycle_that_is_a_little_late_is_caught_up():
    """The clock does not drift with the controller's own time; time 0 is that of the first command."""
    bus = Bus("")
    assert not any(mistakes(bus, [1.0, 0.15, 0.0, 0.0]))
    assert bus.tank.now == pytest.approx(1.0 + 4 * PERIOD)


def test_a_run_goes_on_behind_a_command_that_hangs():
    bus = Bus("hangs")
    task = fp.Problem(
        plant=TANK,
        reality=on(bus, holds=1),
        sensing=fp.Sensing(estimator=fp.PositionDifference()),
        reference=fp.Trajectory(lambda t: {"h": 1.0 + 0.1 * t}),
        start={"h": 1.0},
        period=PERIOD,
        duration=2.0,
    )
    run = fp.simulate(task, fp.ComputedTorque(fp.Exponential(rate=2.0)), seed=0, compiled=False)
    assert run.stop is None
    assert len(bus.times) == 20
    assert list(np.flatnonzero(run["foreign_held"])) == [3]
