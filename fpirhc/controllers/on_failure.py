"""What a receding-horizon controller does when a solve fails (infeasible, or not finite): a stated policy.

A solve that merely ran out of iterations is counted as such and used: its plan is feasible and finite.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import casadi as ca

from fpirhc.status import Status
from fpirhc.symbolic.layout import Expression


class OnFailure(ABC):
    """Contract: the input to apply when the solve failed, and the status to report."""

    @abstractmethod
    def choose(
        self, failed: Expression, planned: Expression, feedforward: Expression, status: Expression
    ) -> tuple[Expression, Expression]:
        """Return (input, status) from the plan's first input and the model's feedforward along the reference."""


@dataclass(frozen=True)
class HoldPlan(OnFailure):
    """Keep using the last good plan, shifted."""

    def choose(
        self, failed: Expression, planned: Expression, feedforward: Expression, status: Expression
    ) -> tuple[Expression, Expression]:
        """The optimiser already returns its last good plan when it fails."""
        del feedforward
        return planned, ca.if_else(failed, int(Status.HELD), status)


@dataclass(frozen=True)
class Feedforward(OnFailure):
    """Apply what the model needs along the reference, without feedback from the plan."""

    def choose(
        self, failed: Expression, planned: Expression, feedforward: Expression, status: Expression
    ) -> tuple[Expression, Expression]:
        """Replace the plan by the feedforward."""
        return ca.if_else(failed, feedforward, planned), ca.if_else(failed, int(Status.HELD), status)


@dataclass(frozen=True)
class StopRun(OnFailure):
    """Stop: the planned input becomes NaN, which holds the last command and ends the run with this status."""

    def choose(
        self, failed: Expression, planned: Expression, feedforward: Expression, status: Expression
    ) -> tuple[Expression, Expression]:
        """Make the failure visible as NaN."""
        del feedforward
        return ca.if_else(failed, math.nan, planned), status
