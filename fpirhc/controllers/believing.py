"""The block of believed states: from raw measurements and the own commands to 'state' and 'realised'.

    model predicts -> what no sensor shows is taken from the prediction -> estimator -> belief corrects

The response is the estimator's, from what is measured; controllers that learn from it are refused where it would be the model's.
The state has each entry from where it is known best: believed entries from the belief, the others from the estimator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.controllers.contract import Controller
from fpirhc.controllers.observed import check_observed
from fpirhc.controllers.outside_block import Told
from fpirhc.deformation.queue import Queue
from fpirhc.errors import NotSupported
from fpirhc.plant.integrators import Integrator, RungeKutta4
from fpirhc.sensing.base import response_names
from fpirhc.sensing.belief import Belief, Evidence, Model
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.outside import told_places
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
        reads = Layout((self.raw, plant.parameter, self._commanded, *self._told.reads))
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
    def _told(self) -> Told:
        """Signals from outside: the model moves with those of the last cycle."""
        return Told(self.problem.plant, self.problem.signals, self.problem.period)

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
        plant, sensing, elements = self.problem.plant, self.problem.sensing, self.problem.plant.state.elements
        told, results = self._evidence(s)
        memory = {m: getattr(s, m) for m in self.belief.memory(self.model).names}
        predicted = self.belief.predict(self.model)(told, memory)
        response = plant.controlled_response_function(predicted, told.command, told.parameters)
        expected = ca.vertsplit(ca.vertcat(predicted, response))
        seen = {**dict(zip(elements + response_names(plant), expected, strict=True)), **told.measured}
        estimated, realised, *remembered = self._estimates(s, seen)
        by_estimator = dict(zip(elements, ca.vertsplit(estimated), strict=True))
        known = {e: by_estimator[e] for e in sensing.known(plant)}
        correct = self.belief.correct(self.model)
        state, next_memory = correct(replace(told, known=known), memory, predicted)
        believed = dict(zip(elements, ca.vertsplit(state), strict=True))
        chosen = by_estimator | {e: believed[e] for e in sensing.believed(plant)}
        results |= {"state": ca.vertcat(*(chosen[e] for e in elements)), "realised": realised}
        results |= {f"{m}_next": v for m, v in next_memory.items()}
        return results | {f"{m.name}_next": v for m, v in zip(self._estimator.memory.signals, remembered, strict=True)}

    def _evidence(self, s: Signals) -> tuple[Evidence, dict[str, Expression]]:
        """What the belief is told, with no state known yet, and what is remembered for the next cycle."""
        late, queue, newest, size = self._late, self._queue, getattr(s, _COMMANDED), self.problem.plant.input.size
        shown = dict(zip(self.raw.elements, ca.vertsplit(getattr(s, self.raw.name)), strict=True))
        column, count = newest, getattr(s, _COUNT)
        remembered = {f"{_COUNT}_next": ca.fmin(count + 1, late + 1)}
        if queue.length > 1:
            column = ca.vertcat(newest, getattr(s, _QUEUE))
            remembered[f"{_QUEUE}_next"] = column[: size * (queue.length - 1)]
        parameters, _ = self._told.acted(s, 0)
        command = queue.delayed(column, size)
        return Evidence(shown, {}, command, parameters, count > late + 0.5, count > late - 0.5), remembered

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
        NotSupported: an adaptive controller whose response nobody measures; a measurement that is late by a fraction of a cycle,
            or late beside signals from outside; a model with other parameters than the problem's; errors that are neither
            observed nor decay.
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
    if late and told_places(plant, problem.signals):
        raise NotSupported(
            "believed states behind a late measurement would need the signals from outside of that time; leave out the dead time "
            "of the measurement, or the belief"
        )
    model = controller.model_plant(problem)
    if model.parameter.elements != plant.parameter.elements:
        raise NotSupported(
            f"{type(controller).__name__} has a model with other parameters than the problem's, and states are believed by the "
            "problem's; leave the belief out, or give both the same parameters"
        )
    check_observed(problem)
