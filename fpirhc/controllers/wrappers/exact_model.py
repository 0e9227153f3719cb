"""A controller with the exact parameters: the bound for every controller with a wrong model."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fpirhc.controllers.base import Controller
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import ControllerWrapper, PlantModel
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.evaluate import Latest
from fpirhc.task.exogenous import really_known, signals_of
from fpirhc.task.problem import Problem


@dataclass(frozen=True)
class ExactModel(ControllerWrapper):
    """The wrapped controller with the exact model: the plant's exact parameters, or the reality where the problem has one.

    Args:
        controller: any controller that uses its model.

    Raises:
        NotSupported: an ExternalPlant, or a reality whose coordinates or orders are not the model's.
    """

    def inner_problem(self, problem: Problem) -> Problem:
        model = self.plant_model(problem)
        plant = _EXACT.of((model.plant,), (), lambda: _known(model.plant))
        return replace(problem, plant=plant, reality=None, signals=signals_of(model.plant, model.signals))

    def plant_model(self, problem: Problem) -> PlantModel:
        plant = problem.moves.as_model(problem.plant)
        return PlantModel(plant, really_known(problem.signals), exact=True)

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return self.controller.blocks(built.inner(self))


_EXACT: Latest[Plant] = Latest(4)  # so that plans of it are built once


def _known(plant: Plant) -> Plant:
    named = {name: replace(one, approximate=one.exact, spread=None) for name, one in plant.parameters.items()}
    return replace(plant, parameters=named)


def examples(inner: Controller) -> tuple[Controller, ...]:
    """Values for the laws, around any controller."""
    return (ExactModel(inner),)
