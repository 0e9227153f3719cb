"""Learning from the equation of the fixed-point iteration: projection onto the parameters that explain the last response."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import casadi as ca

from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import NotNegative, Range
from fpirhc.learning.rules.base import Bounds, Evidence, Rule
from fpirhc.symbolic.layout import Expression

_RELATIVE = 1e-9  # of the diagonal of the matrix that is inverted: a response without information changes nothing


_CONVERGENT = Range("a number between 0 and 2, both excluded", lambda v: 0 < v < 2)


@dataclass(frozen=True)
class Projection(Rule):
    """p_hat+ = p_hat + gamma W G^T (G W G^T + eps I)^-1 h, gated; h = G (p - p_hat) is the response error of the model.

    With exact data every step shrinks |W^(-1/2) (p - p_hat)| for 0 < gamma < 2, with or without excitation (Kaczmarz; normalised
    least mean squares). W is diagonal, the squared widths of the parameters' bounds, and each response is divided by its own size,
    so that units do not matter. Unlike a gradient of tracking errors it also learns while a deformation keeps these errors small,
    and while the command is clipped. A changing estimate is itself a disturbance, and noise of the response acts like a wrong
    model: choose gamma well below 1, and a dead zone above the noise.

    Args:
        gain: gamma, between 0 and 2.
        dead_zone: |h| = sqrt(sum h_k^2) below which the estimate stays, with every h_k in the unit of its response; where these are
            several, the one with the largest numbers decides. Above it the step grows as (|h| - dead_zone) / |h|.

    References:
        G. C. Goodwin, K. S. Sin, Adaptive Filtering, Prediction and Control, Prentice-Hall 1984, ch. 3 (projection, dead zone).
    """

    gain: Annotated[float, _CONVERGENT]
    dead_zone: NotNegative = 0.0

    reads_response = True

    def check(self, bounds: Bounds) -> None:
        """Raise if a bound is infinite.

        Raises:
            InvalidValue: with the name of the parameter.
        """
        for name, (lower, upper) in bounds.items():
            if not math.isfinite(upper - lower):
                raise InvalidValue(
                    f"Projection: '{name}' needs finite bounds, which scale it; got ({lower:g}, {upper:g})"
                )

    def change(self, evidence: Evidence, bounds: Bounds, period: float) -> Expression:
        del period
        matrix, error = evidence.equation()
        widths = ca.DM([(upper - lower) ** 2 for lower, upper in bounds.values()])
        size = ca.sqrt(ca.sumsqr(error))
        share = self.gain * ca.fmax(size - self.dead_zone, 0) / (size + (size <= 0))
        # Every response by its own size: they have units of their own.
        sizes = ca.sqrt(ca.mtimes(matrix**2, widths))
        sizes += sizes <= 0
        matrix = matrix / ca.repmat(sizes, 1, widths.numel())
        spread = ca.mtimes(matrix, ca.diag(widths))
        square = ca.mtimes(spread, matrix.T) + _RELATIVE * ca.DM.eye(error.numel())
        return share * ca.mtimes(spread.T, ca.solve(square, error / sizes))


EXAMPLES = (Projection(gain=0.02), Projection(gain=0.5, dead_zone=0.1))
