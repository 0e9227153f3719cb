"""Words for a value that was given in a wrong place."""

from __future__ import annotations

import inspect
import reprlib
from collections.abc import Callable

import casadi as ca
import numpy as np

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
_SHORT.maxdict = 2


def described(value: object) -> str:
    """Return a value in a few words."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, ca.SX | ca.MX):
        return f"a CasADi {'symbol' if value.is_valid_input() else 'expression'} ({_SHORT.repr(value)})"
    if isinstance(value, str):
        return f"the text {_SHORT.repr(value)}"
    if inspect.isroutine(value):
        return f"the function {getattr(value, '__name__', value)}{signature_of(value)}"
    if value is None or isinstance(value, int | float | tuple | list | dict | set):
        return _SHORT.repr(value)
    array = f"an array of the shape {value.shape} and the type {value.dtype}" if isinstance(value, np.ndarray) else ""
    return array or f"a value of the class {type(value).__name__}"


def shortened(value: object) -> str:
    """Return a value as Python writes it, with a gap in the middle where it is long."""
    return _SHORT.repr(value)


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


def signature_of(function: Callable[..., object]) -> str:
    """Return the arguments of a function as it declares them; (...) where they are not known."""
    try:
        return str(inspect.signature(function))
    except (TypeError, ValueError):
        return "(...)"
