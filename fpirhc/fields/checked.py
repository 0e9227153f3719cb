"""The base of all values that a user makes: their arguments are checked when the value is made, and never again.

A class that derives from `Checked`, or from a contract that does, gets the checks by the annotations of its fields, wherever it is.
"""

from __future__ import annotations

import inspect
import re
import sys
from abc import ABCMeta
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache, cached_property, partial, wraps
from importlib import import_module
from typing import Any, ClassVar, NoReturn, ParamSpec, TypeVar, cast, get_origin

import casadi as ca

from fpirhc.errors import InvalidField, InvalidName, NotSupported, nearest
from fpirhc.fields.kinds import ANYTHING, SHORT, Expected, accepts, call_of, described, expected_by
from fpirhc.fields.user_code import users_place
from fpirhc.symbolic.open import closed, made

P = ParamSpec("P")
R = TypeVar("R")
Value = TypeVar("Value")


class _CheckedWhenCalled(ABCMeta):
    """Classes whose calls check the arguments before anything is made of them."""

    def __call__(cls, *arguments: object, **named: object) -> object:
        return found_by_name(made(partial(_checked, cls), _arguments_of(cls).positional, *arguments, **named))

    @property
    def __signature__(cls) -> inspect.Signature:
        """The arguments that a value is made with, for notebooks and editors."""
        return inspect.Signature(_parameters(cls))


class Checked(metaclass=_CheckedWhenCalled):
    """A value whose arguments are checked when it is made; dictionaries in its fields are found by name.

    Raises:
        InvalidField: all wrong arguments together: unknown or missing names, wrong types, numbers out of the range of their kind;
            of a class of a user's own, what its contract asks for and it lacks.
    """

    def _lacks(self) -> Iterator[str]:
        """Yield what the contract of the class asks for and this value does not have, beside abstract methods."""
        yield from ()


def expects_whole_number(owner: type, name: str) -> bool:
    """Whether a field of a class is declared as a whole number, with or without a range."""
    return _arguments_of(owner).expected.get(name, ANYTHING).whole


class fact(cached_property[Value]):
    """A property that is found once, and from the numbers with which the value was checked."""

    def __get__(self, value: Any, owner: type | None = None) -> Any:
        return super().__get__(closed(value), owner)


class Inner:
    """The first value of the same contract that a member holds in a field: what it is around; None for one that stands alone."""

    def __set_name__(self, contract: type, name: str) -> None:
        self._contract, self._name = contract, name

    def __get__(self, value: object, owner: type) -> object:
        if value is None:  # so that a dataclass may have a field of this name, without a default
            raise AttributeError(f"{owner.__name__} is a class; its values have an `inner`")
        held = (vars(value).get(name) for name in getattr(value, "__dataclass_fields__", ()))
        found = next((one for one in held if isinstance(one, self._contract)), None)
        vars(value)[self._name] = found  # values are frozen, so it is looked for once
        return found


def _checked(cls: Any, /, *arguments: object, **named: object) -> object:
    """Return a value of a class, or raise all mistakes in its arguments together."""
    mistakes = _abstract(cls) if inspect.isabstract(cls) else tuple(_arguments_of(cls).mistakes(arguments, named))
    if not mistakes:
        value = type.__call__(cls, *arguments, **named)
        mistakes = tuple(value._lacks())
    if mistakes:
        raise InvalidField(mistakes, users_place())
    return value


def _abstract(cls: type) -> tuple[str, ...]:
    """Why an abstract class has no values: it is a contract, or lacks methods of one."""
    missing = sorted(getattr(cls, "__abstractmethods__", ()))
    if any(name in vars(cls) for name in missing):
        return (f"{cls.__name__} is a contract; use one of its members",)
    owners = {name: next(base for base in cls.__mro__ if name in vars(base)).__name__ for name in missing}
    return tuple(f"{cls.__name__} has no {name}(...), which its contract {owners[name]} asks for" for name in missing)


def checked_call(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function with a check of its arguments: a decorator for the verbs of the library."""

    @wraps(function)
    def checked(*arguments: P.args, **named: P.kwargs) -> R:
        mistakes = tuple(_arguments_of(function).mistakes(arguments, named))
        if mistakes:
            raise InvalidField(mistakes, users_place())
        return function(*arguments, **named)

    return checked


@dataclass(frozen=True)
class _Arguments:
    owner: type | Callable[..., object]  # what is called
    positional: tuple[str, ...]  # names of those that may be given by their place
    required: tuple[str, ...]  # names of those without a default
    expected: Mapping[str, Expected]  # what is expected of each, by name
    open: bool  # whether more arguments are taken than are named

    def mistakes(self, arguments: Sequence[object], named: Mapping[str, object]) -> Iterator[str]:
        """Yield every mistake of a call."""
        every = {**dict(zip(self.positional, arguments, strict=False)), **named}
        yield from self._wrong_names(arguments, named)
        wrong = [n for n, value in every.items() if n in self.expected and not accepts(self.expected[n], value)]
        if not wrong:
            return
        name, (one, *others) = self.owner.__name__, wrong
        if len(others) == 1 and all(accepts(self.expected[a], every[b]) for a, b in (wrong, wrong[::-1])):
            yield f"{name}: the values of '{one}' and '{others[0]}' are swapped; write {name}({one}=..., {others[0]}=...)"
            return
        for field in wrong:
            yield from mistakes_in(self.expected[field], f"{name}.{field}", every[field])

    def _wrong_names(self, arguments: Sequence[object], named: Mapping[str, object]) -> Iterator[str]:
        name, by_place = self.owner.__name__, self.positional[: len(arguments)]
        for key in named:
            if key in by_place:
                yield f"{name}: '{key}' is given twice, by its place and by its name"
            elif key not in self.expected and not self.open:
                noun = "field" if isinstance(self.owner, type) else "argument"
                yield f"{name} has no {noun} '{key}'.{nearest(key, self.expected)}"
        if len(arguments) > len(self.positional) and not self.open:
            extra = described(arguments[len(self.positional)])
            yield f"{name} takes {len(self.positional)} values without a name, got {len(arguments)}; {extra} is too many"
        if missing := [key for key in self.required if key not in by_place and key not in named]:
            told = re.findall(rf"^ *((?:{'|'.join(missing)}): (?:[^.\n]|\.\S)*)", self.owner.__doc__ or "", re.M)
            yield "; ".join([f"{name} needs {', '.join(missing)}; write {call_of(self.owner)}", *told])


def _parameters(owner: type | Callable[..., object]) -> list[inspect.Parameter]:
    makes: Any = getattr(owner, "__init__") if isinstance(owner, type) else owner  # noqa: B009 -- not that of the metaclass
    return list(inspect.signature(makes).parameters.values())[isinstance(owner, type) :]


@cache
def _arguments_of(owner: type | Callable[..., object]) -> _Arguments:
    """What is checked of the arguments of a class or a function; they are read at its first call, when every module is loaded."""
    parameters = _parameters(owner)
    ours = [p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return _Arguments(
        owner,
        tuple(p.name for p in ours if p.kind is not p.KEYWORD_ONLY),
        tuple(p.name for p in ours if p.default is p.empty),
        {p.name: _expected(owner, p) for p in ours if p.name != "self"},
        open=len(ours) < len(parameters),
    )


def _expected(owner: Any, parameter: inspect.Parameter) -> Expected:
    """What the annotation of a field expects, or else that of the argument; each is read in the module that wrote it."""
    annotation, names, own = parameter.annotation, getattr(inspect.unwrap(owner), "__globals__", {}), {}
    if isinstance(owner, type):
        base = next((b for b in owner.__mro__ if parameter.name in inspect.get_annotations(b)), owner)
        annotation = inspect.get_annotations(base).get(parameter.name, annotation)
        names, own = vars(sys.modules.get(base.__module__, sys)), dict(vars(base))
    if isinstance(annotation, str):
        try:
            annotation = eval(annotation, dict(names), own)
        except Exception:  # noqa: BLE001 -- a name for type checkers only: such an argument is not checked
            return ANYTHING
    unknown = annotation is inspect.Parameter.empty or get_origin(annotation) is ClassVar
    return ANYTHING if unknown else expected_by(annotation)


def mistakes_in(expected: Expected, where: str, value: object) -> Iterator[str]:
    """Yield what is wrong with a value and its parts; `where` names it."""
    if not expected.fits(value):
        mend = _mended(expected, value)
        yield f"{where}: expected {expected.words}, got {described(value)}{'; ' + mend if mend else ''}"
        return
    for place, inner, part in expected.parts(value):
        yield from mistakes_in(inner, f"{where}{place}", part)


def _mended(expected: Expected, value: object) -> str:
    """Return what to write instead: a text that is near, the value inside of what is expected, a part of it, or a member."""
    if isinstance(value, str) and (near := get_close_matches(value, expected.texts, n=1)):
        return f"write '{near[0]}'"
    one = SHORT.repr(value) if isinstance(value, int | float | tuple | str) else f"{type(value).__name__}(...)"
    inside = [f"write {{'NAME': {one}}} with the name of what it belongs to"] * accepts(expected, {"NAME": value})
    entries = list(value.values()) if isinstance(value, Mapping) else []
    inside += [f"write one value for all, {SHORT.repr(entry)}" for entry in entries[:1] if accepts(expected, entry)]
    if inside := [*inside, *[f"write {SHORT.repr((value,))}"] * accepts(expected, (value,))]:
        return ", or ".join(inside)
    if isinstance(value, type):
        return f"write {call_of(value)}" if issubclass(value, expected.classes) else ""
    if isinstance(value, ca.SX | ca.MX):
        return "a setting is a number" if expected.fits(1) or expected.fits(0.5) else ""
    parts = {f.name: getattr(value, f.name) for f in fields(value)} if is_dataclass(value) else {}
    if near := [name for name, part in parts.items() if part is not None and expected.fits(part)]:
        return f"give its .{near[0]}"
    return " or ".join(filter(None, (_member(own, value, one) for own in expected.classes)))


def _member(one: type, value: object, text: str) -> str:
    """How a value of a public class is written, or which members a contract has; empty for classes of others."""
    package = import_module(__name__.partition(".")[0])
    if one.__module__.partition(".")[0] != package.__name__:
        return ""
    if hasattr(one, "_WRITTEN") and (isinstance(value, str) or "{}" not in one._WRITTEN):
        return f"write {one._WRITTEN.replace('{}', repr(value))}"
    if not inspect.isabstract(one):
        _, *first = inspect.signature(getattr(one, "__init__")).parameters  # noqa: B009
        written = call_of(one).replace("()", f"({first[0]}=...)" if first else "()")
        return f"write fp.{written}" if one.__name__ in package.__all__ else ""
    public = {name: getattr(package, name, None) for name in package.__all__}  # only a mistake pays for importing them
    members = [n for n, m in public.items() if isinstance(m, type) and issubclass(m, one) and not inspect.isabstract(m)]
    ours = {n: _arguments_of(public[n]) for n in sorted(members)}
    alone = [n for n, own in ours.items() if len(own.required) == 1 and accepts(own.expected[own.required[0]], value)]
    return f"write {' or '.join(f'fp.{n}({text})' for n in alone)}" if alone else f"one of {', '.join(ours)}"


def replaced(value: Value, field: str, content: object) -> Value | None:
    """Return the same frozen value with another content of a field; None where it is no dataclass or has no such field."""
    if not is_dataclass(value) or field not in [f.name for f in fields(value)]:
        return None
    return cast(Value, cast(Any, replace)(value, **{field: content}))


class ByName(dict[str, Value]):
    """A dictionary with names as keys; dictionaries in it are such ones too."""

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
    """A dictionary in a field of a frozen value, from which more was computed: a change in place would have no effect."""

    def _stays(self, *_: object, **__: object) -> NoReturn:
        raise NotSupported(
            f"{self._where} cannot be changed in place, where it would have no effect; make another value with "
            f"dataclasses.replace(...) and a copy, {{**{self._where.rpartition('.')[2]}, name: value}}"
        )

    __setitem__ = __delitem__ = __ior__ = update = setdefault = pop = popitem = clear = _stays


class FoundByName:
    """Base of dataclasses whose dictionaries are found by name."""

    def __post_init__(self) -> None:
        found_by_name(self)


def found_by_name(value: Value) -> Value:
    """Return a frozen value, in which every dictionary in a public attribute is now found by name, and stays as it is."""
    frozen = is_dataclass(value) and getattr(value, "__dataclass_params__").frozen  # noqa: B009
    for name, content in list(vars(value).items()) if frozen else ():
        if type(content) is dict and not name.startswith("_") and all(isinstance(key, str) for key in content):
            object.__setattr__(value, name, Fixed(content, f"{type(value).__name__}.{name}"))
    return value
