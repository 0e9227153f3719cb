"""Settings of a value as plain data, for reports, files and comparisons of settings."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import partial
from textwrap import indent
from types import CodeType
from typing import Any, TypeVar

import numpy as np

Value = TypeVar("Value")


def describe(value: Any) -> Any:
    """Return `value` as data for JSON; a dataclass becomes {"is": its class, field: ...}, a function its name."""
    if is_dataclass(value) and not isinstance(value, type):
        return {"is": type(value).__name__, **{f.name: describe(getattr(value, f.name)) for f in fields(value)}}
    if isinstance(value, Mapping):
        return {str(k): describe(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return (
            value.tolist() if isinstance(value, np.ndarray) and value.dtype.kind in "biuf" else [*map(describe, value)]
        )
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    name = getattr(value, "__name__", None)
    return type(value).__name__ if name is None else name if isinstance(value, type) else FunctionName(name)


class FunctionName(str):
    """What `describe` has of a function: its numbers count, and not what it is called."""


def digest(*values: Any) -> str:
    """Return 16 hexadecimal digits of settings: what `describe` says, and the code of the functions that it only names."""
    code = [_said(one.__code__) for value in values for one in _named(value) if hasattr(one, "__code__")]
    return hashlib.sha256(repr(([*map(describe, values)], code)).encode()).hexdigest()[:16]


def _said(code: CodeType) -> list[object]:
    """Instructions, names and numbers of a function, those of functions inside it too."""
    inside = [_said(one) if isinstance(one, CodeType) else one for one in code.co_consts]
    return [code.co_code, code.co_names, inside]


def identity(value: Any) -> tuple[str, tuple[object, ...]]:
    """Return a key that two values share only if they are the same: what `describe` says, and the objects that it only names.

    These are classes, functions and values of other kinds, such as the formula of a cost. They are held by the key.
    """
    return repr(describe(value)), tuple(Same(one) for one in _named(value))


@dataclass(frozen=True, eq=False)
class Same:
    """A key that equals itself alone, whether its value can be hashed or not.

    It keeps the value: the address of one that is gone is given to another, which would then be taken for it.
    """

    value: object

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


def _named(value: Any) -> Iterator[object]:
    """What `describe` has only the name of."""
    if is_dataclass(value) and not isinstance(value, type):
        yield type(value)
        value = [getattr(value, f.name) for f in fields(value)]
    elif isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for content in value:
            yield from _named(content)
    elif value is not None and not isinstance(value, bool | int | float | str | np.generic | np.ndarray):
        yield value


def as_written(value: Any, prefix: str = "", width: float = math.inf) -> str:
    """Return a value as a user would write it, on lines of this width: of a dataclass those fields that differ from their defaults.

    Numbers that were computed have six digits; a function is its name, and a class of this package has the prefix.
    """
    inner = partial(as_written, prefix=prefix, width=width - 4)
    if is_dataclass(value) and not isinstance(value, type):
        told = [(f, getattr(value, f.name)) for f in fields(value) if f.init]
        parts = [f"{f.name}={inner(content)}" for f, content in told if _differs(f, content)]
        own = prefix if type(value).__module__.startswith("fpirhc.") else ""
        begin, end = f"{own}{type(value).__name__}(", ")"
    elif isinstance(value, Mapping):
        begin, parts, end = "{", [f"{inner(key)}: {inner(content)}" for key, content in value.items()], "}"
    elif isinstance(value, list | tuple):
        begin, parts, end = "(", [*map(inner, value)], ",)" if len(value) == 1 else ")"
    else:
        named = isinstance(plain := describe(value), str)
        text = json.dumps(value, ensure_ascii=False) if isinstance(value, str) else plain if named else repr(plain)
        text = text if named else text.replace("inf", "math.inf")
        return _COMPUTED.sub(lambda number: f"{float(number[0]):.6g}", text)
    whole = f"{begin}{', '.join(parts)}{end}"
    lines = indent("".join(f"\n{one}," for one in parts), "    ")
    return whole if len(whole) <= width else f"{begin}{lines}\n{end[-1]}"


_COMPUTED = re.compile(r"\d+\.\d{7,}(e[+-]?\d+)?")  # more digits than a user writes


def _differs(one: Field[Any], content: object) -> bool:
    if one.default_factory is not MISSING:
        return repr(content) != repr(one.default_factory())
    return one.default is MISSING or repr(content) != repr(one.default)
