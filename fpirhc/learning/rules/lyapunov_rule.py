"""The classical rule: along the gradient that makes the controller's Lyapunov function fall."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import Positive
from fpirhc.learning.rules.base import Bounds, Evidence, Rule
from fpirhc.symbolic.layout import Expression


@dataclass(frozen=True, eq=False)
class LyapunovRule(Rule):
    """p_hat' = Gamma G^T w with the G and w of the controller, Gamma diagonal; Euler's step once per cycle.

    It does not act while the command is clipped, because the gradient assumes the unclipped command.

    Args:
        gains: diagonal of Gamma by parameter, squared unit of the parameter per unit of w^T G p and second.
    """

    gains: Mapping[str, Positive]

    reads_response = False

    def check(self, bounds: Bounds) -> None:
        """Raise if the names differ.

        Raises:
            InvalidValue: a parameter without gain, or a gain without parameter.
        """
        odd = sorted(set(self.gains) ^ set(bounds))
        if odd:
            raise InvalidValue(
                f"LyapunovRule: gains and bounds must name the same parameters; only one names '{odd[0]}'"
            )

    def change(self, evidence: Evidence, bounds: Bounds, period: float) -> Expression:
        """Return period Gamma G^T w."""
        matrix, along = evidence.gradient()
        gains = ca.vertcat(*(self.gains[name] for name in bounds))
        return (1 - evidence.clipped) * period * gains * ca.mtimes(matrix.T, along)


EXAMPLES = (LyapunovRule({"m": 1e2}),)
