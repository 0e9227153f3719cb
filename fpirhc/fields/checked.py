"""The base of all values that a user makes: their arguments are checked when the value is made, and never again.

A class that derives from `Checked`, or from a contract that does, gets the checks by the annotations of its fields.
A dataclass needs no line of its own, and a class of another distribution is checked as ours are.
"""

from __future__ import annotations

import inspect
import sys
from abc import ABCMeta
from collections.abc import Callable
from functools import cache

from fpirhc.errors import InvalidField
from fpirhc.fields.arguments import Arguments, arguments_of, read_annotation
from fpirhc.fields.expected import Expected, Number
from fpirhc.fields.place import users_place


class _CheckedWhenCalled(ABCMeta):
    """Classes whose calls check the arguments before anything is made of them."""

    def __call__(cls, *arguments: object, **named: object) -> object:
        if inspect.isabstract(cls):
            mistakes: tuple[str, ...] = (f"{cls.__name__} is a contract; use one of its members",)
        else:
            mistakes = tuple(_arguments_of(cls).mistakes(arguments, named))
        if mistakes:
            raise InvalidField(mistakes, users_place())
        return type.__call__(cls, *arguments, **named)


class Checked(metaclass=_CheckedWhenCalled):
    """A value whose arguments are checked when it is made.

    Raises:
        InvalidField: all wrong arguments together: unknown or missing names, wrong types, numbers out of the range of their kind.
    """


def field_names(owner: type) -> tuple[str, ...]:
    """Names of the arguments of a class."""
    return tuple(_arguments_of(owner).expected)


def expects_whole_number(owner: type, name: str) -> bool:
    """Whether a field of a class is declared as a whole number, with or without a range."""
    one = _arguments_of(owner).expected.get(name)
    return isinstance(one, Number) and one.whole


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
