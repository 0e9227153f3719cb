"""Quantiles of many numbers in little memory."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable

import numpy as np


class Quantiles:
    """Numbers, any of which is told by its place in the order of size.

    The first `room` numbers are kept as they are. A full buffer is sorted and every second number of it goes on to the next
    buffer, where it counts twice as much: in turns those at even and at odd places, so that two of these steps together move no
    number by more than the weight that it had. There are as many buffers as the count has powers of two above `room`.

    Args:
        numbers: the first ones; infinite ones are allowed, NaN is not.
        room: numbers of a buffer, an even number.

    Attributes:
        count: numbers in all.

    References:
        J. I. Munro, M. S. Paterson, Selection and sorting with limited storage, Theoretical Computer Science 12, 1980.
        G. S. Manku, S. Rajagopalan, B. G. Lindsay, Approximate medians and other quantiles in one pass and with limited memory,
        Proc. ACM SIGMOD, 1998.
    """

    def __init__(self, numbers: Iterable[float] = (), room: int = 8192) -> None:
        self._room, self.count = room, 0
        self._buffers, self._steps = [array("d")], [0]
        self._last = self._buffers[0]
        for number in numbers:
            self.add(number)

    def add(self, number: float) -> None:
        """Add one number."""
        if len(self._last) >= self._room:
            self._pass_on(0)
            self._last = self._buffers[0]
        self._last.append(number)
        self.count += 1

    @property
    def error(self) -> int:
        """By how many places at most a number that is told is away from where it was asked: guaranteed, and 0 up to `room`."""
        return sum(2**level * ((steps + 1) // 2) for level, steps in enumerate(self._steps))

    @property
    def numbers(self) -> np.ndarray:
        """All numbers in the order in which they came; of more than `room`, those since the last full buffer."""
        return np.array(self._last)

    def at(self, place: int) -> float:
        """Return the number at a place, from 0, or at the nearest place that there is."""
        sizes = [len(one) for one in self._buffers]
        numbers, weights = np.concatenate(self._buffers), np.repeat(2 ** np.arange(len(sizes)), sizes)
        order = np.argsort(numbers, kind="stable")
        place = min(max(place, 0), self.count - 1)
        return float(numbers[order[np.searchsorted(np.cumsum(weights[order]), place, side="right")]])

    @property
    def median(self) -> float:
        """The number in the middle; between two numbers it is half their sum, and between minus and plus infinity zero."""
        low, high = self.at((self.count - 1) // 2), self.at(self.count // 2)
        between = 0.5 * low + 0.5 * high
        return low if low == high else 0.0 if math.isnan(between) else between

    def _pass_on(self, level: int) -> None:
        if level + 1 == len(self._buffers):
            self._buffers.append(array("d"))
            self._steps.append(0)
        if len(self._buffers[level + 1]) >= self._room:
            self._pass_on(level + 1)
        self._buffers[level + 1].extend(sorted(self._buffers[level])[self._steps[level] % 2 :: 2])
        self._buffers[level] = array("d")
        self._steps[level] += 1
