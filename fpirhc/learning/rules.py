"""Rules by which an adaptive controller changes its estimated parameters in one cycle: the contract, and the two of them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated

import casadi as ca

from fpirhc.errors import InvalidValue
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import NotNegative, Positive, Range
from fpirhc.symbolic.layout import Expression

Pair = tuple[Expression, Expression]
Bounds = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Evidence:
    """Data of a rule in one cycle; a rule calls the function of the pair that it uses, so that only this pair is computed."""

    # the controller's Lyapunov function falls along p' = Gamma G^T w: returns (G (n x m), w (n))
    gradient: Callable[[], Pair]
    # the model error h = G (p - p_hat) of the response, exact without disturbances: returns (G (n x m), h (n))
    equation: Callable[[], Pair]
    clipped: Expression  # 1 where the last command was clipped, so that the gradient is wrong


class Rule(Checked, ABC):
    """Contract: a frozen value that changes the estimate."""

    @property
    @abstractmethod
    def reads_response(self) -> bool:
        """Whether the rule uses the equation, which needs the measured response."""

    @abstractmethod
    def check(self, bounds: Bounds) -> None:
        """Raise if the rule does not fit the parameters' bounds.

        Raises:
            InvalidValue: names or intervals that do not fit.
        """

    @abstractmethod
    def change(self, evidence: Evidence, bounds: Bounds, period: float) -> Expression:
        """Return the change of the estimate (m) in one cycle, before the estimate is clipped to its bounds."""


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
            raise InvalidValue(f"LyapunovRule: gains and bounds must name the same parameters; only one has '{odd[0]}'")

    def change(self, evidence: Evidence, bounds: Bounds, period: float) -> Expression:
        """Return period Gamma G^T w."""
        matrix, along = evidence.gradient()
        gains = ca.vertcat(*(self.gains[name] for name in bounds))
        return (1 - evidence.clipped) * period * gains * ca.mtimes(matrix.T, along)


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
                raise InvalidValue(f"Projection: '{name}' needs finite bounds, its scale; got ({lower:g}, {upper:g})")

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


EXAMPLES = (LyapunovRule({"m": 1e2}), Projection(gain=0.02), Projection(gain=0.5, dead_zone=0.1))
