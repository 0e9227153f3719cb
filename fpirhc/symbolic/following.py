"""Numbers that follow from live settings by way of Python: a signal that a block reads, and what computes it.

    row = following("lyapunov_row", live_numbers(self.tracking), lambda values: ...)   # None without live settings
    Block(..., reads + row.reads, derived=row.derived)

The signal is named after its first setting, so that two controllers in one loop have two of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fpirhc.symbolic.block import Derived, Values
from fpirhc.symbolic.layout import Layout, Signal, scalar
from fpirhc.symbolic.live import DERIVED, PREFIX, LiveNumber, is_live


@dataclass(frozen=True, eq=False)
class Following:
    """A column of numbers that follows from live settings.

    Args:
        signal: that the block reads, with the numbers of the build as its start.
        settings: from which it follows, by path.
        of: function of the numbers of all settings, by path, that returns the column.
        stale: what becomes of a loop that goes on with the old column; '' where it must not, see `Derived`.
    """

    signal: Signal
    settings: Mapping[str, LiveNumber]
    of: Callable[[Values], np.ndarray]
    stale: str

    @property
    def reads(self) -> Layout:
        """The signal, and the settings themselves, for a block that does not use these by itself."""
        own = tuple(scalar(PREFIX + path, start=number.value) for path, number in self.settings.items())
        return Layout((self.signal, *own))

    def derived(self, values: Values) -> Derived:
        """Return the column for these numbers of the settings."""
        return Derived({self.signal.name: self.of(values)}, stale={self.signal.name: self.stale})


def remembered(name: str, elements: Sequence[str], values: Sequence[float]) -> Layout:
    """Return the signal in which a block remembers numbers, to notice a change; none where no run changes them."""
    return Layout((Signal(name, tuple(elements), start=(1.0,) * len(values)),)) if is_live(values) else Layout()


def following(
    name: str, settings: Mapping[str, LiveNumber], of: Callable[[Values], np.ndarray], stale: str = ""
) -> Following | None:
    """Return the column that `of` computes from live settings; None where there are none."""
    if not settings:
        return None
    start = of({path: number.value for path, number in settings.items()})
    elements = tuple(str(k) for k in range(start.size))
    signal = Signal(f"{PREFIX}{DERIVED}{next(iter(settings))}.{name}", elements, start=tuple(map(float, start)))
    return Following(signal, settings, of, stale)
