"""The base of all values that a user makes: their arguments are checked when the value is made, and never again.

A class that derives from `Checked`, or from a contract that does, gets the checks by the annotations of its fields.
A dataclass needs no line of its own, and a class of another distribution is checked as ours are.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from abc import ABCMeta
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache, wraps
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, ParamSpec, TypeVar, cast, get_origin

import casadi as ca

from fpirhc.errors import InvalidField, InvalidName, NotSupported, nearest
from fpirhc.fields.kinds import (
    Anything,
    Choice,
    Expected,
    Number,
    accepts,
    call_of,
    described,
    expected_by,
    shortened,
    signature_of,
)
from fpirhc.fields.user_code import users_place

_WITH_UNIT = re.compile(r"[-+]?[\d.]+(e[-+]?\d+)? ?[a-zA-Z%/^*]+\d?")  # '1 ms'


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

    @property
    def __signature__(cls) -> inspect.Signature:
        """The arguments that a value is made with, for notebooks and editors."""
        makes: Callable[..., object] = getattr(cls, "__init__")  # noqa: B009 -- the class's own, as in `_arguments_of`
        _, *arguments = inspect.signature(makes).parameters.values()
        return inspect.Signature(arguments)

    if not TYPE_CHECKING:

        def __getattr__(cls, name: str) -> object:
            raise missing(cls, name)


class Checked(metaclass=_CheckedWhenCalled):
    """A value whose arguments are checked when it is made; dictionaries in its fields are found by name.

    Raises:
        InvalidField: all wrong arguments together: unknown or missing names, wrong types, numbers out of the range of their kind;
            of a class of a user's own, what its contract asks for and it lacks.
    """

    def _lacks(self) -> Iterator[str]:
        """Yield what the contract of the class asks for and this value does not have, beside abstract methods."""
        yield from ()


def missing(owner: type, name: str) -> AttributeError:
    """The error of an attribute that is not there, with its owner."""
    return AttributeError(f"{owner.__name__} has no attribute '{name}'", name=name)


def expects_whole_number(owner: type, name: str) -> bool:
    """Whether a field of a class is declared as a whole number, with or without a range."""
    one = _arguments_of(owner).expected.get(name)
    options = one.options if isinstance(one, Choice) else (one,)
    return any(isinstance(option, Number) and option.whole for option in options)


def unnamed_inner(value: object, contract: type) -> Iterator[str]:
    """Yield a mistake for a wrapper that does not say what it wraps: a value of its own contract in a field, and no `inner`."""
    for name, content in getattr(value, "__dict__", {}).items():
        if isinstance(content, contract) and getattr(value, "inner", None) is None:
            yield (
                f"{type(value).__name__} holds a {contract.__name__} in '{name}' and has no `inner`, by which its contract "
                f"{contract.__name__} finds it; add a property `inner` that returns self.{name}"
            )


def _abstract(cls: type) -> tuple[str, ...]:
    """Why an abstract class has no values: it is a contract, or lacks methods of one."""
    missing = sorted(getattr(cls, "__abstractmethods__", ()))
    if any(name in vars(cls) for name in missing):
        return (f"{cls.__name__} is a contract; use one of its members",)
    owners = {name: next(base for base in cls.__mro__ if name in vars(base)).__name__ for name in missing}
    return tuple(f"{cls.__name__} has no {name}(...), which its contract {owners[name]} asks for" for name in missing)


@cache
def _arguments_of(owner: type) -> _Arguments:
    makes: Callable[..., object] = getattr(owner, "__init__")  # noqa: B009 -- the class's own, whatever its call does
    parameters = tuple(inspect.signature(makes).parameters.values())[1:]
    return _read_arguments(owner, "field", parameters, lambda one: _expected(owner, one))


def _expected(owner: type, parameter: inspect.Parameter) -> Expected:
    """What the annotation of a field expects, or else that of the argument; each is read in the module that wrote it."""
    for base in owner.__mro__:
        annotations = inspect.get_annotations(base)
        if parameter.name in annotations:
            return _read(annotations[parameter.name], base)
    return _read(parameter.annotation, owner)


def _read(annotation: object, owner: type) -> Expected:
    return _read_annotation(annotation, vars(sys.modules.get(owner.__module__, sys)), vars(owner))


P = ParamSpec("P")
R = TypeVar("R")
Value = TypeVar("Value")


def checked_call(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function with a check of its arguments: a decorator for the verbs of the library.

    An annotation whose name the module imports for type checkers only checks nothing.
    """

    @wraps(function)
    def checked(*arguments: P.args, **named: P.kwargs) -> R:
        mistakes = tuple(checks_of(function).mistakes(arguments, named))
        if mistakes:
            raise InvalidField(mistakes, users_place())
        return function(*arguments, **named)

    return checked


@cache
def checks_of(function: Callable[..., object]) -> _Arguments:
    """Return what is checked of a function's arguments; they are read at its first call, when every module is loaded."""
    names = getattr(inspect.unwrap(function), "__globals__", {})
    parameters = tuple(inspect.signature(function).parameters.values())
    return _read_arguments(function, "argument", parameters, lambda one: _read_annotation(one.annotation, names, {}))


@dataclass(frozen=True)
class _Arguments:
    owner: type | Callable[..., object]  # what is called
    noun: str  # what an argument of it is called, "field" or "argument"
    positional: tuple[str, ...]  # names of those that may be given by their place
    required: tuple[str, ...]  # names of those without a default
    expected: Mapping[str, Expected]  # what is expected of each, by name
    open: bool  # whether more arguments are taken than are named

    def mistakes(self, arguments: Sequence[object], named: Mapping[str, object]) -> Iterator[str]:
        """Yield every mistake of a call."""
        values = dict(zip(self.positional, arguments, strict=False))
        yield from self._wrong_names(arguments, values, named)
        every = {**values, **named}
        wrong = [n for n, value in every.items() if n in self.expected and not accepts(self.expected[n], value)]
        if not wrong:
            return
        if self._swapped(wrong, every):
            name, (one, other) = self.owner.__name__, wrong
            yield f"{name}: the values of '{one}' and '{other}' are swapped; write {name}({one}=..., {other}=...)"
            return
        for name in wrong:
            yield from mistakes_in(self.expected[name], f"{self.owner.__name__}.{name}", every[name])

    def _swapped(self, wrong: Sequence[str], values: Mapping[str, object]) -> bool:
        """Whether two values are wrong, and each is what is expected of the other."""
        if len(wrong) != 2:
            return False
        one, other = wrong
        return accepts(self.expected[one], values[other]) and accepts(self.expected[other], values[one])

    def _wrong_names(
        self, arguments: Sequence[object], values: Mapping[str, object], named: Mapping[str, object]
    ) -> Iterator[str]:
        name = self.owner.__name__
        for key in named:
            if key in values:
                yield f"{name}: '{key}' is given twice, by its place and by its name"
            elif key not in self.expected and not self.open:
                yield f"{name} has no {self.noun} '{key}'.{nearest(key, self.expected)}"
        if len(arguments) > len(self.positional) and not self.open:
            extra = described(arguments[len(self.positional)])
            yield f"{name} takes {len(self.positional)} values without a name, got {len(arguments)}; {extra} is too many"
        missing = [key for key in self.required if key not in values and key not in named]
        if missing:
            yield f"{name} needs {', '.join(missing)}; write {call_of(self.owner)}"


def _read_arguments(
    owner: type | Callable[..., object],
    noun: str,
    parameters: Sequence[inspect.Parameter],
    expected: Callable[[inspect.Parameter], Expected],
) -> _Arguments:
    """Return the arguments of a call with these parameters; `expected` reads the annotation of one."""
    ours = [p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return _Arguments(
        owner,
        noun,
        tuple(p.name for p in ours if p.kind is not p.KEYWORD_ONLY),
        tuple(p.name for p in ours if p.default is p.empty),
        {p.name: expected(p) for p in ours},
        open=len(ours) < len(parameters),
    )


def _read_annotation(annotation: object, names: Mapping[str, object], own: Mapping[str, object]) -> Expected:
    """Return what an annotation expects, read with the names of its module and of its class."""
    if isinstance(annotation, str):
        try:
            annotation = eval(annotation, dict(names), dict(own))
        except Exception:  # noqa: BLE001 -- a name for type checkers only: such an argument is not checked
            return Anything()
    if annotation is inspect.Parameter.empty or get_origin(annotation) is ClassVar:
        return Anything()
    return expected_by(annotation)


def mistakes_in(expected: Expected, where: str, value: object) -> Iterator[str]:
    """Yield what is wrong with a value and its parts; `where` names it."""
    if not expected.fits(value):
        comma = isinstance(value, tuple) and len(value) == 1 and accepts(expected, value[0])
        mend = "a comma behind the value makes a tuple of it; remove the comma" if comma else ""
        mend = mend or expected.completed(value) or _mended(expected, value)
        yield f"{where}: expected {expected.words}, got {described(value)}{'; ' + mend if mend else ''}"
        return
    for place, inner, part in expected.parts(value):
        yield from mistakes_in(inner, f"{where}{place}", part)


def _mended(expected: Expected, value: object) -> str:
    """Return what to write instead; empty where nothing is near."""
    contract = expected.contract()
    if isinstance(value, type):
        return f"write {call_of(value)}" if contract is not None and issubclass(value, contract) else ""
    if isinstance(value, str):
        return _mended_text(expected, value, contract)
    if isinstance(value, ca.SX | ca.MX):
        return "a setting is a number" if expected.fits(1) or expected.fits(0.5) else ""
    if isinstance(value, int | float) and expected.fits((-abs(value), abs(value))) and not expected.fits([value]):
        return f"write both ends, such as {(-abs(value), abs(value))}"
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15 and expected.fits(int(value)):
        return f"write {int(value)}"
    return _made_of(expected, value, contract)


def _made_of(expected: Expected, value: object, contract: type | None) -> str:
    """How what is expected is made of a value that holds it, or that it should hold."""
    if contract is None and isinstance(value, Mapping) and value and all(accepts(expected, v) for v in value.values()):
        return f"it is one for all, without a name: write {shortened(next(iter(value.values())))}"
    if isinstance(value, int | float | Mapping) and expected.fits(lambda t: t):
        return f"write lambda t: {shortened(value)}"
    if contract is None:
        return ""
    if inspect.isroutine(value) and signature_of(value) == "()":
        return "call it and give its result"
    members = [text for one in expected.contracts() if (text := _member(one))]
    return _part_that_fits(expected, value) or " or ".join(
        [*members[:1], *(m.removeprefix("write ") for m in members[1:])]
    )


def _mended_text(expected: Expected, text: str, contract: type | None) -> str:
    for number in (int, float):
        try:
            if expected.fits(number(text)):
                return f"write {text} without quotes"
        except ValueError:
            continue
    if contract is None:
        alone = _WITH_UNIT.fullmatch(text) and expected.fits(0.1)
        return "write the number alone, in the unit that is expected" if alone else ""
    if issubclass(contract, Path):
        return f"write pathlib.Path({text!r})"
    loaded = getattr(contract, "_LOADED", "").format(repr(text))
    members = {_plain(name): member for name, member in _public(contract) if member is not contract or not loaded}
    close = get_close_matches(_plain(text), members, n=1, cutoff=0.5)
    if close:
        return f"write fp.{call_of(members[close[0]])}"
    return f"write {loaded}" if loaded else _member(contract)


def _member(contract: type) -> str:
    """How a value of a public class is written, or which members a contract has; empty for classes of Python."""
    if inspect.isabstract(contract):
        return f"one of {', '.join(sorted(name for name, _ in _public(contract)))}"
    home, own = (name.partition(".")[0] for name in (contract.__module__, __name__))
    if home != own or contract.__name__ not in import_module(own).__all__:
        return ""
    _, *first = inspect.signature(getattr(contract, "__init__")).parameters  # noqa: B009
    return f"write fp.{call_of(contract)}".replace("()", f"({first[0]}=...)" if first else "()")


def _part_that_fits(expected: Expected, value: object) -> str:
    """Which part of the value is what is expected, such as the problem of a loaded file."""
    if isinstance(value, Mapping):
        return next((f"give one of its entries, such as [{k!r}]" for k, v in value.items() if expected.fits(v)), "")
    names = [f.name for f in fields(value)] if is_dataclass(value) and not isinstance(value, type) else []
    parts = {name: getattr(value, name) for name in names}
    return next((f"give its .{name}" for name, part in parts.items() if part is not None and expected.fits(part)), "")


def _public(contract: type) -> Iterator[tuple[str, type]]:
    """Public members of a contract, those of its part of the package; only a mistake pays for importing them."""
    top, *part = contract.__module__.split(".")[:2]
    package = import_module(top)
    for name in _declared_in(package, ".".join(part)):
        member = getattr(package, name, None)
        if isinstance(member, type) and issubclass(member, contract) and not inspect.isabstract(member):
            yield name, member


def _declared_in(package: ModuleType, part: str) -> list[str]:
    """Public names that the stub of a package imports from one part of it; all public names without a stub."""
    file = getattr(package, "__file__", None)  # Python's own classes are in no file
    stub = Path(file).with_suffix(".pyi") if file else None
    if stub is None or not stub.is_file():
        return list(getattr(package, "__all__", ()))
    lines = (one for one in ast.parse(stub.read_text(encoding="utf-8")).body if isinstance(one, ast.ImportFrom))
    of_part = (one for one in lines if (one.module or "").partition(".")[0] == part)
    return [alias.asname or alias.name for one in of_part for alias in one.names]


def _plain(name: str) -> str:
    return "".join(c for c in name.lower() if c.isalnum())


def replaced(value: Value, field: str, content: object) -> Value | None:
    """Return the same frozen value with another content of a field; None where it is no dataclass or has no such field."""
    if not is_dataclass(value) or field not in [f.name for f in fields(value)]:
        return None
    changed: Value = replace(value, **{field: content})  # type: ignore[type-var]  # mypy does not narrow type variables
    return changed


class ByName(dict[str, Value]):
    """A dictionary with names as keys; dictionaries in it are such ones too.

    Raises:
        InvalidName: a name that is not there.
    """

    def __init__(self, entries: Mapping[str, Value] | Iterable[tuple[str, Value]], where: str = "the mapping") -> None:
        """Copy the entries; `where` is the subject of the error: "Task.controllers"."""
        super().__init__(entries)
        self._where = where
        for name, value in self.items():
            if type(value) is dict:  # not a subclass, which may have an order or a default of its own
                super().__setitem__(name, cast(Value, type(self)(cast(Any, value), f"{where}[{name!r}]")))

    def __getitem__(self, name: str) -> Value:
        try:
            return super().__getitem__(name)
        except TypeError:  # a list or a slice
            self.__missing__(name)

    def __missing__(self, name: object) -> NoReturn:
        raise InvalidName(f"{self._where} has no '{name}'.{nearest(name, self)}")

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (dict(self), self._where)


class Fixed(ByName[Value]):
    """A dictionary in a field of a frozen value.

    What follows from the value is computed once, so a change in place would be shown and have no effect.

    Raises:
        NotSupported: a change in place.
    """

    def _stays(self, *_: object, **__: object) -> NoReturn:
        """Raise NotSupported: nothing changes in place."""
        raise NotSupported(
            f"{self._where} cannot be changed in place, where it would have no effect; make another value with "
            f"dataclasses.replace(...) and a copy, {{**{self._where.rpartition('.')[2]}, name: value}}"
        )

    __setitem__ = __delitem__ = __ior__ = update = setdefault = pop = popitem = clear = _stays


class FoundByName:
    """Base of dataclasses whose dictionaries are found by name."""

    def __post_init__(self) -> None:
        """Let every dictionary in a public field be found by name."""
        find_by_name(self)


def find_by_name(value: object) -> None:
    """Let every dictionary in a public attribute of a value be found by name; those of a frozen value stay as they are."""
    kind = Fixed if is_dataclass(value) and getattr(value, "__dataclass_params__").frozen else ByName  # noqa: B009
    for name, content in list(getattr(value, "__dict__", {}).items()):
        if type(content) is dict and not name.startswith("_") and all(isinstance(key, str) for key in content):
            object.__setattr__(value, name, kind(content, f"{type(value).__name__}.{name}"))
