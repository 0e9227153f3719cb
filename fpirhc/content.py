"""Content of values as one number that is the same in every process: formulas count as well as settings.

`describe` has the names of functions, which two formulas may share, and `identity` has the objects, which another process has not.
Here a function is its code and what that code reads: defaults, enclosed values, and what its module has by the names in it. An
expression is what CasADi writes of it. Code of libraries counts by its name.
"""

from __future__ import annotations

import dis
import functools
import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.fields.user_code import is_users


def digest(*values: Any) -> str:
    """Return 64 hexadecimal digits, which values share only where nothing in them differs.

    What an object that is no dataclass keeps in itself does not count: it changes while the object is used.
    """
    return _Content().of(values).hex()


class _Content:
    """The content of values; each is computed once, whoever holds it."""

    def __init__(self) -> None:
        self._known: dict[int, bytes] = {}
        self._kept: list[object] = []  # the address of one that is gone is given to another

    def of(self, value: Any) -> bytes:
        """Return the content of a value; one that holds itself is a word where it is met again."""
        plain = value.item() if isinstance(value, np.generic) else value
        if type(plain) in _PLAIN or (type(plain) in (list, tuple) and {*map(type, plain)} <= _PLAIN):
            return _hash(type(plain).__name__.encode(), repr(plain).encode())
        key = id(value)
        if key not in self._known:
            self._known[key] = b"itself"
            self._kept.append(value)
            self._known[key] = _hash(*self._parts(value))
        return self._known[key]

    def _parts(self, value: Any) -> Iterator[bytes]:
        """What distinguishes a value from others, its kind first."""
        for kind, told in _KINDS.items():
            if isinstance(value, kind):
                yield kind.__name__.encode()
                yield from (part if isinstance(part, bytes) else self.of(part) for part in told(value))
                return
        yield self.of(type(value))
        if is_dataclass(value):
            for one in fields(value):
                if one.metadata.get("setting", True) is not False:
                    yield self.of(one.name)
                    yield self.of(getattr(value, one.name))


_PLAIN = {type(None), bool, int, float, complex, str, bytes}  # a list of these is told at once: it may be a long table


def _hash(*parts: bytes) -> bytes:
    return hashlib.sha256(b"".join(b"%d:%b" % (len(part), part) for part in parts)).digest()


def _array(value: np.ndarray) -> Iterator[Any]:
    yield value.shape
    yield value.dtype.str
    yield np.ascontiguousarray(value).tobytes() if value.dtype.kind in "biufc" else value.tolist()


def _set(value: frozenset[Any] | set[Any]) -> Iterator[Any]:
    yield from sorted(value, key=repr)  # of plain values, whose order depends on the process


def _function(value: FunctionType) -> Iterator[Any]:
    """What the code of a function does; where it is a library's, its name."""
    code = value.__code__
    if not _is_own(value):
        yield f"{value.__module__}.{value.__qualname__}"
        return
    yield code
    yield value.__defaults__
    yield value.__kwdefaults__
    yield from (_enclosed(cell) for cell in value.__closure__ or ())
    names = value.__globals__
    yield {name: names[name] for name in _read_from_module(code) if name in names}


def _enclosed(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # it has no value yet
        return None


def _code(value: CodeType) -> Iterator[Any]:
    """Instructions, numbers and names; not the place in a file."""
    yield value.co_code
    yield value.co_consts
    yield value.co_names
    yield value.co_varnames
    yield value.co_freevars


def _read_from_module(code: CodeType) -> list[str]:
    """Names that code, and the functions within it, read from their module."""
    read = {one.argval for one in dis.get_instructions(code) if one.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            read |= {*_read_from_module(inner)}
    return sorted(read)


def _class(value: type) -> Iterator[Any]:
    """Its name, and what code of a user its methods have."""
    yield f"{value.__module__.removeprefix('fpirhc_problem_')}.{value.__qualname__}"
    for base in value.__mro__:
        for name, entry in vars(base).items():
            method = _method(entry)
            if isinstance(method, FunctionType) and _is_own(method):
                yield name
                yield method


def _method(entry: object) -> object:
    """The function of an entry of a class, which may be a property or of the class."""
    for within in ("__func__", "fget", "func", "__wrapped__"):
        entry = getattr(entry, within, entry)
    return entry


def _is_own(function: FunctionType) -> bool:
    """Whether code is a user's; that of a notebook or a prompt has no file, and that which a dataclass writes has its module's."""
    file = function.__code__.co_filename
    if file.startswith("<"):
        file = function.__globals__.get("__file__") or "notebook.py"
    return is_users(file)


def _casadi_function(value: ca.Function) -> Iterator[Any]:
    try:
        yield value.serialize()
    except RuntimeError:  # one that calls Python has no text
        yield str(value)


# By kind of a value: what of it counts. The first that fits is taken.
_KINDS: dict[type, Callable[[Any], Iterator[Any]]] = {
    type: _class,
    Enum: lambda value: iter([type(value), value.name]),
    str: lambda value: iter([str(value)]),  # of a class of its own
    float: lambda value: iter([float(value)]),
    int: lambda value: iter([int(value)]),
    Mapping: lambda value: iter([*value.keys(), *value.values()]),
    list: iter,
    tuple: iter,
    set: _set,
    frozenset: _set,
    np.ndarray: _array,
    FunctionType: _function,
    CodeType: _code,
    MethodType: lambda value: iter([value.__func__, value.__self__]),
    BuiltinFunctionType: lambda value: iter([value.__qualname__]),
    functools.partial: lambda value: iter([value.func, value.args, value.keywords]),
    functools._lru_cache_wrapper: lambda value: iter([value.__wrapped__]),
    ModuleType: lambda value: iter([value.__name__]),
    ca.Function: _casadi_function,
    ca.SX: lambda value: iter([str(value)]),
    ca.MX: lambda value: iter([str(value)]),
    ca.DM: lambda value: iter([str(value)]),
}
