"""A controller that is told the exact parameters: the bound that no controller with a wrong model can beat."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.base import Controller, Response
from fpirhc.deformation.base import Deformation
from fpirhc.plant import Plant
from fpirhc.problem import Problem
from fpirhc.symbolic.block import Block, Delay


@dataclass(frozen=True)
class Informed(Controller):
    """The wrapped controller, believing the plant's exact parameters."""

    controller: Controller

    @property
    def adaptive(self) -> Deformation:
        """The wrapped controller's deformation."""
        return self.controller.adaptive

    def parameters(self, plant: Plant) -> np.ndarray:
        """The exact parameters."""
        return plant.exact

    def resolved(self, problem: Problem) -> Informed:
        """Return the wrapped controller resolved."""
        return replace(self, controller=self.controller.resolved(problem))

    def response(self, problem: Problem) -> Response | None:
        """The wrapped controller's."""
        return self.controller.response(problem)

    def notes(self, problem: Problem) -> tuple[str, ...]:
        """The wrapped controller's."""
        return self.controller.notes(problem)

    def check(self, problem: Problem) -> None:
        """Raise what the wrapped controller raises."""
        self.controller.check(problem)

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        """Blocks of the wrapped controller."""
        return self.controller.blocks(problem)
