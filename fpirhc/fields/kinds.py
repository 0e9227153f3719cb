"""Numbers with a range, for the annotations of fields: `rate: Positive`. A type checker reads them as float or int."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, TypeAlias


@dataclass(frozen=True)
class Range:
    """The interval of a number, with its words for a user.

    Args:
        words: of the whole expectation: "a positive number".
        low: least value.
        high: largest value.
        open_low: whether `low` itself is refused.
        open_high: whether `high` itself is refused.
    """

    words: str
    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False

    def holds(self, value: float) -> bool:
        """Whether the value lies in the range; NaN does not."""
        above = value > self.low if self.open_low else value >= self.low
        below = value < self.high if self.open_high else value <= self.high
        return above and below


Positive: TypeAlias = Annotated[float, Range("a finite number above 0", low=0.0, open_low=True, open_high=True)]
Deviation: TypeAlias = Annotated[  # its square is finite, and not zero
    float, Range("a positive number from 1e-100 to 1e100", low=1e-100, high=1e100)
]
Duration: TypeAlias = Annotated[
    float, Range("a number from 1e-12 to 1e12 in the plant's unit of time", low=1e-12, high=1e12)
]
Accuracy: TypeAlias = Annotated[
    float, Range("a number above 0 and below 1", low=0.0, high=1.0, open_low=True, open_high=True)
]
Count: TypeAlias = Annotated[int, Range("a whole number from 1 to 1000000", low=1, high=1e6)]
Few: TypeAlias = Annotated[int, Range("a whole number from 1 to 1000", low=1, high=1000)]
Seed: TypeAlias = Annotated[int, Range("a whole number of at least 0", low=0)]  # of random numbers
CountOrZero: TypeAlias = Annotated[int, Range("a whole number of at least 0", low=0)]
