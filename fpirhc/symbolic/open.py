"""Numbers that stay open while a loop is built, so that a compiled loop takes other values: plain CasADi symbols.

    gain = open_number("deformation.gain", -0.5)  # the symbol 'setting.deformation.gain', remembered with its number

The closed values are checked first; then a symbol is planted in place of each number, without another check
(`fpirhc.controllers.live_settings`). A block whose step meets one reads it as a signal (`fpirhc.symbolic.block`). Python cannot
compute with a symbol: where a build does, it is refused by its path and the place. Beside it stand functions of numbers that may be
open; a power is a product, because the pow of Python and that of CasADi differ in the last digit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from types import FunctionType
from typing import TypeVar, cast
from weakref import WeakValueDictionary

import casadi as ca
import numpy as np

from fpirhc.errors import NotSupported
from fpirhc.symbolic.layout import Expression

ANEW = "state it in the problem or the controller, and build a loop for each number"  # what to do instead
PREFIX = "setting."  # of the names of the symbols, and of the signals that are settings
T = TypeVar("T")
Value = TypeVar("Value", ca.SX, ca.MX)
_LEAVES = {float, int, bool, str, type(None), np.ndarray, FunctionType}
_PLAIN: WeakValueDictionary[int, object] = WeakValueDictionary()  # frozen values without open numbers, by address
_BUILT: dict[int, tuple[ca.SX, float]] = {}  # every symbol with the number of its build


def open_number(path: str, value: float) -> ca.SX:
    """Return the symbol of a number."""
    symbol = ca.SX.sym(PREFIX + path)
    _BUILT[symbol.element_hash()] = symbol, float(value)
    return symbol


def is_open(value: object) -> bool:
    """Return whether something is an open number, or an expression of such numbers."""
    if not isinstance(value, ca.SX) or not value.is_scalar():
        return False
    symbols = ca.symvar(value)
    return bool(symbols) and all(s.element_hash() in _BUILT for s in symbols)


def not_live(paths: Iterable[str], why: str, where: str = "") -> NotSupported:
    """Return the error of settings that cannot be open, with the reason; `where` says in which case they cannot, after a space."""
    names = [f"'{path}'" for path in paths]
    return NotSupported(f"setting{'s' if len(names) > 1 else ''} {', '.join(names)} cannot be live{where}: {why}")


def require_closed(what: str, *values: object) -> None:
    """Raise where an open number stands in one of the values, from which Python computes something at `what`."""
    paths = list(open_numbers(*values))
    if paths:
        raise not_live(paths, f"{what} is computed from it while the loop is built; {ANEW}", " here")


def open_numbers(*values: object) -> dict[str, ca.SX]:
    """Return the symbols in some values, by path."""
    found: dict[str, ca.SX] = {}

    def note(number: ca.SX) -> ca.SX:
        found.update({s.name().removeprefix(PREFIX): s for s in ca.symvar(number)})
        return number

    for value in values:
        _mapped(value, note)
    return found


def number_of(value: ca.SX) -> float:
    """Return the number of the build of an open number."""
    symbols = ca.symvar(value)
    return float(ca.Function("fpirhc_number", symbols, [value])(*(_BUILT[s.element_hash()][1] for s in symbols)))


def nominal(value: T) -> T:
    """Return a value with the numbers of the build in place of all open ones in it; the value itself where it has none."""
    return cast(T, _mapped(value, number_of))


def expressed(value: float | ca.SX, beside: Value) -> Value:
    """Return a number as an expression of the kind of another one; a number that is not open stays as it is."""
    if not isinstance(value, ca.SX) or not isinstance(beside, ca.MX):
        return cast(Value, value)
    symbols = ca.symvar(value)
    graph = [_in_graph(s.name()) for s in symbols]
    return graph[0] if value.is_symbolic() else ca.Function("fpirhc_open", symbols, [value])(*graph)


@cache
def _in_graph(name: str) -> ca.MX:
    return ca.MX.sym(name)


def copied(value: T, changes: Mapping[str, object]) -> T:
    """Return a frozen dataclass with other contents of some fields, without validation and without cached facts."""
    copy = object.__new__(type(value))
    for one in fields(value):  # type: ignore[arg-type]  # mypy does not narrow type variables
        object.__setattr__(copy, one.name, changes.get(one.name, getattr(value, one.name)))
    return copy


def _mapped(value: object, change: Callable[[ca.SX], object]) -> object:
    """The value with `change` applied to its open numbers; the same object where it has none."""
    return _changed(value, change) if type(value) not in _LEAVES and _has_open(value) else value


def _changed(value: object, change: Callable[[ca.SX], object]) -> object:
    if isinstance(value, ca.SX):
        return change(value)
    if isinstance(value, Mapping):
        return {key: _mapped(entry, change) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return type(value)([_mapped(entry, change) for entry in value])
    contents = {f.name: getattr(value, f.name) for f in fields(value)}  # type: ignore[arg-type]  # a dataclass
    return copied(value, {name: _mapped(content, change) for name, content in contents.items()})


def _has_open(value: object) -> bool:
    """Whether an open number stands in a value. Frozen ones that have none are remembered: most are searched many times."""
    if isinstance(value, ca.SX):
        return is_open(value)
    parts: Iterable[object] = ()
    if isinstance(value, Mapping):
        parts = value.values()
    elif isinstance(value, tuple | list):
        parts = value
    elif is_dataclass(value) and not isinstance(value, type) and _PLAIN.get(id(value)) is not value:
        parts = [getattr(value, f.name) for f in fields(value)]
    for part in parts:
        if type(part) not in _LEAVES and _PLAIN.get(id(part)) is not part and _has_open(part):
            return True
    if is_dataclass(value) and not isinstance(value, type):
        _PLAIN[id(value)] = value
    return False


# Functions of numbers that may be open


SMOOTHING = 1e-6  # half width, in the unit of the argument, within which the power is rounded off around zero


def signed_power(d: Expression, exponent: Expression | float) -> Expression:
    """Return sign(d) |d|^exponent, rounded off within 1e-6 of zero so that its derivatives stay finite.

    Computed as d (d^2 + 1e-12)^((exponent - 1)/2).
    """
    return d * ca.exp((exponent - 1) / 2 * ca.log(d * d + SMOOTHING**2))


def power(base: T, exponent: int) -> T | float:
    """Return base^exponent as a product; 1.0 for the exponent 0."""
    return math.prod([base] * (exponent - 1), start=base) if exponent else 1.0  # type: ignore[call-overload]


def _nearest_even(x: Expression) -> Expression:
    upper = ca.floor(x + 0.5)
    return upper - ca.logic_and(upper - x == 0.5, ca.fmod(upper, 2) != 0)


def _of_any(number: Callable[[float], float], expression: Callable[..., object]) -> Callable[[float], float]:
    """A function of a number, open or not."""
    return lambda x: cast(float, expression(x)) if isinstance(x, ca.SX) else number(x)


tanh, atanh, asin = _of_any(math.tanh, ca.tanh), _of_any(math.atanh, ca.atanh), _of_any(math.asin, ca.asin)
exp, cos, sqrt = _of_any(math.exp, ca.exp), _of_any(math.cos, ca.cos), _of_any(math.sqrt, ca.sqrt)
rounded = _of_any(round, _nearest_even)


def signed(size: float, sign: float) -> float:
    """Return the size of a number with the sign of another one."""
    return (ca.if_else(sign < 0, -1, 1) if isinstance(sign, ca.SX) else math.copysign(1.0, sign)) * ca.fabs(size)


def numbers(values: Sequence[float | ca.SX], beside: Expression | None = None) -> Expression:
    """Return a column of numbers: constants, or an expression where some are open, of the kind of another one where it is given."""
    if not open_numbers(values):
        return cast(Expression, ca.DM(cast(list[float], list(values))))
    return cast(Expression, ca.vertcat(*(values if beside is None else (expressed(value, beside) for value in values))))


def overlaid(column: Expression, values: Sequence[float | ca.SX]) -> list[Expression]:
    """Return the entries of a column that holds some numbers, with the open ones themselves in their places."""
    return [expressed(v, column) if isinstance(v, ca.SX) else column[k] for k, v in enumerate(values)]


def quotient(over: Expression, number: float | ca.SX) -> Expression:
    """Return an expression divided by a number; zero where the number is zero."""
    if not isinstance(number, ca.SX):
        return over / number if number else 0 * over
    under = expressed(number, over)
    return ca.if_else(under == 0, 0 * over, over / ca.if_else(under == 0, 1, under))


def smaller(x: float, y: float) -> float:
    """Return the smaller of two numbers."""
    return ca.fmin(x, y) if isinstance(x, ca.SX) or isinstance(y, ca.SX) else min(x, y)


def larger(x: float, y: float) -> float:
    """Return the larger of two numbers."""
    return ca.fmax(x, y) if isinstance(x, ca.SX) or isinstance(y, ca.SX) else max(x, y)


def between(x: float, low: float, high: float) -> float:
    """Return a number moved to the nearer end of an interval where it is outside."""
    return smaller(larger(low, x), high)


def stays(x: float, value: float) -> bool:
    """Return whether a number is a certain one in every run of the loop; an open one may become another."""
    return not isinstance(x, ca.SX) and x == value


def left_after(period: float, time: float) -> float:
    """Return e^(-T / tau), the share of a distance that is left after a period; 0 for the time constant 0."""
    if isinstance(time, ca.SX):
        return ca.if_else(time == 0, 0, ca.exp(-period / ca.if_else(time == 0, 1, time)))
    return math.exp(-period / time) if time else 0.0


def left_in_mean(period: float, time: float) -> float:
    """Return the mean of what is left over a period, (tau / T) (1 - e^(-T / tau)); 0 for tau = 0."""
    if isinstance(time, ca.SX):
        return ca.if_else(time == 0, 0, time / period * -ca.expm1(-period / ca.if_else(time == 0, 1, time)))
    return time / period * -math.expm1(-period / time) if time else 0.0
