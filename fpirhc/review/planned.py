"""Whether a plan is in the loop."""

from __future__ import annotations

from fpirhc.controllers.base import Controller


def is_planned(controller: Controller) -> bool:
    """Whether the controller plans over a horizon that it restarts from the measured state."""
    while controller.inner is not None:
        controller = controller.inner
    return controller.planner is not None and controller.planner.restarts
