"""A controller that is told the exact parameters: the bound that no controller with a wrong model can beat."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.base import Controller, Response
from fpirhc.deformation.base import Deformation
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.task.problem import Problem


@dataclass(frozen=True)
class ExactModel(Controller):
    """The wrapped controller, believing the plant's exact parameters."""

    controller: Controller

    @property
    def adaptive(self) -> Deformation:
        """The wrapped controller's deformation."""
        return self.controller.adaptive

    def parameters(self, plant: Plant) -> np.ndarray:
        """The exact parameters."""
        return plant.exact

    def resolved(self, problem: Problem) -> ExactModel:
        """Return the wrapped controller resolved."""
        return replace(self, controller=self.controller.resolved(_told(problem)))

    def response(self, problem: Problem) -> Response | None:
        """The wrapped controller's."""
        return self.controller.response(_told(problem))

    def notes(self, problem: Problem) -> tuple[str, ...]:
        """The wrapped controller's."""
        return self.controller.notes(_told(problem))

    def check(self, problem: Problem) -> None:
        """Raise what the wrapped controller raises."""
        self.controller.check(_told(problem))

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        """Blocks of the wrapped controller."""
        return self.controller.blocks(_told(problem))


def _told(problem: Problem) -> Problem:
    """The problem as one sees it who knows the plant: what is prepared before a run has the exact parameters too."""
    exact = {name: replace(p, approximate=p.exact) for name, p in problem.plant.parameters.items()}
    return replace(problem, plant=replace(problem.plant, parameters=exact))


def examples(inner: Controller) -> tuple[Controller, ...]:
    """Values for the laws, around any controller."""
    return (ExactModel(inner),)
