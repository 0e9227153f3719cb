"""Words for a value that was given in a wrong place, and how to mend it."""

from __future__ import annotations

import inspect
import reprlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from importlib import import_module
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

if TYPE_CHECKING:
    from fpirhc.fields.expected import Expected

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
_SHORT.maxdict = 2


def described(value: object) -> str:
    """Return a value in a few words."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, ca.SX | ca.MX):
        return f"a CasADi symbol ({_SHORT.repr(value)})"
    if isinstance(value, str):
        return f"the text {_SHORT.repr(value)}"
    if inspect.isroutine(value):
        return f"the function {getattr(value, '__name__', value)}{_signature(value)}"
    if value is None or isinstance(value, int | float | tuple | list | dict | set):
        return _SHORT.repr(value)
    array = f"an array of the shape {value.shape} and the type {value.dtype}" if isinstance(value, np.ndarray) else ""
    return array or f"a value of the class {type(value).__name__}"


def shortened(value: object) -> str:
    """Return a value as Python writes it, with a gap in the middle where it is long."""
    return _SHORT.repr(value)


def mended(expected: Expected, value: object) -> str:
    """Return what to write instead; empty where nothing is near."""
    contract = expected.contract()
    if isinstance(value, type):
        return f"write {call_of(value)}" if contract is not None and issubclass(value, contract) else ""
    if isinstance(value, str):
        return _mended_text(expected, value, contract)
    if isinstance(value, ca.SX | ca.MX):
        return "a setting is a number" if expected.fits(1) or expected.fits(0.5) else ""
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15 and expected.fits(int(value)):
        return f"write {int(value)}"
    if inspect.isroutine(value) and contract is not None:
        return "call it and give its result, or give a value"
    return _part_that_fits(expected, value) if contract is not None else ""


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


def _mended_text(expected: Expected, text: str, contract: type | None) -> str:
    for number in (int, float):
        try:
            if expected.fits(number(text)):
                return f"write {text} without quotes"
        except ValueError:
            continue
    if contract is None:
        return ""
    loaded = getattr(contract, "LOADED", "").format(repr(text))
    members = {_plain(name): member for name, member in _public(contract) if member is not contract or not loaded}
    close = get_close_matches(_plain(text), members, n=1, cutoff=0.5)
    if close:
        return f"write fp.{call_of(members[close[0]])}"
    if loaded:
        return f"write {loaded}"
    return f"one of {', '.join(sorted(m.__name__ for m in members.values()))}" if members else ""


def _part_that_fits(expected: Expected, value: object) -> str:
    """Which part of the value is what is expected, such as the problem of a loaded file."""
    if isinstance(value, Mapping):
        return next((f"give one of its entries, such as [{k!r}]" for k, v in value.items() if expected.fits(v)), "")
    names = [f.name for f in fields(value)] if is_dataclass(value) and not isinstance(value, type) else []
    return next((f"give its .{name}" for name in names if expected.fits(getattr(value, name))), "")


def _public(contract: type) -> Iterator[tuple[str, type]]:
    """Public members of a contract; it imports all of them, which only a mistake pays for."""
    package = import_module(contract.__module__.partition(".")[0])
    for name in getattr(package, "__all__", ()):
        member = getattr(package, name, None)
        if isinstance(member, type) and issubclass(member, contract) and not inspect.isabstract(member):
            yield name, member


def _plain(name: str) -> str:
    return "".join(c for c in name.lower() if c.isalnum())


def _signature(function: Callable[..., object]) -> str:
    try:
        return str(inspect.signature(function))
    except (TypeError, ValueError):
        return "(...)"
