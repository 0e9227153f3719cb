"""The types that steps are written in, on top of CasADi's stubs.

CasADi has two kinds of symbolic matrices with the same operations: SX (scalar code) and MX (calls of Functions). Its stubs
give them no common type, and the union of both has no sum, because SX and MX never mix. A step is written once and built
with either kind. The type checker therefore reads every `Expression` as SX; what is always a graph of calls (the
optimisers) is typed as MX. This module is the only place where one kind passes for the other.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias, TypeVar, cast

import casadi as ca
import numpy as np

from fpirhc.errors import nearest

Expression: TypeAlias = ca.SX  # a CasADi SX, MX or DM
Value: TypeAlias = ca.SX | ca.DM | float  # a result of a step: numbers become expressions
T = TypeVar("T")
Matrix = TypeVar("Matrix", ca.SX, ca.MX, ca.DM)  # for functions whose result is of the same kind as their argument

# Numbers of the type that computes. In C they are those of its own type: see `driver.OF_TYPE`.
# |v| <= FINITE is false for NaN and infinity, in a form that CasADi does not simplify away.
FINITE = sys.float_info.max / 2**27  # 1.3e300
TINY = sys.float_info.min * 2**26  # 1.5e-300; added to what may be zero


class Signals:
    """The signals that a step reads and remembers, by attribute: `s.desired` is a CasADi column."""

    def __init__(self, symbols: Mapping[str, Expression]) -> None:
        """Store the symbol of every signal under its name."""
        self.__dict__ |= symbols

    def __getattr__(self, name: str) -> Expression:
        raise AttributeError(f"the step neither reads nor remembers '{name}'.{nearest(name, vars(self))}")


def expression(value: ca.SX | ca.MX | ca.DM | float) -> Expression:
    """Return `value` itself; the type checker reads it as an Expression."""
    return cast(Expression, value)


def graph(value: Expression) -> ca.MX:
    """Return `value` itself, an expression of an opaque block; the type checker reads it as the MX that it is."""
    return cast(ca.MX, value)


def kind(opaque: bool) -> type[Expression]:
    """The kind of symbols to build with: MX for operations that scalar expressions cannot hold, else SX."""
    return cast(type[Expression], ca.MX) if opaque else ca.SX


def column(parts: Sequence[Matrix]) -> Matrix:
    """Return the parts in one column; without parts an empty column of numbers, which mixes with every kind."""
    empty: object = ca.DM(0, 1)
    return ca.vertcat(*parts) if parts else cast(Matrix, empty)


def is_finite(value: Matrix) -> Matrix:
    """Return 1 where every entry is a finite number, else 0. fmax and fmin would hide NaN."""
    return ca.mmin(ca.fabs(ca.vec(value)) <= FINITE)


def nan_where(failed: Expression) -> Expression:
    """Return NaN where a condition (1 or 0) holds, and zero elsewhere.

    It is computed, because the constant NaN in a loop is the mark of an open number that was lost. Its derivative is zero where
    the condition does not hold, so it spoils no gradient there.
    """
    return ca.asin(2 * failed)


def total(terms: Iterable[Expression]) -> Expression:
    """Return the sum of the terms; the number 0 where there are none."""
    return cast(Expression, sum(terms))


def holds_nan(function: ca.Function) -> bool:
    """Whether a Function, or one that it calls, holds the constant NaN."""
    for f in (function, *function.find_functions()):
        scalar = f.is_a("SXFunction")
        for k in range(f.n_instructions() if scalar or f.is_a("MXFunction") else 0):
            if f.instruction_id(k) == ca.OP_CONST:
                value = f.instruction_constant(k) if scalar else f.instruction_MX(k).to_DM().full()
                if np.isnan(value).any():
                    return True
    return False


SMOOTHING = 1e-6  # half width, in the unit of the argument, within which the power is rounded off around zero


def signed_power(d: Expression, exponent: Expression | float) -> Expression:
    """Return sign(d) |d|^exponent, rounded off within 1e-6 of zero so that its derivatives stay finite.

    Computed as d (d^2 + 1e-12)^((exponent - 1)/2).
    """
    return d * ca.exp((exponent - 1) / 2 * ca.log(d * d + SMOOTHING**2))


def power(base: T, exponent: int) -> T | float:
    """Return base^exponent as a product, because the pow of Python and that of CasADi differ in the last digit; 1.0 for 0."""
    return math.prod([base] * (exponent - 1), start=base) if exponent else 1.0  # type: ignore[call-overload]


def left_after(period: float, time: float) -> float:
    """Return e^(-T / tau), the share of a distance that is left after a period; 0 for the time constant 0."""
    return ca.exp(-period / ca.fmax(time, TINY))


def left_in_mean(period: float, time: float) -> float:
    """Return the mean of what is left over a period, (tau / T) (1 - e^(-T / tau)); 0 for tau = 0."""
    return time / period * -ca.expm1(-period / ca.fmax(time, TINY))
