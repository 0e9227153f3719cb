"""Numbers: kinds with a range for annotations, `rate: Positive`; what an annotation expects; words for what does not fit.

A type checker reads a kind as float or int.
"""

from __future__ import annotations

import collections.abc
import difflib
import inspect
import math
import numbers
import re
import reprlib
import types
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Annotated, TypeAlias, TypeVar

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidField
from fpirhc.symbolic.open import is_open

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
AboveZero: TypeAlias = Annotated[float, Range("a number above 0", low=0.0, open_low=True)]  # infinite too
Finite: TypeAlias = Annotated[float, Range("a finite number", open_low=True, open_high=True)]
NotNegative: TypeAlias = Annotated[float, Range("a finite number of at least 0", low=0.0, open_high=True)]
AtLeastOne: TypeAlias = Annotated[float, Range("a finite number of at least 1", low=1.0, open_high=True)]
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
Product: TypeAlias = Annotated[  # of effective gain and eigenvalue, with which an iteration converges without dead time
    float,
    Range("effective gain times eigenvalue above 0 and below 2", low=0.0, high=2.0, open_low=True, open_high=True),
]
Count: TypeAlias = Annotated[int, whole(1, 1_000_000)]
FEW = 1000
Few: TypeAlias = Annotated[int, whole(1, FEW)]
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


class Expected(ABC):
    """Contract: what one annotation accepts."""

    @property
    @abstractmethod
    def words(self) -> str:
        """What is expected, after the word "expected"."""

    @abstractmethod
    def fits(self, value: object) -> bool:
        """Whether the value itself is of the right kind, whatever its parts are."""

    def parts(self, value: object) -> Iterator[tuple[str, Expected, object]]:
        """Yield (place, expectation, part) for every part of a value that fits."""
        del value
        yield from ()

    def contract(self) -> type | None:
        """Return the class whose values are expected, for a hint at the members of a family; None where there is none."""
        return None

    def contracts(self) -> tuple[type, ...]:
        """Return all such classes."""
        one = self.contract()
        return () if one is None else (one,)

    def completed(self, part: object) -> str:
        """Return how a value that is only a part of what is expected is written; empty where it is none."""
        del part
        return ""


def accepts(expected: Expected, value: object) -> bool:
    """Whether the value and all its parts are as expected."""
    if not expected.fits(value):
        return False
    for _, inner, part in expected.parts(value):  # noqa: SIM110 -- most values have no parts, and a generator costs a call
        if not accepts(inner, part):
            return False
    return True


@dataclass(frozen=True)
class Anything(Expected):
    """No expectation: an annotation that is not understood checks nothing."""

    words = "anything"

    def fits(self, value: object) -> bool:
        del value
        return True


@dataclass(frozen=True)
class Number(Expected):
    """A number that is not NaN, as Python or numpy have it, or a number that stands for a symbol."""

    whole: bool
    within: Range | None = None

    @property
    def words(self) -> str:
        return self.within.words if self.within else "a whole number" if self.whole else "a number"

    def fits(self, value: object) -> bool:
        if type(value) not in _OFTEN:  # the tests of abstract classes are slow
            if is_open(value):
                return True
            if isinstance(value, np.ndarray):
                return False
        if self.whole and not isinstance(value, numbers.Integral):
            return False
        number = value if type(value) is float else real_number(value)
        if number is None:  # a whole number beyond the largest float is a whole number
            return self.whole and type(value) is int and (self.within is None or self.within.holds(value))
        return not math.isnan(number) if self.within is None else self.within.holds(number)


@dataclass(frozen=True)
class OneOf(Expected):
    """One of some texts."""

    texts: tuple[str, ...]

    @property
    def words(self) -> str:
        return " or ".join(f"'{text}'" for text in self.texts)

    def fits(self, value: object) -> bool:
        return isinstance(value, str) and value in self.texts

    def completed(self, part: object) -> str:
        near = difflib.get_close_matches(part, self.texts, n=1) if isinstance(part, str) else []
        return f"write '{near[0]}'" if near else ""


@dataclass(frozen=True)
class Instance(Expected):
    """A value of a class."""

    one: type

    @property
    def words(self) -> str:
        if self.one in _WORDS:
            return _WORDS[self.one]
        return f"{'an' if self.one.__name__[0] in 'AEIOU' else 'a'} {self.one.__name__}"

    def fits(self, value: object) -> bool:
        if self.one in (
            ca.SX,
            ca.MX,
            ca.DM,
        ):  # every kind of expression passes for every other: see symbolic.expression
            return isinstance(value, ca.SX | ca.MX | ca.DM | int | float)
        if self.one is np.ndarray:
            return isinstance(value, np.ndarray | ca.DM) or _is_array(value)
        return isinstance(value, np.bool_ if isinstance(value, np.bool_) and self.one is bool else self.one)

    def contract(self) -> type | None:
        return self.one


@dataclass(frozen=True)
class Entries(Expected):
    """A mapping."""

    key: Expected
    value: Expected

    @property
    def words(self) -> str:
        return f"{{name: {self.value.words}}}"

    def fits(self, value: object) -> bool:
        return isinstance(value, Mapping)

    def parts(self, value: object) -> Iterator[tuple[str, Expected, object]]:
        assert isinstance(value, Mapping)
        for key, entry in value.items():
            yield f": name {shortened(key)}", self.key, key
            yield f"[{shortened(key)}]", self.value, entry

    def completed(self, part: object) -> str:
        one = shortened(part) if isinstance(part, int | float | tuple | str) else f"{type(part).__name__}(...)"
        return f"write {{'NAME': {one}}} with the name of what it belongs to" if accepts(self.value, part) else ""


@dataclass(frozen=True)
class Items(Expected):
    """A sequence, of any length or of a stated one."""

    items: tuple[Expected, ...]
    fixed: bool

    @property
    def words(self) -> str:
        if self.fixed:
            return f"({', '.join(item.words for item in self.items)})"
        return f"({self.items[0].words}, ...)"

    def fits(self, value: object) -> bool:
        if isinstance(value, np.ndarray):
            return value.ndim == 1 and (not self.fixed or len(value) == len(self.items))
        ordered = isinstance(value, Sequence) and not isinstance(value, str | bytes)
        return ordered and (not self.fixed or len(typing.cast(Sequence[object], value)) == len(self.items))

    def parts(self, value: object) -> Iterator[tuple[str, Expected, object]]:
        for k, part in enumerate(typing.cast(Sequence[object], value)):
            yield f"[{k}]", self.items[k] if self.fixed else self.items[0], part

    def completed(self, part: object) -> str:
        if self.fixed or not accepts(self.items[0], part):
            return ""
        several = tuple(re.split(r"\s*,\s*", part)) if isinstance(part, str) else (part,)
        return f"write {shortened(several)}"


@dataclass(frozen=True)
class Call(Expected):
    """A function, with the number of arguments that it is called with; None: unknown."""

    arguments: int | None

    @property
    def words(self) -> str:
        if self.arguments is None:
            return "a function"
        return f"a function of {self.arguments} argument{'' if self.arguments == 1 else 's'}"

    def fits(self, value: object) -> bool:
        return callable(value) and takes(value, self.arguments)


@dataclass(frozen=True)
class Choice(Expected):
    """One of several expectations."""

    options: tuple[Expected, ...]

    @property
    def words(self) -> str:
        return " or ".join(option.words for option in self.options)

    def fits(self, value: object) -> bool:
        return any(option.fits(value) for option in self.options)

    def parts(self, value: object) -> Iterator[tuple[str, Expected, object]]:
        fitting = [option for option in self.options if option.fits(value)]
        accepting = next((option for option in fitting if accepts(option, value)), fitting[0])
        yield from accepting.parts(value)

    def contract(self) -> type | None:
        return next(iter(self.contracts()), None)

    def contracts(self) -> tuple[type, ...]:
        return tuple(one for option in self.options for one in option.contracts() if one not in _WORDS)

    def completed(self, part: object) -> str:
        return ", or ".join(text for option in self.options if (text := option.completed(part)))


def takes(function: Callable[..., object], arguments: int | None) -> bool:
    """Whether a function can be called with so many arguments; True where it has no signature, or the number is None."""
    if arguments is None:
        return True
    try:
        inspect.signature(function).bind(*[None] * arguments)
    except TypeError:
        return False
    except ValueError:
        return True
    return True


def expected_by(annotation: object) -> Expected:  # noqa: PLR0911 -- one line per kind of annotation
    """Return what an annotation expects; unsupported annotations are not checked."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return _annotated(arguments)
    if origin is typing.Literal:
        return OneOf(arguments)
    if origin in (typing.Union, types.UnionType):
        return Choice(tuple(expected_by(a) for a in arguments))
    if origin is collections.abc.Callable or annotation is collections.abc.Callable:
        known = bool(arguments) and isinstance(arguments[0], list)
        return Call(len(arguments[0]) if known else None)
    if isinstance(origin, type):
        return _container(origin, arguments)
    if annotation in (float, int):
        return Number(whole=annotation is int)
    if annotation is None:
        return Instance(type(None))
    if (
        not isinstance(annotation, type)
        or annotation in (object, typing.Any)
        or getattr(annotation, "_is_protocol", False)
    ):
        return Anything()
    return Instance(annotation)


def _annotated(arguments: tuple[typing.Any, ...]) -> Expected:
    within = next(iter([a for a in arguments[1:] if isinstance(a, Range)]), None)
    if within is not None and arguments[0] in (int, float):
        return Number(arguments[0] is int, within)
    return expected_by(arguments[0])


def _container(origin: type, arguments: tuple[typing.Any, ...]) -> Expected:
    if issubclass(origin, Mapping) and len(arguments) == 2:
        return Entries(expected_by(arguments[0]), expected_by(arguments[1]))
    if issubclass(origin, tuple) and (len(arguments) != 2 or arguments[1] is not Ellipsis):
        return Items(tuple(expected_by(a) for a in arguments), fixed=True)
    if issubclass(origin, Sequence) and arguments:
        return Items((expected_by(arguments[0]),), fixed=False)
    return Instance(origin)


def _is_array(value: object) -> bool:
    """Whether numpy makes an array of numbers of a list."""
    if not isinstance(value, list | tuple):
        return False
    try:
        return not np.isnan(np.asarray(value, dtype=float)).any()
    except (TypeError, ValueError):
        return False


_OFTEN = (float, int)
_WORDS = {
    str: "a text",
    bool: "True or False",
    type(None): "None",
    dict: "a dict",
    ca.SX: "an expression",
    np.ndarray: "an array",
}
