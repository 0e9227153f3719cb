"""The classical rule: along the gradient that makes the controller's Lyapunov function fall."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.errors import InvalidValue
from fpirhc.learning.rules.base import Bounds, Evidence, Rule
from fpirhc.symbolic.functions import numbers
from fpirhc.symbolic.layout import Expression


@dataclass(frozen=True, eq=False)
class LyapunovRule(Rule):
    """p_hat' = Gamma G^T w with the G and w of the controller, Gamma diagonal; Euler's step once per cycle.

    It does not act while the command is clipped, because the gradient assumes the unclipped command.

    Args:
        gains: diagonal of Gamma by parameter, squared unit of the parameter per unit of w^T G p and second.

    Raises:
        InvalidValue: a gain that is not positive; when the loop is built, gains and bounds of different parameters.
    """

    gains: Mapping[str, float]

    def __post_init__(self) -> None:
        for name, gain in self.gains.items():
            if not (math.isfinite(gain) and gain > 0):
                raise InvalidValue(f"LyapunovRule(gains={{'{name}': {gain!r}}}): expected a positive number")

    @property
    def reads_response(self) -> bool:
        return False

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
        gains = numbers([self.gains[name] for name in bounds])
        return (1 - evidence.clipped) * period * gains * ca.mtimes(matrix.T, along)


EXAMPLES = (LyapunovRule({"m": 1e2}),)
