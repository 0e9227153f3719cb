"""Policies of a receding-horizon controller for a solve that fails: infeasible, or not finite.

The plan of a solve that only ran out of iterations is used, because it is feasible and finite; the status records it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import casadi as ca

from fpirhc.fields.checked import Checked
from fpirhc.status import Status
from fpirhc.symbolic.functions import nan_where
from fpirhc.symbolic.layout import Expression

STOPPED = "stopped"  # signal of a policy that stops: NaN where it does, which ends a run by this name


class OnFailure(Checked, ABC):
    """Contract: the input to apply when the solve failed, and the status to report."""

    @property
    def uses_feedforward(self) -> bool:
        """Whether the input that the model needs along the reference is applied; False by default."""
        return False

    @property
    def stops(self) -> bool:
        """Whether a failed solve ends the run; False by default."""
        return False

    @abstractmethod
    def choose(
        self, failed: Expression, planned: Expression, feedforward: Expression, status: Expression
    ) -> tuple[Expression, Expression]:
        """Return (input, status).

        Args:
            failed: whether the solve failed, a scalar expression.
            planned: first input of the plan.
            feedforward: input that the model needs along the reference.
            status: of the solve.
        """


@dataclass(frozen=True)
class HoldPlan(OnFailure):
    """Use the plan that the optimiser returns where it fails, with the status HELD.

    Where a horizon cannot be kept, `FixedPoint` returns a plan of least violation; where nothing is finite, every optimiser returns
    its remembered plan, shifted.
    """

    def choose(
        self, failed: Expression, planned: Expression, feedforward: Expression, status: Expression
    ) -> tuple[Expression, Expression]:
        """Return the plan that the optimiser returns."""
        del feedforward
        return planned, ca.if_else(failed, int(Status.HELD), status)


@dataclass(frozen=True)
class Feedforward(OnFailure):
    """Apply the input that the model needs along the reference, without feedback from the plan."""

    @property
    def uses_feedforward(self) -> bool:
        """Whether the feedforward is applied: it is."""
        return True

    def choose(
        self, failed: Expression, planned: Expression, feedforward: Expression, status: Expression
    ) -> tuple[Expression, Expression]:
        """Return the feedforward in place of the plan."""
        return ca.if_else(failed, feedforward, planned), ca.if_else(failed, int(Status.HELD), status)


@dataclass(frozen=True)
class StopRun(OnFailure):
    """Stop: the planned input becomes NaN, which holds the last command and ends the run with this status."""

    @property
    def stops(self) -> bool:
        """True: a failed solve ends the run."""
        return True

    def choose(
        self, failed: Expression, planned: Expression, feedforward: Expression, status: Expression
    ) -> tuple[Expression, Expression]:
        """Return NaN in place of the plan."""
        del feedforward
        return ca.if_else(failed, nan_where(failed), planned), status
