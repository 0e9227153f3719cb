"""Functions that a user gives, such as a response: an error of theirs says what, where, why, and what to write instead."""

from __future__ import annotations

import inspect
import linecache
import math
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

from fpirhc.errors import FpirhcError, InvalidName, InvalidProblem, nearest
from fpirhc.fields.kinds import described
from fpirhc.symbolic.expression import Expression, expression

Result = TypeVar("Result")


def called(what: str, function: Callable[..., Result], *arguments: object) -> Result:
    """Return what a user's function gives for symbols; `what` names it: "response"."""
    try:
        with warnings.catch_warnings():
            # CasADi announces that its numpy functions will change their shape; scalars do not.
            warnings.filterwarnings("ignore", message=r"\s*casadi: a numpy function", category=FutureWarning)
            return function(*arguments)
    except FpirhcError as error:
        raise InvalidProblem(f"{what}{_at(error)}: {error}") from None
    except Exception as error:  # noqa: BLE001 -- whatever a user's function raises is a mistake in it
        raise InvalidProblem(f"{what}{_at(error)}: {explained(error)}") from None


def scalar_expression(
    what: str,
    value: object,
    *,
    of: Callable[..., object] | None = None,
    symbols: Sequence[Expression] = (),
    finite: bool = True,
) -> Expression:
    """Return a result of a user's function as one scalar expression.

    Args:
        of: the user's function, whose source is searched for the cause of NaN.
        symbols: those that the result may hold; without them any.
        finite: whether NaN is refused. CasADi makes NaN of math.sin(symbol), and says nothing.
    """
    if not isinstance(value, ca.SX | ca.MX | ca.DM | int | float | np.number):
        raise InvalidProblem(f"{what} must be one scalar expression, got {described(value)}")
    made = expression(value if isinstance(value, ca.SX | ca.MX | ca.DM) else ca.DM(float(value)))
    if made.numel() != 1:
        raise InvalidProblem(f"{what} must be one scalar, got shape {made.shape}")
    strange = _strangers(made, symbols)
    if strange:
        raise InvalidProblem(
            f"{what} holds the symbol {strange}, which has no value; use the arguments of the function, or a Parameter"
        )
    if finite and _holds_nan(made):
        raise InvalidProblem(f"{what} holds NaN{_cause_of_nan(of)}")
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
    if "truth value" in text:
        return (
            "a symbol is neither true nor false, so `if`, `and`, `or`, `not`, max() and min() cannot act on it; "
            "use ca.if_else(condition, then, otherwise), ca.logic_and, ca.fmax or ca.fmin"
        )
    line = _line_of(error)
    call = re.search(r"\b(np|numpy|math|scipy|sp)\.((?:\w+\.)*)(\w+)", line)
    symbols = re.search(r"\b(SX|MX|to_double|to_int|new_SX|new_MX)\b", text) is not None
    if re.search(r"\bMX\b", text) and re.search(r"\bSX\b", text):
        return "the symbols here are of the kind SX, which cannot be mixed with MX; use them, numbers and functions of ca alone"
    if missing := _missing_name(error):
        return missing
    if symbols and call is not None:
        return f"{call.group(0)} cannot act on a symbol; {_instead(call.group(3))}"
    if symbols and re.search(r"\b(float|int|range|round)\(", line):
        return "a symbol has no value yet, so it cannot become a Python number; keep it as an expression"
    return f"{type(error).__name__}: {_first_line(text)}"


def _missing_name(error: BaseException) -> str:
    """What is said of a field that a value does not have, or of a name that a module does not have; '' for another error."""
    if isinstance(error, AttributeError) and is_dataclass(error.obj):
        valid = [one.name for one in fields(error.obj)]
        return f"a {type(error.obj).__name__} has no '{error.name}'.{nearest(error.name, valid)}"
    found = re.match(r"cannot import name '(\w+)' from '([\w.]+)'", f"{error}")
    if not isinstance(error, ImportError) or found is None or found[2] not in sys.modules:
        return ""
    module = sys.modules[found[2]]
    try:
        getattr(module, found[1])
    except InvalidName as missing:  # a module that says itself what is meant
        return str(missing)
    except AttributeError:
        pass
    names = [one for one in dir(module) if not one.startswith("_")]
    return f"{found[2]} has no name '{found[1]}'.{nearest(found[1], names)}"


def place_in_users_code(error: BaseException) -> str:
    """Return "file.py, line 12: source" of the innermost line of a user's file; empty where there is none."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if is_users(f.filename)]
    if not frames:
        return ""
    return f"{Path(frames[-1].filename).name}, line {frames[-1].lineno}: {frames[-1].line}"


def place_of(function: Callable[..., object]) -> str:
    """Return "file.py, line 12" of a function's definition; empty where it has none."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return "" if code is None else f"{Path(code.co_filename).name}, line {code.co_firstlineno}"


def _cause_of_nan(function: Callable[..., object] | None) -> str:
    """The first call in a function's source that makes NaN of a symbol."""
    general = f": float(...) and the functions of `math` make NaN of a symbol; {_OF_CASADI}"
    if function is None:
        return general
    own = inspect.unwrap(function)
    try:
        lines, first = inspect.getsourcelines(own)
    except (OSError, TypeError):
        return general
    calls = [(n, c) for n, line in enumerate(lines, first) if (c := re.search(r"\bmath\.(\w+)\(", line)) is not None]
    if not calls:
        return general
    number, call = calls[0]
    file = Path(inspect.getsourcefile(own) or "").name
    return f" ({file}, line {number}): {call.group(0)}...) of a symbol is NaN; {_instead(call.group(1))}"


def _at(error: BaseException) -> str:
    place = place_in_users_code(error).partition(": ")[0]
    return f" ({place})" if place else ""


def _line_of(error: BaseException) -> str:
    frames = [f for f in traceback.extract_tb(error.__traceback__) if is_users(f.filename)]
    return "" if not frames else linecache.getline(frames[-1].filename, frames[-1].lineno or 0)


def _instead(name: str) -> str:
    """What CasADi has for a function of numpy or math."""
    ours = _EQUIVALENTS.get(name, name)
    return f"use ca.{ours}" if hasattr(ca, ours.partition("(")[0]) else _OF_CASADI


def _strangers(made: Expression, symbols: Sequence[Expression]) -> str:
    """Names of symbols in an expression that are not among those that it may hold."""
    if not symbols or made.is_constant():
        return ""
    known = ca.symvar(ca.vertcat(*symbols))
    if not isinstance(made, type(known[0])):
        return ", ".join(one.name() for one in ca.symvar(made))
    function = ca.Function("fpirhc_result", known, [made], {"allow_free": True})
    return ", ".join(function.get_free())


def _holds_nan(made: Expression) -> bool:
    if made.is_constant():
        return math.isnan(float(ca.evalf(made)))
    if not isinstance(made, ca.SX):
        return False
    function = ca.Function("fpirhc_result", ca.symvar(made), [made])
    places = range(function.n_instructions())
    constants = [function.instruction_constant(k) for k in places if function.instruction_id(k) == ca.OP_CONST]
    return any(map(math.isnan, constants))


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0]


_OF_CASADI = "use CasADi's functions (import casadi as ca; ca.sin, ca.exp, ca.fmax, ca.if_else)"
_EQUIVALENTS = {
    "abs": "fabs",
    "absolute": "fabs",
    "arctan2": "atan2",
    "arctan": "atan",
    "arcsin": "asin",
    "arccos": "acos",
    "arcsinh": "asinh",
    "arccosh": "acosh",
    "arctanh": "atanh",
    "maximum": "fmax",
    "max": "fmax",
    "minimum": "fmin",
    "min": "fmin",
    "where": "if_else",
    "select": "if_else",
    "heaviside": "if_else(x > 0, 1, 0)",
    "pow": "power",
    "array": "vertcat",
    "asarray": "vertcat",
    "clip": "fmin(ca.fmax(x, low), high)",
    "norm": "norm_2",
    "interp": "interpolant",
    "logical_and": "logic_and",
    "logical_or": "logic_or",
    "fmod": "fmod",
    "mod": "fmod",
    "square": "power(x, 2)",
}


_PACKAGE = str(Path(__file__).resolve().parents[1])
_PROBLEMS = str(Path(_PACKAGE) / "_problems")  # shipped problems of an installed package are read as a user's files


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
    while frame is not None and not is_users(frame.f_code.co_filename):
        frame, depth = frame.f_back, depth + 1
    return depth, frame


def is_users(filename: str) -> bool:
    """Return whether a file of code belongs neither to the package nor to the libraries around it."""
    if filename.startswith(_PACKAGE) and not filename.startswith(_PROBLEMS):
        return False
    return filename.endswith(".py") and not filename.startswith(_LIBRARIES)


_LIBRARIES = (str(Path(sys.prefix) / "lib"), str(Path(sys.base_prefix) / "lib"), "<")
