"""One call of the iteration with limits: the problem, the settings, and the call's arguments."""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca

from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.sweep import Expansion
from fpirhc.optimisers.bounds import Limited
from fpirhc.optimisers.certified import Certified, certified
from fpirhc.optimisers.limited_settings import LimitedSettings
from fpirhc.optimisers.scales import Scales, scales


@dataclass(frozen=True, eq=False)
class Call:
    """What all parts of a turn read.

    Args:
        ocp: the problem.
        settings: of the iteration.
        s0: the first state, shape (ns,).
        data: shape (ntheta, N + 1).
        lower: lower limits of the inputs, shape (nu,).
        upper: upper limits of the inputs, shape (nu,).
    """

    ocp: OptimalControl
    settings: LimitedSettings
    s0: ca.MX
    data: ca.MX
    lower: ca.MX
    upper: ca.MX
    scales: Scales = field(init=False)
    limits: Limited = field(init=False)
    spread: ca.DM = field(init=False)  # units of the states, shape (ns, N)

    def __post_init__(self) -> None:
        units = scales(self.ocp)
        object.__setattr__(self, "scales", units)
        object.__setattr__(self, "limits", Limited(self.ocp, units, self.lower, self.upper))
        object.__setattr__(self, "spread", ca.repmat(ca.DM(units.states), 1, self.ocp.stages))

    def certified(self, p: Expansion, z: ca.MX) -> Certified:
        """Return how far a plan with multipliers z is from the first-order conditions."""
        return certified(self.ocp, self.limits, self.scales, p, z)

    def is_done(self, c: Certified) -> ca.MX:
        """Whether a plan meets the first-order conditions to the tolerances."""
        t = self.settings
        feasible = ca.logic_and(c.broken <= t.feasible, c.error <= t.scaled_tolerance(self.scales))
        return ca.logic_and(c.left <= t.tolerance, feasible)
