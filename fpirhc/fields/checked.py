"""The base of all values that a user makes: their arguments are checked when the value is made, and never again.

A class that derives from `Checked`, or from a contract that does, gets the checks by the annotations of its fields.
A dataclass needs no line of its own, and a class of another distribution is checked as ours are.
"""

from __future__ import annotations

import inspect
import sys
from abc import ABCMeta
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from fpirhc.by_name import find_by_name
from fpirhc.errors import InvalidField
from fpirhc.fields.arguments import Arguments, arguments_of, read_annotation
from fpirhc.fields.expected import Expected, Number
from fpirhc.fields.user_code import users_place


class _CheckedWhenCalled(ABCMeta):
    """Classes whose calls check the arguments before anything is made of them."""

    def __call__(cls, *arguments: object, **named: object) -> object:
        mistakes = _abstract(cls) if inspect.isabstract(cls) else tuple(_arguments_of(cls).mistakes(arguments, named))
        if not mistakes:
            value = type.__call__(cls, *arguments, **named)
            mistakes = tuple(value._lacks())
        if mistakes:
            raise InvalidField(mistakes, users_place())
        find_by_name(value)
        return value


class Checked(metaclass=_CheckedWhenCalled):
    """A value whose arguments are checked when it is made; dictionaries in its fields are found by name.

    Raises:
        InvalidField: all wrong arguments together: unknown or missing names, wrong types, numbers out of the range of their kind;
            of a class of a user's own, what its contract asks for and it lacks.
    """

    def _lacks(self) -> Iterator[str]:
        """Yield what the contract of the class asks for and this value does not have, beside abstract methods."""
        yield from ()


def mistakes_of(owner: type, named: Mapping[str, object]) -> Iterator[str]:
    """Yield the mistakes of some arguments of a class, whose others are not known."""
    arguments = _arguments_of(owner)
    yield from replace(arguments, required=()).mistakes((), named)


def field_names(owner: type) -> tuple[str, ...]:
    """Names of the arguments of a class."""
    return tuple(_arguments_of(owner).expected)


def expects_whole_number(owner: type, name: str) -> bool:
    """Whether a field of a class is declared as a whole number, with or without a range."""
    one = _arguments_of(owner).expected.get(name)
    return isinstance(one, Number) and one.whole


def unnamed_inner(value: object, contract: type) -> Iterator[str]:
    """Yield a mistake for a wrapper that does not say what it wraps: a value of its own contract in a field, and no `inner`."""
    for name, content in getattr(value, "__dict__", {}).items():
        if isinstance(content, contract) and getattr(value, "inner", None) is None:
            yield (
                f"{type(value).__name__} holds a {contract.__name__} in '{name}' and has no `inner`, by which its contract "
                f"{contract.__name__} finds it; add a property `inner` that returns self.{name}"
            )


def former_members(value: object, former: Mapping[str, str]) -> Iterator[str]:
    """Yield a mistake for every member of an earlier contract that the class of a value still writes: nobody would ask it."""
    for base in type(value).__mro__:
        for name, instead in former.items():
            if name in vars(base) and name not in getattr(base, "__dataclass_fields__", {}):
                yield f"{base.__name__} writes `{name}`, which its contract does not ask for any more; {instead}"


def _abstract(cls: type) -> tuple[str, ...]:
    """Why an abstract class has no values: it is a contract, or lacks methods of one."""
    missing = sorted(getattr(cls, "__abstractmethods__", ()))
    if any(name in vars(cls) for name in missing):
        return (f"{cls.__name__} is a contract; use one of its members",)
    owners = {name: next(base for base in cls.__mro__ if name in vars(base)).__name__ for name in missing}
    return tuple(f"{cls.__name__} has no {name}(...), which its contract {owners[name]} asks for" for name in missing)


@cache
def _arguments_of(owner: type) -> Arguments:
    makes: Callable[..., object] = getattr(owner, "__init__")  # noqa: B009 -- the class's own, whatever its call does
    parameters = tuple(inspect.signature(makes).parameters.values())[1:]
    return arguments_of(owner, "field", parameters, lambda one: _expected(owner, one))


def _expected(owner: type, parameter: inspect.Parameter) -> Expected:
    """What the annotation of a field expects, or else that of the argument; each is read in the module that wrote it."""
    for base in owner.__mro__:
        annotations = inspect.get_annotations(base)
        if parameter.name in annotations:
            return _read(annotations[parameter.name], base)
    return _read(parameter.annotation, owner)


def _read(annotation: object, owner: type) -> Expected:
    return read_annotation(annotation, vars(sys.modules.get(owner.__module__, sys)), vars(owner))


P = ParamSpec("P")
R = TypeVar("R")


def checked_call(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function with a check of its arguments: a decorator for the verbs of the library.

    An annotation whose name the module imports for type checkers only checks nothing.

    Raises:
        InvalidField: all wrong arguments together, when the function is called.
    """

    @wraps(function)
    def checked(*arguments: P.args, **named: P.kwargs) -> R:
        mistakes = tuple(checks_of(function).mistakes(arguments, named))
        if mistakes:
            raise InvalidField(mistakes, users_place())
        return function(*arguments, **named)

    return checked


@cache
def checks_of(function: Callable[..., object]) -> Arguments:
    """Return what is checked of a function's arguments; they are read at its first call, when every module is loaded."""
    names = getattr(inspect.unwrap(function), "__globals__", {})
    parameters = tuple(inspect.signature(function).parameters.values())
    return arguments_of(function, "argument", parameters, lambda one: read_annotation(one.annotation, names, {}))
