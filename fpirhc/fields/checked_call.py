"""Functions that a user calls: their arguments are checked by their annotations before anything runs."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from fpirhc.errors import InvalidField
from fpirhc.fields.arguments import Arguments, arguments_of, read_annotation
from fpirhc.fields.place import users_place

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
