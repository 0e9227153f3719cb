"""Smooth functions that models often need, and functions of settings that round alike as numbers and as expressions.

A formula of a setting is written once, for a float and for a live number (see `live`). Its operations are + - * / and the
functions here: a power is a product, because the pow of Python and that of CasADi differ in the last digit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from typing import TypeVar, cast

import casadi as ca

from fpirhc.symbolic.layout import Expression
from fpirhc.symbolic.live import LiveNumber, expressed, is_live

SMOOTHING = 1e-6  # half width, in the unit of the argument, within which the power is rounded off around zero
T = TypeVar("T")
_Two = Callable[..., object]


def signed_power(d: Expression, exponent: Expression | float) -> Expression:
    """Return sign(d) |d|^exponent, rounded off within 1e-6 of zero so that its derivatives stay finite.

    Computed as d (d^2 + 1e-12)^((exponent - 1)/2).
    """
    return d * ca.exp((exponent - 1) / 2 * ca.log(d * d + SMOOTHING**2))


def power(base: T, exponent: int) -> T | float:
    """Return base^exponent as a product; 1.0 for the exponent 0."""
    return math.prod([base] * (exponent - 1), start=base) if exponent else 1.0  # type: ignore[call-overload]


def tanh(x: float) -> float:
    """Return tanh of a number, live or not."""
    return x.called(math.tanh, ca.tanh) if isinstance(x, LiveNumber) else math.tanh(x)


def atanh(x: float) -> float:
    """Return atanh of a number, live or not."""
    return x.called(math.atanh, ca.atanh) if isinstance(x, LiveNumber) else math.atanh(x)


def asin(x: float) -> float:
    """Return asin of a number, live or not."""
    return x.called(math.asin, ca.asin) if isinstance(x, LiveNumber) else math.asin(x)


def exp(x: float) -> float:
    """Return exp of a number, live or not."""
    return x.called(math.exp, ca.exp) if isinstance(x, LiveNumber) else math.exp(x)


def cos(x: float) -> float:
    """Return cos of a number, live or not."""
    return x.called(math.cos, ca.cos) if isinstance(x, LiveNumber) else math.cos(x)


def signed(size: float, sign: float) -> float:
    """Return the size of a number, live or not, with the sign of another one."""
    if isinstance(sign, LiveNumber):
        sign = sign.called(lambda x: math.copysign(1.0, x), lambda x: ca.if_else(x < 0, -1, 1))
        return abs(size) * sign
    return math.copysign(1.0, sign) * abs(size)


def numbers(values: Sequence[float | LiveNumber], beside: Expression | None = None) -> Expression:
    """Return a column of numbers: constants, or an expression where some are live, of the kind of another one where it is given."""
    if not is_live(values):
        return cast(Expression, ca.DM(cast(list[float], list(values))))
    return cast(Expression, ca.vertcat(*(values if beside is None else (expressed(value, beside) for value in values))))


def overlaid(column: Expression, values: Sequence[float | LiveNumber]) -> list[Expression]:
    """Return the entries of a column that holds some numbers, with the live ones themselves in their places."""
    return [expressed(v, column) if isinstance(v, LiveNumber) else column[k] for k, v in enumerate(values)]


def quotient(over: Expression, number: float | LiveNumber) -> Expression:
    """Return an expression divided by a number, live or not; zero where the number is zero."""
    if not isinstance(number, LiveNumber):
        return over / number if number else 0 * over
    under = expressed(number, over)
    return ca.if_else(under == 0, 0 * over, over / ca.if_else(under == 0, 1, under))


def between(x: float, low: float, high: float) -> float:
    """Return a number, live or not, moved to the nearer end of an interval where it is outside."""
    if isinstance(x, LiveNumber):
        return x.called(lambda v: min(max(low, v), high), lambda v: ca.fmin(ca.fmax(low, v), high))
    return min(max(low, x), high)


def smaller(x: float, y: float) -> float:
    """Return the smaller of two numbers, live or not."""
    return _of_both(x, y, min, ca.fmin)


def larger(x: float, y: float) -> float:
    """Return the larger of two numbers, live or not."""
    return _of_both(x, y, max, ca.fmax)


def largest(values: Iterable[float]) -> float:
    """Return the largest of some numbers, live or not."""
    return reduce(larger, values)


def positive(x: float) -> float:
    """Return 1 for a positive number, live or not, and 0 for another one."""
    return x.called(lambda v: float(v > 0), lambda v: v > 0) if isinstance(x, LiveNumber) else float(x > 0)


def stays(x: float, value: float) -> bool:
    """Return whether a number is a certain one in every run of the loop; a live one may become another."""
    return not isinstance(x, LiveNumber) and x == value


def left_after(period: float, time: float) -> float:
    """Return e^(-T / tau), the share of a distance that is left after a period; 0 for the time constant 0, which may be live."""
    if isinstance(time, LiveNumber):
        return time.called(
            lambda t: left_after(period, t), lambda t: ca.if_else(t == 0, 0, ca.exp(-period / ca.if_else(t == 0, 1, t)))
        )
    return math.exp(-period / time) if time else 0.0


def left_in_mean(period: float, time: float) -> float:
    """Return the mean of what is left over a period, (tau / T) (1 - e^(-T / tau)); 0 for tau = 0, which may be live."""
    if isinstance(time, LiveNumber):
        return time.called(
            lambda t: left_in_mean(period, t),
            lambda t: ca.if_else(t == 0, 0, t / period * -ca.expm1(-period / ca.if_else(t == 0, 1, t))),
        )
    return time / period * -math.expm1(-period / time) if time else 0.0


def sqrt(x: float) -> float:
    """Return the square root of a number, live or not."""
    return x.called(math.sqrt, ca.sqrt) if isinstance(x, LiveNumber) else math.sqrt(x)


def ceil(x: float) -> float:
    """Return the least whole number that is not below a number, live or not."""
    return x.called(math.ceil, ca.ceil) if isinstance(x, LiveNumber) else math.ceil(x)


def rounded(x: float) -> float:
    """Return the nearest whole number to a number, live or not; the even one of two."""
    return x.called(round, _nearest_even) if isinstance(x, LiveNumber) else round(x)


def _of_both(x: float, y: float, number: _Two, expression: _Two) -> float:
    if not isinstance(x, LiveNumber) and not isinstance(y, LiveNumber):
        return cast(float, number(x, y))
    paths = tuple(dict.fromkeys(path for one in (x, y) if isinstance(one, LiveNumber) for path in one.paths))
    both = lambda kind: tuple(one.of(kind) if isinstance(one, LiveNumber) else one for one in (x, y))  # noqa: E731
    return LiveNumber(paths, lambda kind: (number if kind is float else expression)(*both(kind)))


def _nearest_even(x: Expression) -> Expression:
    upper = ca.floor(x + 0.5)
    return upper - ca.logic_and(upper - x == 0.5, ca.fmod(upper, 2) != 0)


def nan_where(failed: Expression) -> Expression:
    """Return NaN where a condition (1 or 0) holds, and zero elsewhere.

    It is computed, because the constant NaN in a loop is the mark of a live setting that was lost. Its derivative is zero where
    the condition does not hold, so it spoils no gradient there.
    """
    return ca.asin(2 * failed)


def entry_at(values: Expression, place: Expression) -> Expression:
    """Return the entry of a column at a place that is known at run time; zero beyond its ends.

    Every entry is looked at. CasADi's scalar code has no table, and an entry that is not taken does not spoil the sum.
    """
    entries = ca.vertsplit(values)
    return cast(Expression, sum(ca.if_else(place == k, one, 0) for k, one in enumerate(entries)))
