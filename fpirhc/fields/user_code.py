"""Functions that a user gives, such as a response: an error of theirs says what, where, why, and what to write instead."""

from __future__ import annotations

import inspect
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FrameType
from typing import TypeVar

import casadi as ca
import numpy as np

from fpirhc.errors import FpirhcError, InvalidProblem, nearest
from fpirhc.fields.kinds import described
from fpirhc.symbolic.expression import Expression, expression, holds_nan

Result = TypeVar("Result")

_OF_CASADI = (
    "math, numpy, float() and int() cannot act on a symbol; use CasADi's functions (import casadi as ca; ca.sin, ca.exp, ca.atan2, "
    "ca.fmax, ca.if_else)"
)
_USUAL = {"ca": "casadi as ca", "np": "numpy as np", "fp": "fpirhc as fp", "math": "math"}


def called(what: str, function: Callable[..., Result], *arguments: object) -> Result:
    """Return what a user's function gives for symbols; `what` names it: "response"."""
    try:
        with warnings.catch_warnings():
            # CasADi announces that its numpy functions will change their shape; scalars do not.
            warnings.filterwarnings("ignore", message=r"\s*casadi: a numpy function", category=FutureWarning)
            return function(*arguments)
    except Exception as error:  # noqa: BLE001 -- whatever a user's function raises is a mistake in it
        frames = [f for f in traceback.extract_tb(error.__traceback__) if _is_users(f.filename)]
        place = f"{Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else ""
        raise InvalidProblem(f"{what}{f' ({place})' if place else ''}: {explained(error)}") from None


def scalar_expression(
    what: str,
    value: object,
    *,
    of: Callable[..., object] | None = None,
    symbols: Sequence[Expression] = (),
    finite: bool = True,
) -> Expression:
    """Return a result of a user's function as one scalar expression."""
    if not isinstance(value, ca.SX | ca.MX | ca.DM | int | float | np.number):
        raise InvalidProblem(f"{what} must be one scalar expression, got {described(value)}")
    made = expression(value if isinstance(value, ca.SX | ca.MX | ca.DM) else ca.DM(float(value)))
    if made.numel() != 1:
        raise InvalidProblem(f"{what} must be one scalar, got shape {made.shape}")
    if strange := _strangers(made, symbols):
        raise InvalidProblem(
            f"{what} holds the symbol {strange}, which has no value; use the arguments of the function, or a Parameter"
        )
    # CasADi makes NaN of math.sin(symbol), and says nothing.
    checked = ca.SX(made) if finite and not isinstance(made, ca.MX) else ca.SX(0)
    if holds_nan(ca.Function("fpirhc_result", ca.symvar(checked), [checked])):
        place = f" ({place_of(of)})" if of is not None else ""
        raise InvalidProblem(f"{what} holds NaN{place}: {_OF_CASADI}")
    return made


def named_results(what: str, result: object) -> Mapping[str, object]:
    """Return the mapping that a user's function gives."""
    if not isinstance(result, Mapping):
        mend = "a function without `return` gives None" if result is None else "return {'name': expression, ...}"
        raise InvalidProblem(f"{what} must return {{name: expression}}, got {described(result)}; {mend}")
    return result


def explained(error: BaseException) -> str:
    """Return the cause of an error in code that acts on symbols, and what to write instead."""
    text = f"{error}"
    if isinstance(error, FpirhcError):
        return text
    if "truth value" in text:
        return (
            "a symbol is neither true nor false, so `if`, `and`, `or`, `not`, max() and min() cannot act on it; "
            "use ca.if_else(condition, then, otherwise), ca.logic_and, ca.fmax or ca.fmin"
        )
    if re.search(r"\bMX\b", text) and re.search(r"\bSX\b", text):
        return "the symbols here are of the kind SX, which cannot be mixed with MX; use them, numbers and functions of ca alone"
    if isinstance(error, AttributeError) and is_dataclass(error.obj):
        valid = [one.name for one in fields(error.obj)]
        return f"a {type(error.obj).__name__} has no '{error.name}'.{nearest(error.name, valid)}"
    if isinstance(error, NameError) and (module := _USUAL.get(str(error.name))):
        return f"'{error.name}' is not imported; write import {module} at the top of the file"
    symbols = re.search(r"\b(SX|MX|to_double|to_int|new_SX|new_MX)\b", text) is not None
    first = text.strip().partition("\n")[0]
    return f"{type(error).__name__}: {first}{f'; {_OF_CASADI}' if symbols else ''}"


def place_of(function: Callable[..., object]) -> str:
    """Return "file.py, line 12" of a function's definition; empty where it has none."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return "" if code is None else f"{Path(code.co_filename).name}, line {code.co_firstlineno}"


def _strangers(made: Expression, symbols: Sequence[Expression]) -> str:
    """Names of symbols in an expression that are not among those that it may hold."""
    if not symbols or made.is_constant():
        return ""
    known = ca.symvar(ca.vertcat(*symbols))
    if not isinstance(made, type(known[0])):
        return ", ".join(one.name() for one in ca.symvar(made))
    return ", ".join(ca.Function("fpirhc_result", known, [made], {"allow_free": True}).get_free())


_PACKAGE = str(Path(__file__).resolve().parents[1])
_PROBLEMS = str(Path(_PACKAGE) / "_problems")  # shipped problems of an installed package are read as a user's files
_LIBRARIES = (str(Path(sys.prefix) / "lib"), str(Path(sys.base_prefix) / "lib"), "<")


def users_place() -> str:
    """Return "file.py, line 12" of the innermost call from outside the package; empty where there is none."""
    _, frame = _users_frame(sys._getframe(1))
    return f"{Path(frame.f_code.co_filename).name}, line {frame.f_lineno}" if frame else ""


def users_level() -> int:
    """Return the `stacklevel` with which a warning by the caller of this function stands at the user's line."""
    depth, frame = _users_frame(sys._getframe(1))
    return depth + 1 if frame else 1


def _users_frame(frame: FrameType | None) -> tuple[int, FrameType | None]:
    """The innermost frame of a user's code from this one on, and how many calls it is away."""
    depth = 0
    while frame is not None and not _is_users(frame.f_code.co_filename):
        frame, depth = frame.f_back, depth + 1
    return depth, frame


def _is_users(filename: str) -> bool:
    """Whether a file of code belongs neither to the package nor to the libraries around it."""
    if filename.startswith(_PACKAGE) and not filename.startswith(_PROBLEMS):
        return False
    return filename.endswith(".py") and not filename.startswith(_LIBRARIES)
