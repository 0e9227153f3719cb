"""The block of believed states: from raw measurements and the own commands to 'state' and 'realised'.

    model predicts -> what no sensor shows is taken from the prediction -> estimator -> belief corrects

The response is the estimator's, from what is measured; controllers that learn from it are refused where it would be the model's.
The state has each entry from where it is known best: believed entries from the belief, the others from the estimator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.controllers.contract import Controller
from fpirhc.controllers.observed import check_observed
from fpirhc.deformation.queue import Queue
from fpirhc.errors import NotSupported
from fpirhc.plant.integrators import Integrator, RungeKutta4
from fpirhc.sensing.base import response_names
from fpirhc.sensing.belief import Belief, Evidence, Model
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.problem import Problem

_COMMANDED, _COUNT, _QUEUE = "_commanded", "belief_cycles", "belief_commands"
_WHOLE = 1e-6  # a fraction of a cycle below this counts as zero


@dataclass(frozen=True, eq=False)
class Believing:
    """The block that believes, and what it remembers.

    Args:
        problem: whose sensing has a belief.
        raw: signal of the raw measurements.
        start: first state that the sensors see, shape (nx,).
    """

    problem: Problem
    raw: Signal
    start: np.ndarray

    @property
    def block(self) -> Block:
        """Block (raw measurements, parameters, last command) -> (state, realised)."""
        plant = self.problem.plant
        reads = Layout((self.raw, plant.parameter, self._commanded))
        writes = Layout((plant.state, plant.response_signal("realised")))
        own = Layout((scalar(_COUNT), *self._queued, *self.belief.memory(self.model).signals))
        return Block("believe", reads, writes, self._step, own + self._estimator.memory)

    @property
    def delay(self) -> Delay:
        """The last command, carried to the next cycle."""
        return Delay(self._commanded, self.problem.plant.input.name)

    @property
    def belief(self) -> Belief:
        """How states that no sensor shows are believed."""
        belief = self.problem.sensing.belief
        assert belief is not None
        return belief

    @cached_property
    def model(self) -> Model:
        """What the belief is built from."""
        plant = self.problem.plant
        advance = believed_integrator(self.problem).step(plant, self.problem.period)
        return Model(plant, advance, self.start, self.problem.sensing.measures(plant))

    @cached_property
    def _estimator(self) -> Block:
        plant, sensing = self.problem.plant, self.problem.sensing
        completed = Signal("_completed", sensing.estimator.measures(plant))
        return sensing.estimator.block(plant, self.problem.period, self.start, completed)

    @property
    def _commanded(self) -> Signal:
        inputs = self.problem.plant.input
        return Signal(_COMMANDED, inputs.elements, inputs.units, tuple(map(float, self.problem.inputs_before)))

    @property
    def _late(self) -> int:
        return round(self.problem.dead_time.measurement / self.problem.period)

    @property
    def _queue(self) -> Queue:
        """Queue of the commands: the newest one is that of the last cycle, and acts on the sample's cycle after all dead times."""
        inputs, period = self.problem.dead_time.inputs, self.problem.period
        return Queue(tuple(inputs.get(name, 0.0) / period + self._late for name in self.problem.plant.inputs))

    @property
    def _queued(self) -> tuple[Signal, ...]:
        elements, length = self._commanded.elements, self._queue.length
        names = tuple(f"{e}@{k}" for k in range(1, length) for e in elements)
        return (Signal(_QUEUE, names, start=self._commanded.start * (length - 1)),) if length > 1 else ()

    def _step(self, s: Signals) -> dict[str, Expression]:
        plant, late = self.problem.plant, self._late
        sensing, queue = self.problem.sensing, self._queue
        shown = dict(zip(self.raw.elements, ca.vertsplit(getattr(s, self.raw.name)), strict=True))
        commands, newest, size = self._commands(s), getattr(s, _COMMANDED), plant.input.size
        column = ca.vertcat(newest, commands) if queue.length > 1 else newest
        memory = {m: getattr(s, m) for m in self.belief.memory(self.model).names}
        count = getattr(s, _COUNT)
        told = Evidence(shown, {}, queue.delayed(column, size), s.parameters, count > late + 0.5, count > late - 0.5)
        predicted = self.belief.predict(self.model)(told, memory)
        response = plant.controlled_response_function(predicted, told.command, s.parameters)
        expected = ca.vertsplit(ca.vertcat(predicted, response))
        seen = dict(zip(plant.state.elements + response_names(plant), expected, strict=True)) | shown
        estimated, realised, *remembered = self._estimates(s, seen)
        by_estimator = dict(zip(plant.state.elements, ca.vertsplit(estimated), strict=True))
        known = {e: by_estimator[e] for e in sensing.known(plant)}
        correct = self.belief.correct(self.model)
        state, next_memory = correct(Evidence(**{**vars(told), "known": known}), memory, predicted)
        believed = dict(zip(plant.state.elements, ca.vertsplit(state), strict=True))
        chosen = by_estimator | {e: believed[e] for e in self.belief.believes(plant, sensing.known(plant))}
        results = {"state": ca.vertcat(*(chosen[e] for e in plant.state.elements)), "realised": realised}
        results |= {f"{m}_next": v for m, v in next_memory.items()}
        results |= {f"{m.name}_next": v for m, v in zip(self._estimator.memory.signals, remembered, strict=True)}
        if queue.length > 1:
            results[f"{_QUEUE}_next"] = queue.pushed(commands, newest)[: size * (queue.length - 1)]
        return {**results, f"{_COUNT}_next": ca.fmin(count + 1, late + 1)}

    def _commands(self, s: Signals) -> Expression:
        return getattr(s, _QUEUE) if self._queued else getattr(s, _COMMANDED)

    def _estimates(self, s: Signals, seen: Mapping[str, Expression]) -> tuple[Expression, ...]:
        """State, response and memory of the estimator."""
        names = self.problem.sensing.estimator.measures(self.problem.plant)
        completed = ca.vertcat(*(seen[n] for n in names))
        results = self._estimator.function(completed, *(getattr(s, m) for m in self._estimator.memory.names))
        return tuple(results)


def believed_integrator(problem: Problem) -> Integrator:
    """Return the integrator of the model: the problem's, or a Runge-Kutta step where that is a call without Jacobian."""
    return RungeKutta4() if problem.integrator.opaque else problem.integrator


def check_believed(problem: Problem, controller: Controller) -> None:
    """Raise if a controller cannot be given believed states, or the belief cannot be right.

    Raises:
        NotSupported: an adaptive controller whose response nobody measures; a measurement that is late by a fraction of a cycle;
            a model with other parameters than the problem's; errors that are neither observed nor decay.
    """
    sensing, plant = problem.sensing, problem.plant
    if sensing.belief is None:
        return
    lost = sensing.believed_response(plant)
    if lost and controller.deformation.adapts:
        raise NotSupported(
            f"the response that {type(controller.deformation).__name__} compares needs {', '.join(lost)}, which no sensor shows: "
            "the model's own response is the request, from which nothing can be learned. Measure it, or choose an estimator of "
            f"what is measured ({', '.join(sensing.measures(plant))})"
        )
    late = problem.dead_time.measurement / problem.period
    if abs(late - round(late)) > _WHOLE:
        raise NotSupported(
            f"believed states need a measurement that is late by whole cycles, and {problem.dead_time.measurement:g} "
            f"{problem.time_unit} are {late:.4g} cycles; use {round(late) * problem.period:g} {problem.time_unit}"
        )
    model = controller.model_plant(problem)
    if model.parameter.elements != plant.parameter.elements:
        raise NotSupported(
            f"{type(controller).__name__} has a model with other parameters than the problem's, and states are believed by the "
            "problem's; leave the belief out, or give both the same parameters"
        )
    check_observed(problem)
