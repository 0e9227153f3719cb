"""The mistakes of a value, each with how to mend it."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from types import ModuleType

import casadi as ca

from fpirhc.fields.expected import Expected, accepts
from fpirhc.fields.given import call_of, described, shortened, signature_of


def mistakes_in(expected: Expected, where: str, value: object) -> Iterator[str]:
    """Yield every mistake of the value and its parts."""
    if not expected.fits(value):
        comma = isinstance(value, tuple) and len(value) == 1 and accepts(expected, value[0])
        mend = "a comma behind the value makes a tuple of it; remove the comma" if comma else ""
        mend = mend or expected.completed(value) or mended(expected, value)
        yield f"{where}: expected {expected.words}, got {described(value)}{'; ' + mend if mend else ''}"
        return
    for place, inner, part in expected.parts(value):
        yield from mistakes_in(inner, f"{where}{place}", part)


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
    return _made_of(expected, value, contract)


def _made_of(expected: Expected, value: object, contract: type | None) -> str:
    """How what is expected is made of a value that holds it, or that it should hold."""
    if isinstance(value, int | float | Mapping) and expected.fits(lambda t: t):
        return f"write lambda t: {shortened(value)}"
    if contract is None:
        return ""
    if inspect.isroutine(value) and signature_of(value) == "()":
        return "call it and give its result"
    return _part_that_fits(expected, value) or _member(contract)


def _mended_text(expected: Expected, text: str, contract: type | None) -> str:
    for number in (int, float):
        try:
            if expected.fits(number(text)):
                return f"write {text} without quotes"
        except ValueError:
            continue
    if contract is None:
        return ""
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
    if contract.__name__ not in getattr(import_module(contract.__module__.partition(".")[0]), "__all__", ()):
        return ""
    _, *first = inspect.signature(getattr(contract, "__init__")).parameters  # noqa: B009
    return f"write fp.{call_of(contract)}".replace("()", f"({first[0]}=...)" if first else "()")


def _part_that_fits(expected: Expected, value: object) -> str:
    """Which part of the value is what is expected, such as the problem of a loaded file."""
    if isinstance(value, Mapping):
        return next((f"give one of its entries, such as [{k!r}]" for k, v in value.items() if expected.fits(v)), "")
    names = [f.name for f in fields(value)] if is_dataclass(value) and not isinstance(value, type) else []
    return next((f"give its .{name}" for name in names if expected.fits(getattr(value, name))), "")


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
    stub = Path(package.__file__ or "").with_suffix(".pyi")
    if not stub.is_file():
        return list(getattr(package, "__all__", ()))
    lines = (one for one in ast.parse(stub.read_text(encoding="utf-8")).body if isinstance(one, ast.ImportFrom))
    of_part = (one for one in lines if (one.module or "").partition(".")[0] == part)
    return [alias.asname or alias.name for one in of_part for alias in one.names]


def _plain(name: str) -> str:
    return "".join(c for c in name.lower() if c.isalnum())
