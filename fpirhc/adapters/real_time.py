"""Devices that move by themselves: the clock of their cycles, and the form that field buses share.

A bus is a link: it is opened, takes the values of the inputs, and gives those of the measurements with their ages. A bad status
is an exception of the link, and a value that is too old is one of the device: both are bad answers, see `ExternalPlant`.
A bad answer lasts its cycle, and a cycle that ends more than a period late is one too: no burst of commands makes up for it.
A bus without time stamps has a counter in their place: the values are as old as the time for which it stands still.
"""

from __future__ import annotations

import time as wall
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from fpirhc.adapters.names import require, require_seconds
from fpirhc.errors import InvalidProblem, Mistakes
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant, quantities

Address = TypeVar("Address")


@dataclass
class RealTime:
    """The time of a run by the clock on the wall.

    Args:
        clock: function that returns the wall time, s.
        sleep: function that waits for some seconds.
    """

    clock: Callable[[], float] = wall.monotonic
    sleep: Callable[[float], None] = wall.sleep
    _zero: float | None = None  # the wall time at which the run has time 0

    def begin(self) -> None:
        """The next cycle is the first; what is built before it has no cycle."""
        self._zero = None

    @contextmanager
    def cycle(self, time: float, period: float) -> Iterator[None]:
        """Do what stands in the body, and return at the end of the cycle that has begun at this time of the run.

        Raises:
            InvalidProblem: the cycle ended more than a period late; the run goes on from now.
        """
        if self._zero is None:
            self._zero = self.clock() - time
        try:
            yield
        finally:
            late = self._late(self._zero + time + period, period)
        require(
            late <= period,
            f"the cycle of {period:g} s ended {late:.3g} s late; choose a longer period, or a quicker bus or controller",
        )

    def _late(self, end: float, period: float) -> float:
        """Wait for the end; where it is missed by a period, commands until now would else go out at one instant."""
        assert self._zero is not None
        self.sleep(max(end - self.clock(), 0.0))
        late = self.clock() - end
        if late > period:
            self._zero += late
        return late


class Link(Protocol):
    """A bus on which inputs are written and measurements are read, in the order of their addresses."""

    def open(self) -> None:
        """Connect; an earlier connection is closed."""

    def write(self, command: Iterable[float]) -> None:
        """Send the values of the inputs."""

    def read(self) -> Iterable[tuple[float, float]]:
        """Return (value, age in s) of every measurement; age inf where it has no time stamp, 0 where a counter has one."""


@dataclass(frozen=True)
class Setup:
    """What the buses have in common.

    Args:
        where: function whose arguments these are, for messages.
        period: of the problem, s.
        oldest: age of a value beyond which it is bad, s; None: any age.
        holds: consecutive bad answers that are bridged; see `ExternalPlant`.
        clock: of the cycles; None: the clock on the wall.
        example: of an address, for messages.
    """

    where: str
    period: float
    oldest: float | None
    holds: int
    clock: RealTime | None
    example: str


def device(
    setup: Setup,
    model: Plant,
    measures: Mapping[str, Address],
    inputs: Mapping[str, Address],
    connect: Callable[[list[Address], list[Address]], Link],
    counter: Address | None = None,
) -> ExternalPlant:
    """Return a device on a bus as a reality.

    Args:
        setup: what the buses have in common.
        model: the controller's model; the device has its units.
        measures: quantity of the model -> address that holds it.
        inputs: input of the model -> address that takes it; all inputs.
        connect: function (addresses of the inputs, of the measurements) -> link.
        counter: address of a value that changes whenever the device has measured.

    Raises:
        InvalidProblem: a quantity that the model does not have, an input without address, or a model whose time is not in s.
    """
    require_seconds(setup.where, model)
    units, mistakes = quantities(model), Mistakes(setup.where)
    mistakes.unknown("measures: quantity", measures, units)
    mistakes.unknown("inputs: input", inputs, model.inputs)
    for name in (name for name in model.inputs if name not in inputs):
        mistakes.add(f"inputs: {name} has no address; add inputs={{'{name}': {setup.example}}}")
    mistakes.raise_if_any()
    counted = [] if counter is None else [counter]
    link = connect([inputs[name] for name in model.inputs], [*counted, *measures.values()])
    body = _Device(link, tuple(measures), setup, bool(counted))
    told = {name: units[name] for name in measures}
    return ExternalPlant(body, measures=told, holds=setup.holds, period=setup.period)


class _Standstill:
    """For how long a counter has shown the same."""

    def __init__(self, now: RealTime) -> None:
        self._now = now
        self.begin()

    def begin(self) -> None:
        """Whatever the counter shows first is new."""
        self._count, self._since = np.nan, 0.0

    def age(self, count: float) -> float:
        """Return the time since the counter changed, s, now that it shows this count."""
        now = self._now.clock()
        if count != self._count:
            self._count, self._since = count, now
        return now - self._since


class _Device:
    """A link in the rhythm of the cycles. `counts`: whether the link reads a counter first."""

    def __init__(self, link: Link, names: tuple[str, ...], setup: Setup, counts: bool) -> None:
        self._link, self._names, self._setup, self._clock = link, names, setup, setup.clock or RealTime()
        self._still = _Standstill(self._clock) if counts else None

    def reset(self, _seed: int) -> np.ndarray:
        """Connect, and measure."""
        self._link.open()
        self._clock.begin()
        if self._still is not None:
            self._still.begin()
        return self._measured()

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Write the command, and read at the end of the cycle."""
        with self._clock.cycle(time, self._setup.period):
            self._link.write(command)
        return self._measured()

    def _measured(self) -> np.ndarray:
        oldest, values, shown = self._setup.oldest, [], iter(self._link.read())
        still = 0.0 if self._still is None else self._still.age(next(shown)[0])
        for name, (value, age) in zip(self._names, shown, strict=True):
            if oldest is not None and max(age, still) > oldest:
                told = "has no time stamp" if np.isinf(age) else f"is {max(age, still):.3g} s old"
                raise InvalidProblem(f"{name} {told}, and the oldest that is used is {oldest:g} s")
            values.append(value)
        return np.array(values)
