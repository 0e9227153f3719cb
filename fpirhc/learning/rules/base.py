"""The contract of adaptation rules: the change of the estimated parameters in one cycle."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fpirhc.fields.checked import Checked
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
