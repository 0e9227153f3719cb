"""The exponential mean of signs that the tuner and the guard listen to."""

from __future__ import annotations

import casadi as ca

from fpirhc.symbolic.layout import Expression

FORGETTING = 0.1  # share of the newest sign


def forget(before: Expression, sign: Expression) -> Expression:
    """Return (1 - eta) before + eta sign; what is not a number is forgotten."""
    mean = (1 - FORGETTING) * before + FORGETTING * sign
    return ca.if_else(ca.fabs(mean) <= 1, mean, 0)
