"""The evidence from which wrappers adjust a gain: the mean of signs, and errors that alternate and grow."""

from __future__ import annotations

import casadi as ca

from fpirhc.symbolic.layout import Expression

FORGETTING = 0.1  # share of the newest sign
RETURNED = 0.3  # relative distance below which an error counts as equal to the error of two cycles before


def forget(before: Expression, sign: Expression) -> Expression:
    """Return (1 - eta) before + eta sign, and zero where this is not a number."""
    mean = (1 - FORGETTING) * before + FORGETTING * sign
    return ca.if_else(ca.fabs(mean) <= 1, mean, 0)


def growing_in_a_row(count: Expression, error: Expression, before: Expression) -> Expression:
    """Return how many errors in a row alternated in sign and grew; zero when the newest did not."""
    grows = ca.logic_and(ca.dot(error, before) < 0, ca.sumsqr(error) > ca.sumsqr(before))
    return ca.if_else(grows, count + 1, 0)


def returning_in_a_row(count: Expression, error: Expression, before: Expression, earlier: Expression) -> Expression:
    """Return how many errors in a row alternated in sign and were equal to the error of two cycles before: a two-cycle.

    Saturated two-cycles neither grow nor die out. Errors of white noise are not equal in this way eight times in a row.
    """
    back = ca.sumsqr(error - earlier) < RETURNED**2 * ca.sumsqr(error)
    return ca.if_else(ca.logic_and(ca.dot(error, before) < 0, back), count + 1, 0)
