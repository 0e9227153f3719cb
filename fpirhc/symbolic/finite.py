"""Whether every entry of a column is a finite number.

A graph of calls passes over a long column several times to find out; its driver in C passes once, with eight independent sums,
which compilers vectorise:

    2^27 x - 2^27 x  is zero for |x| <= largest double / 2^27, and NaN beyond it, for infinity, and for NaN.
"""

from __future__ import annotations

from functools import cache

import casadi as ca

from fpirhc.symbolic.driver import SIGNATURE, Driver, with_driver
from fpirhc.symbolic.expression import FINITE, Expression, graph

_TEXT = f"""
int ENTRY{SIGNATURE} {{
  casadi_real sums[8] = {{0, 0, 0, 0, 0, 0, 0, 0}}, total = 0;
  const casadi_real large = 134217728;
  const casadi_real* x = arg[0];
  int k = 0, j;
  for (; k + 8 <= SIZE; k += 8)
    for (j = 0; j < 8; ++j) sums[j] += x[k + j] * large - x[k + j] * large;
  for (; k < SIZE; ++k) total += x[k] * large - x[k] * large;
  for (j = 0; j < 8; ++j) total += sums[j];
  if (res[0]) res[0][0] = total == 0;
  return 0;
}}
"""

_KEPT = f"""
int ENTRY{SIGNATURE} {{
  casadi_real sums[8] = {{0, 0, 0, 0, 0, 0, 0, 0}}, total = 0;
  const casadi_real large = 134217728;
  const casadi_real *x = arg[0], *old = arg[1];
  casadi_real* kept = res[0];
  int k = 0, j;
  for (; k + 8 <= SIZE; k += 8)
    for (j = 0; j < 8; ++j) {{ kept[k + j] = x[k + j]; sums[j] += x[k + j] * large - x[k + j] * large; }}
  for (; k < SIZE; ++k) {{ kept[k] = x[k]; total += x[k] * large - x[k] * large; }}
  for (j = 0; j < 8; ++j) total += sums[j];
  if (res[1]) res[1][0] = total == 0;
  if (!(total == 0 && arg[2][0]))
    for (k = 0; k < SIZE; ++k) kept[k] = old[k];
  return 0;
}}
"""


def finite(column: Expression, *, opaque: bool) -> Expression:
    """Return 1 where every entry of the column is finite, else 0; `opaque` is that of the block."""
    return _function(graph(column).numel())(column) if opaque else every_finite(column)


def every_finite(column: Expression) -> Expression:
    """Return the same in scalar code: a sum is not finite where a summand is not. A tree of sums is not a chain of waits."""
    parts = ca.vertsplit(column)
    while len(parts) > 1:
        pairs = [a + b for a, b in zip(parts[::2], parts[1::2], strict=False)]
        parts = [*pairs, parts[-1]] if len(parts) % 2 else pairs
    return ca.fabs(parts[0]) <= FINITE


def kept_if_finite(new: Expression, old: Expression, good: Expression) -> tuple[Expression, Expression]:
    """Return (new where it is good and finite, else old; whether new is finite) of columns of a graph; C passes over them once."""
    kept, fine = _kept(graph(new).numel())(new, old, good)
    return kept, fine


@cache
def _kept(size: int) -> ca.Function:
    new, old, good = ca.MX.sym("new", size), ca.MX.sym("old", size), ca.MX.sym("good")
    driver = Driver(_KEPT, {}, {"SIZE": size})
    fine = ca.mmin(ca.fabs(new) <= FINITE)
    kept = ca.if_else(ca.logic_and(good, fine), new, old)
    return with_driver("fpirhc_kept", driver, lambda name: ca.Function(name, [new, old, good], [kept, fine]))


@cache
def _function(size: int) -> ca.Function:
    column = ca.MX.sym("column", size)
    driver = Driver(_TEXT, {}, {"SIZE": size})
    every = ca.mmin(ca.fabs(column) <= FINITE)
    return with_driver("fpirhc_finite", driver, lambda name: ca.Function(name, [column], [every]))
