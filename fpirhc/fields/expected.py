"""What an annotation expects of a value: whether a value fits, and the words for a user when it does not."""

from __future__ import annotations

import collections.abc
import inspect
import math
import numbers
import types
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.fields.kinds import Range, real_number, shortened
from fpirhc.symbolic.live import SymbolicNumber


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

    def completed(self, part: object) -> str:
        """Return how a value that is only a part of what is expected is written; empty where it is none."""
        del part
        return ""


def accepts(expected: Expected, value: object) -> bool:
    """Whether the value and all its parts are as expected."""
    return expected.fits(value) and all(accepts(inner, part) for _, inner, part in expected.parts(value))


@dataclass(frozen=True)
class Anything(Expected):
    """No expectation: an annotation that is not understood checks nothing."""

    @property
    def words(self) -> str:
        return "anything"

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
            if isinstance(value, SymbolicNumber):
                return True
            if isinstance(value, np.ndarray):
                return False
        if self.whole and not isinstance(value, numbers.Integral):
            return False
        number = real_number(value)
        if number is None:  # a whole number beyond the largest float is a whole number
            return self.whole and type(value) is int and (self.within is None or self.within.holds(value))
        return not math.isnan(number) if self.within is None else self.within.holds(number)


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
        return "give it a name: {'name': ...}" if accepts(self.value, part) else ""


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
        return "" if self.fixed or not accepts(self.items[0], part) else f"write ({shortened(part)},)"


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
        named = (option.contract() for option in self.options if option.contract() not in _WORDS)
        return next((one for one in named if one is not None), None)

    def completed(self, part: object) -> str:
        return next((text for option in self.options if (text := option.completed(part))), "")


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
    within = next((a for a in arguments[1:] if isinstance(a, Range)), None)
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
