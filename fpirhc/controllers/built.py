"""A controller built for a problem: everything automatic is chosen and everything is checked once, at `build`.

    build(problem, controller) -> Built -> blocks(built) -> one step, from what is measured to the command

Blocks are handed the result. They read facts from it, and look nothing up again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca

from fpirhc.controllers.check import checked
from fpirhc.controllers.contract import Controller, PlantModel, Response, given_response
from fpirhc.controllers.path import Path, Told, believed_path
from fpirhc.controllers.reference_states import given_signals, largest_response, motion_of, own_signals
from fpirhc.controllers.seeing import given_states, raw_signal
from fpirhc.deformation.base import Deformation
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.driver import plans_are_compiled
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Signal
from fpirhc.task.problem import Problem, cycles_per_plan


@dataclass(frozen=True, eq=False)
class Built:
    """What blocks are made from."""

    problem: Problem  # as the controller is given it
    controller: Controller  # with every automatic number chosen
    model: PlantModel  # what it knows of its plant
    response: Response | None  # that it is given in place of that of the controlled quantities
    largest: tuple[float, ...]  # response of every controlled quantity that the limits of the inputs allow
    ends: tuple[list[float], list[float]]  # lower and upper limits of the inputs
    before: Signal  # the last command; in the first cycle the input before it
    own: tuple[Signal, ...]  # the reference's own signals
    given: tuple[Signal, ...]  # what is given from outside for it
    motion: ca.Function  # (time, own signals) -> (outputs, response) of the reference
    later: ca.Function  # the same one cycle ahead
    judged: tuple[int, ...]  # places among the outputs of those whose error is logged
    warm_up: float  # number of the first cycle whose response may be used
    raw: Signal | None  # the raw measurements that a step begins with; None where state and response are both measured
    states: tuple[Signal, ...]  # the state, where it is given beside raw measurements of outputs
    planned: Problem | None  # the problem as plans have it, with their cost, margins and limits
    every: int  # control cycles from plan to plan

    @property
    def plant(self) -> Plant:
        """The model, in whose signals blocks are written."""
        return self.problem.plant

    @property
    def period(self) -> float:
        """The control cycle."""
        return self.problem.period

    @property
    def told(self) -> Told:
        """What the model is told of signals from outside."""
        return Told(self.model.plant, self.model.signals, self.period)

    def own_values(self, s: Signals) -> list[Expression]:
        """Return the reference's own signals inside a step."""
        return [getattr(s, signal.name) for signal in self.own]

    def path(self, deformation: Deformation) -> Path:
        """Return the way of the commands to the model, as a deformation believes it."""
        return believed_path(self.problem, deformation)

    def of_plant(self, plant: Plant) -> Built:
        """Return what blocks of another model of the same plant are made from."""
        problem = replace(self.problem, plant=plant)
        return replace(self, problem=problem, largest=largest_response(problem))


_LATEST: Latest[Built] = Latest(8)


def build(problem: Problem, controller: Controller) -> Built:
    """Return the controller built for the problem: the one place where a pair is checked and its automatic numbers are chosen."""
    ready = checked(problem, controller)
    return _LATEST.of((problem, ready), (plans_are_compiled(),), lambda: _built(problem, ready))


def _built(problem: Problem, ready: Controller) -> Built:
    plant = problem.plant
    planned = ready.planner.planned(problem) if ready.planner is not None else None
    return Built(
        problem=problem,
        controller=ready,
        model=ready.plant_model(problem),
        response=given_response(problem, ready),
        largest=largest_response(problem),
        ends=problem.limits.input_ends(plant),
        before=replace(plant.input, name="_command_before", start=tuple(map(float, problem.inputs_before))),
        own=own_signals(problem),
        given=given_signals(problem),
        motion=motion_of(problem),
        later=motion_of(problem, ahead=problem.period),
        judged=tuple(plant.output.elements.index(name) for name in problem.judged_names),
        warm_up=problem.warm_up_cycles,
        raw=raw_signal(problem),
        states=given_states(problem),
        planned=planned,
        every=cycles_per_plan(planned.horizon, problem.period) if planned and planned.horizon else 1,
    )
