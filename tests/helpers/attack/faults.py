"""Faults of a loop as values: what happens to the sample, the command, the memory or the plant, and in which cycles."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

Array = np.ndarray
FIRST, BEGIN = 0, 30  # cycles in which faults begin


@dataclass
class Cycle:
    """What one cycle of a loop passes on; a fault changes it in place."""

    number: int
    time: float
    state: Array
    realised: Array
    memory: Array
    past: list[tuple[Array, Array]]  # earlier samples, newest last


@dataclass(frozen=True)
class Fault:
    """A fault that begins, lasts and ends."""

    name: str
    sample: Callable[[Cycle], None] | None = None
    actuator: Callable[[Array, Array, Array], Array] | None = None  # (command, lower, upper) -> what the plant is given
    heavier: float = 1.0  # factor on the plant's first parameter
    first: int = BEGIN
    length: int = 1
    single: bool = False  # one bad sample, after which everything must be as with the tick left out

    @property
    def end(self) -> int:
        """First cycle after the fault."""
        return self.first + self.length


def _set(what: str, value: float, entry: int | None = None) -> Callable[[Cycle], None]:
    def change(cycle: Cycle) -> None:
        array = getattr(cycle, what).copy()
        array[slice(None) if entry is None else entry] = value
        setattr(cycle, what, array)

    return change


def _clock(change: Callable[[float], float]) -> Callable[[Cycle], None]:
    def apply(cycle: Cycle) -> None:
        cycle.time = change(cycle.time)

    return apply


def _old(age: int) -> Callable[[Cycle], None]:
    def apply(cycle: Cycle) -> None:
        if len(cycle.past) > age:
            cycle.state, cycle.realised = cycle.past[-1 - age]

    return apply


def _stuck(cycle: Cycle) -> None:
    cycle.state, cycle.realised = cycle.past[BEGIN - 1]


def _poison(place: Callable[[int], slice]) -> Callable[[Cycle], None]:
    def apply(cycle: Cycle) -> None:
        cycle.memory = cycle.memory.copy()
        cycle.memory[place(cycle.memory.size)] = np.nan

    return apply


SINGLE = (
    Fault("state is NaN", _set("state", np.nan), single=True),
    Fault("one state is NaN", _set("state", np.nan, 0), single=True),
    Fault("state is infinite", _set("state", np.inf), single=True),
    Fault("response is NaN", _set("realised", np.nan), single=True),
    Fault("response is infinite", _set("realised", -np.inf), single=True),
    Fault("clock is NaN", _clock(lambda _: np.nan), single=True),
    Fault("state overflows, 1e301", _set("state", 1e301), single=True),
)
LASTING = (
    Fault("response spikes, 1e9", _set("realised", 1e9)),
    Fault("response spikes, 1e155", _set("realised", 1e155)),
    Fault("state spikes, 1e9", _set("state", 1e9)),
    Fault("state spikes, 1e155", _set("state", 1e155)),
    Fault("samples lost, 5 cycles", _set("state", np.nan), length=5),
    Fault("samples stuck, 10 cycles", _stuck, length=10),
    Fault("samples 3 cycles late", _old(3), length=20),
    Fault("clock repeats", _clock(lambda t: t - 1e-3), length=2),
    Fault("clock goes back", _clock(lambda t: 0.5 * t), length=3),
    Fault("clock overflows", _clock(lambda _: 1e308)),
    Fault("memory is NaN", _poison(lambda _: slice(None))),
    Fault("half of the memory is NaN", _poison(lambda n: slice(n // 2, None))),
    Fault("one number of the memory is NaN", _poison(lambda n: slice(n - 1, n))),
    Fault("actuator gives nothing", actuator=lambda u, low, high: 0 * u, length=15),
    Fault(
        "actuator stuck at its upper limit",
        actuator=lambda u, low, high: np.where(np.isfinite(high), high, u),
        length=15,
    ),
    Fault("actuator of the opposite sign", actuator=lambda u, low, high: -u, length=15),
    Fault("parameter jumps", heavier=1.3, length=10**6),
)
_EARLY = (*SINGLE, *(f for f in LASTING if "spikes" in f.name))
AT_START = tuple(replace(f, name=f"at the start, {f.name}", first=FIRST, length=3, single=False) for f in _EARLY)
FAULTS = (*SINGLE, *LASTING, *AT_START)
