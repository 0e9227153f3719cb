"""Smooth functions that models often need."""

from __future__ import annotations

import casadi as ca

from fpirhc.symbolic.layout import Expression

SMOOTHING = 1e-6  # half width, in the unit of the argument, within which the power is rounded off around zero


def signed_power(d: Expression, exponent: Expression | float) -> Expression:
    """Return sign(d) |d|^exponent, rounded off within 1e-6 of zero so that its derivatives stay finite.

    Computed as d (d^2 + 1e-12)^((exponent - 1)/2).
    """
    return d * ca.exp((exponent - 1) / 2 * ca.log(d * d + SMOOTHING**2))
