"""A controller that is told the exact parameters: the bound that no controller with a wrong model can beat."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.deformation.base import Deformation
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.task.problem import Problem


@dataclass(frozen=True)
class ExactModel(Controller):
    """The wrapped controller, believing the plant's exact parameters."""

    controller: Controller

    @property
    def inner(self) -> Controller:
        """The wrapped controller."""
        return self.controller

    @property
    def deformation(self) -> Deformation:
        """The wrapped controller's."""
        return self.controller.deformation

    def inner_problem(self, problem: Problem) -> Problem:
        """The problem as one sees it who knows the plant: what is prepared before a run has the exact parameters too."""
        exact = {name: replace(p, approximate=p.exact) for name, p in problem.plant.parameters.items()}
        return replace(problem, plant=replace(problem.plant, parameters=exact))

    def linear_around(self, inner: Controller) -> Controller:
        """The wrapped one: what is believed is given beside."""
        return inner

    def parameters(self, plant: Plant) -> np.ndarray:
        """The exact parameters."""
        return plant.exact

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        """Blocks of the wrapped controller."""
        return self.controller.blocks(self.inner_problem(problem))


def examples(inner: Controller) -> tuple[Controller, ...]:
    """Values for the laws, around any controller."""
    return (ExactModel(inner),)
