"""The block of believed states: from raw measurements and the own commands to 'state' and 'realised'.

    model predicts -> what no sensor shows is taken from the prediction -> estimator -> observer corrects

The response is the estimator's, from what is measured; controllers that learn from it are refused where it would be the model's.
The state has each entry from where it is known best: believed entries from the observer, the others from the estimator. Outputs of
a plant are measured or estimated, as 'output' beside 'state'.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import casadi as ca
import numpy as np

from fpirhc.controllers.exogenous_block import KnownSignals
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.integrators import Integrator, RungeKutta4
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import values_of
from fpirhc.sensing.state_observer import Evidence, Model, StateObserver
from fpirhc.symbolic.block import Block, Delay, bridged, call
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.gap import GAP
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import nominal
from fpirhc.symbolic.queue import Queue
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Believing:
    """The block that believes, and what it remembers.

    Args:
        problem: whose sensing has an observer.
        raw: signal of the raw measurements.
        shown: first state, or outputs, that the sensors see; the estimator begins there.
        lost: whether samples may be lost.
    """

    problem: Problem
    raw: Signal
    shown: np.ndarray
    lost: bool = False

    @property
    def block(self) -> Block:
        """Block (raw measurements, parameters, last command) -> (state, [output], realised)."""
        plant = self.problem.plant
        reads = Layout((self.raw, *self._time.reads, *((GAP,) if self.lost else ())))
        writes = Layout((*measured_signals(plant), plant.response_signal("realised")))
        own = Layout((*self._time.memory, *self.observer.memory(self.model).signals)) + self._estimator.memory
        opaque, lossy = self.observer.opaque, None if self.lost else lambda: replace(self, lost=True).block
        waits = Block("believe_waits", Layout((*self._time.reads, GAP)), Layout(), self._wait, own, opaque=opaque)
        return Block(
            "believe", reads, writes, self._step, own, opaque, waits=waits if self.lost else None, bridged=lossy
        )

    @property
    def delay(self) -> Delay:
        """The last command, carried to the next cycle."""
        return Delay(self._time.commanded, self.problem.plant.input.name)

    @property
    def observer(self) -> StateObserver:
        """How states that no sensor shows are believed."""
        observer = self.problem.sensing.observer
        assert observer is not None
        return observer

    @cached_property
    def model(self) -> Model:
        """What the observer is built from."""
        problem = self.problem
        move = moving(problem.plant, believed_integrator(problem), problem.period, fraction=bool(self._time.fraction))
        return Model(problem.plant, move, problem.start_state, problem.sensing.measures(problem.plant))

    @property
    def _time(self) -> SampleTime:
        return SampleTime(self.problem)

    @cached_property
    def _estimator(self) -> Block:
        plant, sensing = self.problem.plant, self.problem.sensing
        completed = Signal("_completed", sensing.estimator.measures(plant))
        block = sensing.estimator.block(plant, self.problem.period, self.shown, completed)
        return bridged(block) if self.lost else block

    def _step(self, s: Signals) -> dict[str, Expression]:
        plant, sensing, elements = self.problem.plant, self.problem.sensing, self.problem.plant.state.elements
        shown_now = dict(zip(self.raw.elements, ca.vertsplit(getattr(s, self.raw.name)), strict=True))
        evidence, results = self._evidence(s, shown_now)
        memory = {m: getattr(s, m) for m in self.observer.memory(self.model).names}
        predicted = self.observer.predict(self.model)(evidence, memory)
        expected = values_of(plant, predicted, evidence.command, evidence.parameters)
        motion, realised, *remembered = self._estimates(s, {**expected, **evidence.measured})
        shown = self._shown(motion, evidence.measured)
        correct = self.observer.correct(self.model)
        known = {e: shown[e] for e in sensing.known(plant)}
        state, next_memory = correct(replace(evidence, known=known), memory, predicted)
        names = sensing.believed(plant)
        believed = dict(zip(elements, ca.vertsplit(state), strict=True))
        states = [believed[e] if e in names or e not in shown else shown[e] for e in elements]
        results |= {plant.output.name: motion, "state": ca.vertcat(*states), "realised": realised}
        results |= {f"{m}_next": v for m, v in next_memory.items()}
        return results | {f"{m.name}_next": v for m, v in zip(self._estimator.memory.signals, remembered, strict=True)}

    def _shown(self, motion: Expression, measured: Mapping[str, Expression]) -> dict[str, Expression]:
        """States as the estimator has them, and as they are measured beside outputs."""
        plant = self.problem.plant
        entries = ca.vertsplit(motion)
        pairs = zip(plant.state.elements, plant.equations.known_by_outputs, strict=True)
        return {**measured, **{e: entries[place] for e, place in pairs if place >= 0}}

    def _wait(self, s: Signals) -> dict[str, Expression]:
        """Memory after a cycle without a sample: the prediction with nothing to correct it."""
        evidence, results = self._evidence(s, dict.fromkeys(self.raw.elements, expression(0.0)))
        memory = {m: getattr(s, m) for m in self.observer.memory(self.model).names}
        predicted = self.observer.predict(self.model)(evidence, memory)
        _, next_memory = self.observer.correct(self.model)(replace(evidence, counts=expression(0.0)), memory, predicted)
        results |= {f"{m}_next": v for m, v in next_memory.items()}
        remembered = {m: getattr(s, m) for m in self._estimator.memory.names}
        waits = self._estimator.waits
        if waits is not None:
            call(waits, dict(vars(s)), remembered)
        return results | {f"{m}_next": v for m, v in remembered.items()}

    def _evidence(self, s: Signals, shown: Mapping[str, Expression]) -> tuple[Evidence, dict[str, Expression]]:
        """What the observer is told, with no state known yet, and what is remembered for the next cycle."""
        (command, commands), (parameters, signals) = self._time.command(s), self._time.parameters(s)
        evidence = Evidence(shown, {}, command, parameters, self._time.moves(s), self._time.counts(s))
        return evidence, {**commands, **signals}

    def _estimates(self, s: Signals, seen: Mapping[str, Expression]) -> tuple[Expression, ...]:
        """State or outputs, response, and memory of the estimator."""
        names = self.problem.sensing.estimator.measures(self.problem.plant)
        completed = ca.vertcat(*(seen[n] for n in names))
        gap = [s.gap] if self.lost and GAP.name in self._estimator.reads else []
        results = self._estimator.function(completed, *gap, *(getattr(s, m) for m in self._estimator.memory.names))
        return tuple(results)


def moving(plant: Plant, integrator: Integrator, period: float, *, fraction: bool) -> ca.Function:
    """Return Function (state, input, parameters, forcing, share) -> state after that share of a cycle.

    Args:
        plant: the model.
        integrator: of its motion.
        period: of the control cycle.
        fraction: whether the share may lie between 0 and 1; a sample in between is interpolated.
    """
    (x, u, p), w, share = plant.symbols(), ca.SX.sym("w", len(plant.names)), ca.SX.sym("share")
    after = integrator.step(plant, period)(x, u, p, w)
    state_next = x + share * (after - x) if fraction else after
    return ca.Function("fpirhc_move", [x, u, p, w, share], [ca.if_else(share, state_next, x)])


def believed_integrator(problem: Problem) -> Integrator:
    """Return the integrator of the model: the problem's, or a Runge-Kutta step where that is a call without Jacobian."""
    return RungeKutta4() if problem.integrator.opaque else problem.integrator


COMMANDED = "_commanded"  # the last command
_COUNT, _QUEUE, _SIGNALS = "observer_cycles", "observer_commands", "observer_signals"
_WHOLE = 1e-6  # a fraction of a cycle below this counts as zero


@dataclass(frozen=True, eq=False)
class SampleTime:
    """What acted until a sample was taken: an observer lives in the time of the samples.

    Behind a measurement that is late by d + phi cycles, 0 <= phi < 1, a sample is interpolated,

        z_k = (1 - phi) x_{k-d} + phi x_{k-d-1},

    and moves as the plant does with the mean of the commands that acted, (1 - phi) u_{k-d-1} + phi u_{k-d-2}. For a linear plant
    this is exact; else the error is of second order in the cycle, as that of the interpolation. The first sample that moves is a
    mean with the start, so it moves by 1 - phi of a cycle.

    Args:
        problem: whose measurements may be late.
    """

    problem: Problem

    @property
    def late(self) -> int:
        """Whole cycles of the measurement's dead time."""
        return math.floor(self._cycles + _WHOLE)

    @property
    def fraction(self) -> float:
        """The rest of the measurement's dead time, in cycles."""
        rest = self._cycles - self.late
        return rest if rest > _WHOLE else 0.0

    @property
    def commanded(self) -> Signal:
        """Signal of the last command."""
        inputs = self.problem.plant.input
        return Signal(COMMANDED, inputs.elements, inputs.units, tuple(map(float, self.problem.inputs_before)))

    @property
    def reads(self) -> tuple[Signal, ...]:
        """The last command, the parameters, and the signals of the last cycle."""
        return (self.problem.plant.parameter, self.commanded, *self._known.reads)

    @property
    def memory(self) -> tuple[Signal, ...]:
        """The number of cycles so far, older commands, and older signals."""
        elements, length = self.commanded.elements, self._length
        names = tuple(f"{e}@{k}" for k in range(1, length) for e in elements)
        queued = (Signal(_QUEUE, names, start=self.commanded.start * (length - 1)),) if length > 1 else ()
        return (scalar(_COUNT), *queued, *self._known.memory(self.late, _SIGNALS))

    def command(self, s: Signals) -> tuple[Expression, dict[str, Expression]]:
        """Return the command that acted, and what is remembered."""
        size, newest, length = self.problem.plant.input.size, getattr(s, COMMANDED), self._length
        count, column, remembered = getattr(s, _COUNT), newest, {}
        remembered[f"{_COUNT}_next"] = ca.fmin(count + 1, self.late + (2 if self.fraction else 1))
        if length > 1:
            column = ca.vertcat(newest, getattr(s, _QUEUE))
            remembered[f"{_QUEUE}_next"] = column[: size * (length - 1)]
        acted = self._queue(0).delayed(column, size)
        if self.fraction:
            mean = (1 - self.fraction) * acted + self.fraction * self._queue(1).delayed(column, size)
            acted = ca.if_else(count > self.late + 1.5, mean, acted)
        return acted, remembered

    def parameters(self, s: Signals) -> tuple[Expression, dict[str, Expression]]:
        """Return the model's parameters with the signals from outside that acted, and what is remembered."""
        return self._known.acted(s, self.late, _SIGNALS)

    def moves(self, s: Signals) -> Expression:
        """Return the share of a cycle by which the sample is later than the last one."""
        count = getattr(s, _COUNT)
        later = count > self.late + 0.5
        if not self.fraction:
            return later
        return ca.if_else(count > self.late + 1.5, 1, (1 - self.fraction) * later)

    def counts(self, s: Signals) -> Expression:
        """Return whether the sample was taken in this run."""
        return getattr(s, _COUNT) > self.late - 0.5

    @property
    def _cycles(self) -> float:
        return self.problem.dead_time.measurement / self.problem.period

    @property
    def _known(self) -> KnownSignals:
        return KnownSignals(self.problem.plant, self.problem.signals, self.problem.period)

    def _queue(self, more: int) -> Queue:
        """Queue of the commands: the newest one is that of the last cycle, and acts on the sample's cycle after all dead times."""
        names, late = self.problem.plant.inputs, self.late + more
        waits = [self.problem.dead_time.wait(name, self.problem.period) for name in names]
        cycles = [cast(float, wait.cycles) for wait in waits]
        rooms = [nominal(c) if wait.longest is None else wait.longest for c, wait in zip(cycles, waits, strict=True)]
        longest = max(rooms) + late if any(wait.longest is not None for wait in waits) else None
        return Queue(tuple(c + late for c in cycles), longest=longest)

    @property
    def _length(self) -> int:
        return self._queue(1 if self.fraction else 0).length
