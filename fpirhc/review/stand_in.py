"""The controller that acts on a linear plant as another controller acts near the reference.

A controller without a plan stands for itself. A plan that restarts from the measured state is a feedback of the state. A plan that
starts from its own state leaves the motion to its tracking law. A wrapper that changes the model alone is
what it wraps: its parameters are those of the start.
"""

from __future__ import annotations

from dataclasses import dataclass

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import Planner
from fpirhc.controllers.tracked import tracked_blocks
from fpirhc.deformation.base import Deformation, with_inner
from fpirhc.errors import NotSupported
from fpirhc.review.plan_feedback import PlanFeedback
from fpirhc.symbolic.block import Block, Delay
from fpirhc.task.problem import Problem, cycles_per_stage
from fpirhc.tracking.base import Tracking


@dataclass(frozen=True)
class StandIn(Controller):
    """A law in place of a plan, with the plan's deformation.

    Args:
        tracking: the law.
        deformation: the deformation.
    """

    tracking: Tracking
    deformation: Deformation

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        """Blocks reference, tracking, deform, invert, limit, judge, tracking update."""
        return tracked_blocks(problem, self.tracking, self.deformation)


def linear_stand_in(problem: Problem, controller: Controller) -> tuple[Controller, Planner | None]:
    """Return the stand-in of a controller on a linear plant, and the plan whose feedback it needs.

    Args:
        problem: the problem, with the horizon and the cost of the plan.
        controller: the controller.

    Raises:
        NotSupported: a plan that is restarted and tracked.
    """
    if controller.inner is not None:
        inner, planner = linear_stand_in(problem, controller.inner)
        own = set(controller.feeds) - set(controller.inner.feeds)
        changes_model = own <= {"parameters"} and controller.deforms == controller.inner.deforms
        return inner if changes_model else with_inner(controller, inner), planner
    planner = controller.planner
    if planner is None:
        return controller, None
    if planner.restarts and planner.tracking is None:
        return StandIn(PlanFeedback(_cycles_before(problem, planner)), controller.deformation), planner
    if planner.tracking is not None and not planner.restarts:
        return StandIn(planner.tracking, controller.deformation), None
    raise NotSupported("a plan that is restarted and tracked is not constant near the reference")


def is_planned(controller: Controller) -> bool:
    """Whether the controller plans over a horizon that it restarts from the measured state."""
    while controller.inner is not None:
        controller = controller.inner
    return controller.planner is not None and controller.planner.restarts


def _cycles_before(problem: Problem, planner: Planner) -> int:
    """Control cycles of one stage where the plan weighs the change of its inputs, else 0."""
    cost = planner.cost or problem.cost
    if problem.horizon is None or cost is None or not cost.uses_rate:
        return 0
    return cycles_per_stage(problem.horizon, problem.period)
