"""The base of all values that a user makes: their arguments are checked when the value is made, and never again.

A class that derives from `Checked`, or from a contract that does, gets the checks by the annotations of its fields.
A dataclass needs no line of its own, and a class of another distribution is checked as ours are.
"""

from __future__ import annotations

import inspect
import sys
from abc import ABCMeta
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import ClassVar, get_origin

from fpirhc.errors import InvalidField, nearest
from fpirhc.fields.expected import Anything, Expected, Number, accepts, expected_by, mistakes_in
from fpirhc.fields.given import call_of, described
from fpirhc.fields.place import users_place


class _CheckedWhenCalled(ABCMeta):
    """Classes whose calls check the arguments before anything is made of them."""

    def __call__(cls, *arguments: object, **named: object) -> object:
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


@dataclass(frozen=True)
class _Arguments:
    """The arguments of a class's call."""

    owner: type
    positional: tuple[str, ...]
    required: tuple[str, ...]
    expected: Mapping[str, Expected]
    open: bool  # whether more arguments are taken than are named

    def mistakes(self, arguments: tuple[object, ...], named: Mapping[str, object]) -> Iterator[str]:
        """Yield every mistake of a call."""
        if inspect.isabstract(self.owner):
            yield f"{self.owner.__name__} is a contract; use one of its members"
            return
        values = dict(zip(self.positional, arguments, strict=False))
        yield from self._wrong_names(arguments, values, named)
        for name, value in (*values.items(), *named.items()):
            one = self.expected.get(name)
            if one is not None and not accepts(one, value):
                yield from mistakes_in(one, f"{self.owner.__name__}.{name}", value)

    def _wrong_names(
        self, arguments: tuple[object, ...], values: Mapping[str, object], named: Mapping[str, object]
    ) -> Iterator[str]:
        name = self.owner.__name__
        for key in named:
            if key in values:
                yield f"{name}: '{key}' is given twice, by its place and by its name"
            elif key not in self.expected and not self.open:
                yield f"{name} has no field '{key}'.{nearest(key, self.expected)}"
        if len(arguments) > len(self.positional) and not self.open:
            extra = described(arguments[len(self.positional)])
            yield f"{name} takes {len(self.positional)} values without a name, got {len(arguments)}; {extra} is too many"
        missing = [key for key in self.required if key not in values and key not in named]
        if missing:
            yield f"{name} needs {', '.join(missing)}; write {call_of(self.owner)}"


@cache
def _arguments_of(owner: type) -> _Arguments:
    makes: Callable[..., object] = getattr(owner, "__init__")  # noqa: B009 -- the class's own, whatever its call does
    parameters = tuple(inspect.signature(makes).parameters.values())[1:]
    ours = [p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return _Arguments(
        owner,
        tuple(p.name for p in ours if p.kind is not p.KEYWORD_ONLY),
        tuple(p.name for p in ours if p.default is p.empty),
        {p.name: _expected(owner, p) for p in ours},
        open=len(ours) < len(parameters),
    )


def _expected(owner: type, parameter: inspect.Parameter) -> Expected:
    """What the annotation of a field expects, or else that of the argument; each is read in the module that wrote it."""
    for base in owner.__mro__:
        annotations = inspect.get_annotations(base)
        if parameter.name in annotations:
            return _read(annotations[parameter.name], base)
    return _read(parameter.annotation, owner)


def _read(annotation: object, owner: type) -> Expected:
    if isinstance(annotation, str):
        names = vars(sys.modules[owner.__module__]) if owner.__module__ in sys.modules else {}
        try:
            annotation = eval(annotation, dict(names), dict(vars(owner)))
        except Exception:  # noqa: BLE001 -- a name for type checkers only: such a field is not checked
            return Anything()
    if annotation is inspect.Parameter.empty or get_origin(annotation) is ClassVar:
        return Anything()
    return expected_by(annotation)
