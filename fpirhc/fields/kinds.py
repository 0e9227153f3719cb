"""Numbers: kinds with a range for annotations, `rate: Positive`; what an annotation expects; words for what does not fit.

A type checker reads a kind as float or int.
"""

from __future__ import annotations

import collections.abc
import inspect
import math
import numbers
import reprlib
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias, TypeVar

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidField

SHORT = reprlib.Repr()
SHORT.maxstring, SHORT.maxother, SHORT.maxdict = 60, 60, 2


def described(value: object) -> str:
    """Return a value in a few words."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, ca.SX | ca.MX):
        return f"a CasADi {'symbol' if value.is_valid_input() else 'expression'} ({SHORT.repr(value)})"
    if isinstance(value, str):
        return f"the text {SHORT.repr(value)}"
    if inspect.isroutine(value):
        return f"the function {getattr(value, '__name__', value)}{_signature(value) or '(...)'}"
    if isinstance(value, np.ndarray):
        return f"an array of the shape {value.shape} and the type {value.dtype}"
    plain = value is None or isinstance(value, int | float | tuple | list | dict | set)
    return SHORT.repr(value) if plain else f"a value of the class {type(value).__name__}"


def call_of(one: type | Callable[..., object]) -> str:
    """Return how a value of the class, or a call of the function, is written: "Sigmoid(gain=...)"."""
    given = found.parameters.values() if (found := _signature(one)) else ()
    needed = [p for p in given if p.default is p.empty and p.name != "self"]
    named = [f"{p.name}=..." for p in needed if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    return f"{one.__name__}({', '.join(named)})"


def _signature(function: Callable[..., object]) -> inspect.Signature | None:
    try:
        return inspect.signature(function)
    except (TypeError, ValueError):
        return None


def takes(function: Callable[..., object], arguments: int) -> bool:
    """Whether a function can be called with so many arguments; True where it has no signature."""
    signature = _signature(function)
    try:
        return signature is None or bool(signature.bind(*[None] * arguments))
    except TypeError:
        return False


@dataclass(frozen=True)
class Range:
    """Which numbers are meant, with the words for a user."""

    words: str  # of the whole expectation: "a positive number"
    holds: Callable[[float], bool]  # no comparison holds of NaN


def whole(low: int, high: int) -> Range:
    """Return the range of a whole number."""
    return Range(f"a whole number from {low} to {high}", lambda v: low <= v <= high)


JudgedByOwner: TypeAlias = Annotated[float, Range("a finite number", lambda _: True)]  # NaN too: who holds it names it
Positive: TypeAlias = Annotated[float, Range("a finite number above 0", lambda v: 0 < v < math.inf)]
AboveZero: TypeAlias = Annotated[float, Range("a number above 0", lambda v: v > 0)]  # infinite too
Finite: TypeAlias = Annotated[float, Range("a finite number", lambda v: -math.inf < v < math.inf)]
NotNegative: TypeAlias = Annotated[float, Range("a finite number of at least 0", lambda v: 0 <= v < math.inf)]
AtLeastOne: TypeAlias = Annotated[float, Range("a finite number of at least 1", lambda v: 1 <= v < math.inf)]
NotZero: TypeAlias = Annotated[
    float, Range("a finite number other than zero (no adaptation is Identity())", lambda v: math.isfinite(v) and v != 0)
]
BelowOne: TypeAlias = Annotated[float, Range("a number from 0 to below 1", lambda v: 0 <= v < 1)]
Deviation: TypeAlias = Annotated[  # its square is finite, and not zero
    float, Range("a positive number from 1e-100 to 1e100", lambda v: 1e-100 <= v <= 1e100)
]
Duration: TypeAlias = Annotated[
    float, Range("a number from 1e-12 to 1e12 in the plant's unit of time", lambda v: 1e-12 <= v <= 1e12)
]
Accuracy: TypeAlias = Annotated[float, Range("a number above 0 and below 1", lambda v: 0 < v < 1)]
Count: TypeAlias = Annotated[int, whole(1, 1_000_000)]
FEW = 1000
Few: TypeAlias = Annotated[int, whole(1, FEW)]
CountOrZero: TypeAlias = Annotated[int, Range("a whole number of at least 0", lambda v: v >= 0)]
Seed: TypeAlias = CountOrZero  # of random numbers


def real_number(value: object) -> float | None:
    """Return one real number as a float, which may be NaN or infinite; None for everything else."""
    if type(value) is float:
        return value
    if isinstance(value, np.ndarray):
        if isinstance(value, np.ma.MaskedArray) or value.size != 1:
            return None
        value = value.ravel()[0]
    # Of durations numpy makes integers.
    if isinstance(value, bool | np.bool_ | np.timedelta64) or not isinstance(value, numbers.Real):
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


Part: TypeAlias = tuple[str, "Expected", Any]  # place, expectation, value


@dataclass(frozen=True)
class Expected:
    """What one annotation accepts."""

    words: str  # after the word "expected"
    fits: Callable[[Any], bool]  # whether a value itself is of the right kind, whatever its parts are
    parts: Callable[[Any], Iterable[Part]] = lambda _: ()  # of a value that fits
    texts: tuple[str, ...] = ()  # that are expected, for the nearest one
    classes: tuple[type, ...] = ()  # whose values are expected, for a hint at the members of a family
    whole: bool = False  # whether whole numbers are


def accepts(expected: Expected, value: object) -> bool:
    """Whether the value and all its parts are as expected."""
    return expected.fits(value) and all(accepts(inner, part) for _, inner, part in expected.parts(value))


ANYTHING = Expected("anything", lambda _: True)  # an annotation that is not understood checks nothing
_OFTEN = (float, int)


def _number(integer: bool, within: Range | None = None) -> Expected:
    """A number that is not NaN, as Python or numpy have it."""

    def fits(value: Any) -> bool:
        if isinstance(value, np.ndarray) or (integer and not isinstance(value, numbers.Integral)):
            return False
        number = real_number(value)
        if number is None:  # a whole number beyond the largest float is a whole number
            return integer and type(value) is int and (within is None or within.holds(value))
        return not math.isnan(number) if within is None else within.holds(number)

    return Expected(within.words if within else "a whole number" if integer else "a number", fits, whole=integer)


def _one_of(texts: tuple[str, ...]) -> Expected:
    words = " or ".join(f"'{text}'" for text in texts)
    return Expected(words, lambda value: isinstance(value, str) and value in texts, texts=texts)


def _instance(one: type) -> Expected:
    """A value of a class; every kind of expression passes for every other: see symbolic.expression."""
    kinds: Any = {
        ca.SX: ca.SX | ca.MX | ca.DM | int | float, ca.MX: ca.SX | ca.MX | ca.DM | int | float,
        ca.DM: ca.SX | ca.MX | ca.DM | int | float, np.ndarray: np.ndarray | ca.DM, bool: bool | np.bool_,
    }.get(one, one)  # fmt: skip
    words = _WORDS.get(one, f"{'an' if one.__name__[0] in 'AEIOU' else 'a'} {one.__name__}")
    fits = (lambda v: isinstance(v, kinds) or _is_array(v)) if one is np.ndarray else lambda v: isinstance(v, kinds)
    return Expected(words, fits, classes=() if one in _WORDS else (one,))


def _is_array(value: object) -> bool:
    """Whether numpy makes an array of numbers of a list."""
    try:
        return isinstance(value, list | tuple) and not np.isnan(np.asarray(value, dtype=float)).any()
    except (TypeError, ValueError):
        return False


def _entries(key: Expected, entry: Expected) -> Expected:
    def parts(value: Mapping[Any, Any]) -> Iterable[Part]:
        for name, one in value.items():
            yield f": name {SHORT.repr(name)}", key, name
            yield f"[{SHORT.repr(name)}]", entry, one

    return Expected(f"{{name: {entry.words}}}", lambda value: isinstance(value, Mapping), parts)


def _items(items: tuple[Expected, ...], fixed: bool) -> Expected:
    """A sequence, of any length or of a stated one."""

    def fits(value: Any) -> bool:
        if isinstance(value, np.ndarray):
            return value.ndim == 1 and (not fixed or len(value) == len(items))
        ordered = isinstance(value, Sequence) and not isinstance(value, str | bytes)
        return ordered and (not fixed or len(value) == len(items))

    def parts(value: Any) -> Iterable[Part]:
        return ((f"[{k}]", items[k if fixed else 0], part) for k, part in enumerate(value))

    words = ", ".join(item.words for item in items)
    return Expected(f"({words})" if fixed else f"({words}, ...)", fits, parts)


def _function(arguments: int | None) -> Expected:
    """A function, with the number of arguments that it is called with; None: unknown."""
    if arguments is None:
        return Expected("a function", callable)
    words = f"a function of {arguments} argument{'' if arguments == 1 else 's'}"
    return Expected(words, lambda value: callable(value) and takes(value, arguments))


def _choice(options: tuple[Expected, ...]) -> Expected:
    def parts(value: Any) -> Iterable[Part]:
        fitting = [option for option in options if option.fits(value)]
        return next((option for option in fitting if accepts(option, value)), fitting[0]).parts(value)

    return Expected(
        " or ".join(option.words for option in options),
        lambda value: any(option.fits(value) for option in options),
        parts,
        tuple(text for option in options for text in option.texts),
        tuple(one for option in options for one in option.classes),
        any(option.whole for option in options),
    )


def expected_by(annotation: Any) -> Expected:  # noqa: PLR0911 -- one line per kind of annotation
    """Return what an annotation expects; unsupported annotations are not checked."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        within = next((a for a in arguments[1:] if isinstance(a, Range)), None)
        ranged = within is not None and arguments[0] in _OFTEN
        return _number(arguments[0] is int, within) if ranged else expected_by(arguments[0])
    if origin is typing.Literal:
        return _one_of(arguments)
    if origin in (typing.Union, types.UnionType):
        return _choice(tuple(expected_by(a) for a in arguments))
    if collections.abc.Callable in (origin, annotation):
        return _function(len(arguments[0]) if arguments and isinstance(arguments[0], list) else None)
    if isinstance(origin, type) and issubclass(origin, Mapping) and len(arguments) == 2:
        return _entries(expected_by(arguments[0]), expected_by(arguments[1]))
    if isinstance(origin, type) and issubclass(origin, tuple) and arguments[1:] != (...,):
        return _items(tuple(expected_by(a) for a in arguments), fixed=True)
    if isinstance(origin, type) and issubclass(origin, Sequence) and arguments:
        return _items((expected_by(arguments[0]),), fixed=False)
    if annotation in _OFTEN:
        return _number(annotation is int)
    one = type(None) if annotation is None else origin or annotation
    unknown = not isinstance(one, type) or one in (object, typing.Any) or getattr(one, "_is_protocol", False)
    return ANYTHING if unknown else _instance(one)


_WORDS = {
    str: "a text",
    bool: "True or False",
    type(None): "None",
    dict: "a dict",
    ca.SX: "an expression",
    np.ndarray: "an array",
}
