"""A filter with m equal poles, (d/dt + a)^m y = a^m w, and its exact motion while w is held.

With z = (y, y', ..., y^(m-1)) and b = (1, 0, ..., 0) the motion under a constant w is

    z(t + h) = w b + Phi(h) (z(t) - w b),      Phi(h) = e^(-a h) sum_{k<m} (h N)^k / k!,      N = A + a I,

where A is the companion matrix of (s + a)^m. N is nilpotent, so that the sum is finite and exact. The highest derivative is

    y^(m) = a^m (w - y) - sum_{0<j<m} binomial(m, j) a^(m-j) y^(j).

The formulas are products and sums, so that they round alike for numbers, live numbers and expressions.

References:
    G. F. Franklin, J. D. Powell, M. L. Workman, Digital Control of Dynamic Systems, 3rd ed., 1998, section 4.3.3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import casadi as ca

from fpirhc.symbolic.functions import exp, power
from fpirhc.symbolic.layout import Expression

Entry = float | Expression  # a number, a live number or an expression


def transition(rate: Entry, time: Entry, order: int) -> list[list[Entry]]:
    """Return Phi(time) row by row, shape (order, order)."""
    nilpotent = _nilpotent(rate, order)
    term, terms = _identity(order), _identity(order)
    for k in range(1, order):
        term = [[entry * time / k for entry in row] for row in _product(term, nilpotent)]
        terms = [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(terms, term, strict=True)]
    decay = _exp(-(rate * time))
    return [[decay * entry for entry in row] for row in terms]


def after_motion(phi: Sequence[Sequence[Entry]], z: Expression, held: Expression) -> Expression:
    """Return z after the motion with the transition Phi while w = `held`."""
    apart = [z[0] - held, *(z[k] for k in range(1, len(phi)))]
    # At rest every difference is exactly zero, and so z stays exactly where it is.
    rows = [sum(entry * a for entry, a in zip(row, apart, strict=True)) for row in phi]
    return ca.vertcat(held + rows[0], *rows[1:])


def highest(rate: Entry, z: Expression, held: Expression, order: int) -> Expression:
    """Return y^(m) for w = `held`."""
    value = power(rate, order) * (held - z[0])
    for j in range(1, order):
        value = value - math.comb(order, j) * power(rate, order - j) * z[j]
    return value


def differences(rate: Entry, step: float, z: Expression, held: Expression, order: int) -> list[Expression]:
    """Return y and its divided forward differences over steps of a map, up to the order m, for w = `held`.

    With the distance d = z - w b they are the first entries of ((Phi(T) - I) / T)^j d.
    """
    phi = transition(rate, step, order)
    apart, values = [z[0] - held, *(z[k] for k in range(1, order))], [z[0]]
    for _ in range(order):
        later = [sum(entry * a for entry, a in zip(row, apart, strict=True)) for row in phi]
        apart = [(after - before) / step for after, before in zip(later, apart, strict=True)]
        values.append(apart[0])
    return values


def _nilpotent(rate: Entry, order: int) -> list[list[Entry]]:
    """N = A + a I."""
    rows: list[list[Entry]] = [[0.0] * order for _ in range(order)]
    for k in range(order):
        if k + 1 < order:
            rows[k][k + 1] = 1.0
        rows[k][k] = rows[k][k] + rate
    for j in range(order):
        rows[-1][j] = rows[-1][j] - math.comb(order, j) * power(rate, order - j)
    return rows


def _identity(order: int) -> list[list[Entry]]:
    return [[1.0 if j == k else 0.0 for j in range(order)] for k in range(order)]


def _product(left: list[list[Entry]], right: list[list[Entry]]) -> list[list[Entry]]:
    columns = list(zip(*right, strict=True))
    return [[sum(a * b for a, b in zip(row, column, strict=True)) for column in columns] for row in left]


def _exp(value: Entry) -> Entry:
    return ca.exp(value) if isinstance(value, ca.SX | ca.MX) else exp(value)
