"""Numbers: kinds with a range for the annotations of fields, `rate: Positive`; what counts as one; words for what is none.

A type checker reads a kind as float or int.
"""

from __future__ import annotations

import inspect
import math
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Annotated, TypeAlias, TypeVar

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidField

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
_SHORT.maxdict = 2


def described(value: object) -> str:
    """Return a value in a few words."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, ca.SX | ca.MX):
        return f"a CasADi {'symbol' if value.is_valid_input() else 'expression'} ({_SHORT.repr(value)})"
    if isinstance(value, str):
        return f"the text {_SHORT.repr(value)}"
    if inspect.isroutine(value):
        return f"the function {getattr(value, '__name__', value)}{signature_of(value)}"
    if value is None or isinstance(value, int | float | tuple | list | dict | set):
        return _SHORT.repr(value)
    array = f"an array of the shape {value.shape} and the type {value.dtype}" if isinstance(value, np.ndarray) else ""
    return array or f"a value of the class {type(value).__name__}"


def shortened(value: object) -> str:
    """Return a value as Python writes it, with a gap in the middle where it is long."""
    return _SHORT.repr(value)


def call_of(one: type | Callable[..., object]) -> str:
    """Return how a value of the class, or a call of the function, is written: "Sigmoid(gain=...)"."""
    makes: Callable[..., object] = getattr(one, "__init__") if isinstance(one, type) else one  # noqa: B009
    try:
        parameters = list(inspect.signature(makes).parameters.values())[isinstance(one, type) :]
    except ValueError:
        parameters = []
    needed = [
        p.name for p in parameters if p.default is p.empty and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)
    ]
    return f"{one.__name__}({', '.join(f'{name}=...' for name in needed)})"


def signature_of(function: Callable[..., object]) -> str:
    """Return the arguments of a function as it declares them; (...) where they are not known."""
    try:
        return str(inspect.signature(function))
    except (TypeError, ValueError):
        return "(...)"


@dataclass(frozen=True)
class Range:
    """The interval of a number, with its words for a user."""

    words: str  # of the whole expectation: "a positive number"
    low: float = -math.inf  # least value
    high: float = math.inf  # largest value
    open_low: bool = False  # whether `low` itself is refused
    open_high: bool = False  # whether `high` itself is refused

    def holds(self, value: float) -> bool:
        """Whether the value lies in the range; NaN does not."""
        above = value > self.low if self.open_low else value >= self.low
        below = value < self.high if self.open_high else value <= self.high
        return above and below


class _NotZero(Range):
    """A finite number other than zero."""

    def holds(self, value: float) -> bool:
        return math.isfinite(value) and value != 0


def whole(low: int, high: int) -> Range:
    """Return the range of a whole number."""
    return Range(f"a whole number from {low} to {high}", low, high)


class _JudgedByOwner(Range):
    """Any number, NaN among them: whoever holds it by name refuses what is not finite, with this name."""

    def holds(self, value: float) -> bool:
        del value
        return True


JudgedByOwner: TypeAlias = Annotated[float, _JudgedByOwner("a finite number")]
Positive: TypeAlias = Annotated[float, Range("a finite number above 0", low=0.0, open_low=True, open_high=True)]
Finite: TypeAlias = Annotated[float, Range("a finite number", open_low=True, open_high=True)]
NotNegative: TypeAlias = Annotated[float, Range("a finite number of at least 0", low=0.0, open_high=True)]
NotZero: TypeAlias = Annotated[float, _NotZero("a finite number other than zero (no adaptation is Identity())")]
BelowOne: TypeAlias = Annotated[float, Range("a number from 0 to below 1", low=0.0, high=1.0, open_high=True)]
Deviation: TypeAlias = Annotated[  # its square is finite, and not zero
    float, Range("a positive number from 1e-100 to 1e100", low=1e-100, high=1e100)
]
Duration: TypeAlias = Annotated[
    float, Range("a number from 1e-12 to 1e12 in the plant's unit of time", low=1e-12, high=1e12)
]
Accuracy: TypeAlias = Annotated[
    float, Range("a number above 0 and below 1", low=0.0, high=1.0, open_low=True, open_high=True)
]
Count: TypeAlias = Annotated[int, whole(1, 1_000_000)]
Few: TypeAlias = Annotated[int, whole(1, 1000)]
Seed: TypeAlias = Annotated[int, Range("a whole number of at least 0", low=0)]  # of random numbers
CountOrZero: TypeAlias = Annotated[int, Range("a whole number of at least 0", low=0)]


def real_number(value: object) -> float | None:
    """Return one real number as a float, which may be NaN or infinite; None for everything else.

    Arrays with one entry count. No numbers are texts, truth values, None, complex numbers, durations (numpy makes integers of
    them), expressions, and whole numbers beyond the largest float, 1.8e308.
    """
    if type(value) is float:
        return value
    if isinstance(value, np.ndarray):
        if isinstance(value, np.ma.MaskedArray) or value.size != 1:
            return None
        value = value.ravel()[0]
    if isinstance(value, bool | np.bool_ | np.timedelta64) or not isinstance(value, Real):
        return None
    try:
        return float(value)
    except (OverflowError, TypeError, ValueError):  # 10**400; a class of somebody's that only says that it is a number
        return None


def finite_number(value: object) -> bool:
    """Return whether it is one real number that is finite."""
    number = real_number(value)
    return number is not None and math.isfinite(number)


Value = TypeVar("Value")


def named_entries(what: str, entries: Mapping[str, Value]) -> Mapping[str, Value]:
    """Return the entries as they are, by name; `what` names them: "settings"."""
    if not isinstance(entries, Mapping):
        raise InvalidField([f"{what}: expected a mapping {{name: number}}, got {described(entries)}"])
    strange = [name for name in entries if not isinstance(name, str)]
    if strange:
        raise InvalidField([f"{what}: expected names as texts, got the name {described(one)}" for one in strange])
    return entries
