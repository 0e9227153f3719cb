"""What the line search of `FixedPoint` works on, and its numbers."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

SHARE = 0.95  # gamma L, and the share of the guaranteed decrease that is required
ARMIJO = 1e-2  # share of the first-order decrease that is required of a short step
SHORTER = 0.25  # factor of the step after a plan that did not decrease the envelope
DRAWN_IN = 0.01  # least factor of gamma after a plain step that was rejected
SHORTEST = 0.05  # below it the plain fixed-point step is taken
ROUNDING = 1e-13  # relative to the cost: smaller differences are rounding
UNTRIED = 1e299  # a cost from which on an anchor counts as not evaluated


class Arguments(NamedTuple):
    """The arguments of one call."""

    s0: ca.MX
    data: ca.MX
    lower: ca.MX
    upper: ca.MX


class Anchor(NamedTuple):
    """The best plan so far, the next step from it, and the step's length."""

    inputs: ca.MX  # U (nu, N)
    states: ca.MX  # X (ns, N)
    move: ca.MX  # v (nu, N)
    gains: ca.MX  # K (nu, ns N)
    plain: ca.MX  # T (nu, N)
    slope: ca.MX  # g (nu, N)
    value: ca.MX  # V
    envelope: ca.MX  # phi
    step: ca.MX  # tau; below SHORTEST the next plan is T
    gamma: ca.MX
    resume: ca.MX  # tau after the evaluation of a remembered plan


class Expanded(NamedTuple):
    """A plan that was tried, expanded."""

    inputs: ca.MX
    states: ca.MX  # (ns, N + 1)
    a: ca.MX
    b: ca.MX
    by_state: ca.MX
    by_input: ca.MX
    costates: ca.MX  # (ns, N), of s_1 ... s_N
    accepted: ca.MX
