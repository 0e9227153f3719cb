"""What a model of the controller's own is given: signals from outside, and the commands that acted until a sample was taken.

    parameters, time -> parameters with the values of this cycle -> controller
    last command -> dead time of the input -> whole cycles of the measurement's dead time -> lag of the actuator -> model

A model is compared with a response that ends a cycle: it is given the signals of the last cycle, `_signals_acted`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.plant.motion import time_signal
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import left_after, left_in_mean, numbers, stays
from fpirhc.task.dead_time import DeadTime, Queue, every
from fpirhc.task.exogenous import Exogenous, known_places, model_values, rows_of
from fpirhc.task.problem import Problem

ACTED = "_signals_acted"
NOW = "_parameters_now"
NONE = 1e-9  # a fraction of a cycle below this counts as zero
MEASURED_OUTPUT = "_measured_output"  # the outputs of the same instant
MEASURED = "_measured_state"  # the state that the response belongs to, where a controller may act on a predicted one
MEASURED_TIME = "_measured_time"  # the time at which it is given, where a controller may act on a predicted one


@dataclass(frozen=True, eq=False)
class KnownSignals:
    """What a model is told."""

    plant: Plant
    signals: Mapping[str, Exogenous]  # from outside, by name
    period: float

    @property
    def places(self) -> tuple[int, ...]:
        """Places among the parameters of the signals of which it is told something."""
        return known_places(self.plant, self.signals)

    @property
    def reads(self) -> tuple[Signal, ...]:
        """The signals of the last cycle, in the first cycle those of the cycle itself; nothing where it is told nothing."""
        plant, places = self.plant, self.places
        if not places:
            return ()
        at = np.array([self.period / 2])
        first = rows_of(model_values(plant, self.signals), at, plant.approximate)[0]
        names, units = (tuple(v[k] for k in places) for v in (plant.parameter.elements, plant.parameter.units))
        return (Signal(ACTED, names, units, tuple(float(first[k]) for k in places)),)

    def memory(self, late: int, name: str) -> tuple[Signal, ...]:
        """Return the signals of `late` more cycles before the last one, remembered under a name."""
        return tuple(m for one in self.reads for m in Queue(late).memory(name, one.elements, one.start))

    def acted(self, s: Signals, late: int, oldest: int, name: str) -> tuple[Expression, dict[str, Expression]]:
        """Return the parameters of `late` cycles before the last one, and what is remembered: the signals back to the oldest.

        They are the parameters of this cycle, with the signals of that one.
        """
        if not self.places:
            return s.parameters, {}
        column, remembered = Queue(oldest).column(s, name, getattr(s, ACTED))
        acted = dict(zip(self.places, ca.vertsplit(Queue(late).delayed(column, len(self.places))), strict=True))
        parameters = ca.vertcat(*(acted.get(k, s.parameters[k]) for k in range(self.plant.parameter.size)))
        return parameters, remembered

    def block(self, *, remembers: bool) -> Block | None:
        """Return the block (time, parameters) -> parameters of this cycle; None where the model is told nothing.

        `remembers`: whether it also writes the signals of the last cycle.
        """
        values = model_values(self.plant, self.signals)
        if values is None:
            return None
        (acted,), places, half = self.reads, list(self.places), self.period / 2
        last = Signal("signals_last", acted.elements, acted.units, acted.start)

        def step(s: Signals) -> dict[str, Expression]:
            now = values(s.time + half, s.parameters)
            if not remembers:
                return {NOW: now}
            return {NOW: now, ACTED: s.signals_last, "signals_last_next": now[places]}

        parameter, opaque = self.plant.parameter, not values.is_a("SXFunction")
        writes = Layout((Signal(NOW, parameter.elements, parameter.units), *((acted,) if remembers else ())))
        memory = Layout((last,)) if remembers else Layout()
        return Block("signals", Layout((time_signal(self.plant), parameter)), writes, step, memory, opaque)


@dataclass(frozen=True, eq=False)
class CommandPath:
    """What acted until a sample was taken."""

    problem: Problem  # with the model
    owner: str  # first part of the names of what is remembered
    last: Signal  # signal of the command of the last cycle
    inputs: Queue  # how many cycles commands are late
    measurement: float = 0.0  # cycles by which samples are late
    lag: float | tuple[float, ...] = 0.0  # time constant of the actuators, one for all or one for each
    counts: bool = True  # whether the first cycles differ from the others

    @property
    def late(self) -> int:
        """Whole cycles of the measurement's dead time."""
        return math.floor(self.measurement + NONE)

    @property
    def fraction(self) -> float:
        """The rest of the measurement's dead time, in cycles."""
        rest = self.measurement - self.late
        return rest if rest > NONE else 0.0

    @cached_property
    def queue(self) -> Queue:
        """How late the commands are on which a whole sample depends."""
        return self.inputs.later(self.late)

    @property
    def reads(self) -> tuple[Signal, ...]:
        """The last command, the parameters, and the signals of the last cycle."""
        return (self.last, self.problem.plant.parameter, *self._known.reads)

    @cached_property
    def memory(self) -> tuple[Signal, ...]:
        """Commands on their way, positions of lagging actuators, the number of cycles so far, and older signals."""
        inputs, start = self.problem.plant.input, tuple(map(float, self.problem.inputs_before))
        queued = self._column.memory(f"{self.owner}_commands", inputs.elements, start)
        lagging = (Signal(f"{self.owner}_actuators", inputs.elements, inputs.units, start),) if self._lags else ()
        counted = (scalar(f"{self.owner}_cycles"),) if self.counts else ()
        return (*queued, *lagging, *counted, *self._known.memory(self._oldest, f"{self.owner}_signals"))

    def cycles(self, s: Signals) -> Expression:
        """Return the number of cycles so far; it stops where no sample shows the time before the run."""
        return getattr(s, f"{self.owner}_cycles")

    def acted(self, s: Signals) -> tuple[Expression, Expression, dict[str, Expression]]:
        """Return the input that acted in the cycle of the last whole sample, at its end and in the mean, and what is remembered."""
        arrived, remembered = self._arrived(s, self.queue)
        if not self._lags:
            return arrived, arrived, remembered
        taus, period = every(self.lag), self.problem.period
        decay, share = (numbers([left(period, t) for t in taus], arrived) for left in (left_after, left_in_mean))
        away = getattr(s, f"{self.owner}_actuators") - arrived
        end = arrived + decay * away
        return end, arrived + share * away, {**remembered, f"{self.owner}_actuators_next": end}

    def acted_before(self, s: Signals) -> Expression:
        """Return the input that acted one cycle earlier, without lag."""
        return self._arrived(s, self._column)[0]

    @property
    def signalled(self) -> bool:
        """Whether signals from outside are among the model's parameters."""
        return bool(self._known.places)

    def parameters(self, s: Signals) -> tuple[Expression, dict[str, Expression]]:
        """Return the model's parameters with the signals from outside that acted, and what is remembered."""
        return self._known.acted(s, self.late, self._oldest, f"{self.owner}_signals")

    def parameters_before(self, s: Signals) -> Expression:
        """Return the same with the signals that acted one cycle earlier."""
        return self._known.acted(s, self._oldest, self._oldest, f"{self.owner}_signals")[0]

    def _arrived(self, s: Signals, queue: Queue) -> tuple[Expression, dict[str, Expression]]:
        column, remembered = self._column.column(s, f"{self.owner}_commands", getattr(s, self.last.name))
        if self.counts:
            most = self.late + (2 if self.fraction else 1)
            remembered[f"{self.owner}_cycles_next"] = ca.fmin(self.cycles(s) + 1, most)
        return queue.delayed(column, self.last.size), remembered

    @cached_property
    def _column(self) -> Queue:
        """How late the oldest commands are on which an interpolated sample depends."""
        return self.inputs.later(self._oldest)

    @property
    def _oldest(self) -> int:
        """Whole cycles by which the older of two interpolated samples is late."""
        return self.late + 1 if self.fraction else self.late

    @property
    def _lags(self) -> bool:
        return not all(stays(t, 0.0) for t in every(self.lag))

    @property
    def _known(self) -> KnownSignals:
        return KnownSignals(self.problem.plant, self.problem.signals, self.problem.period)


def measured_state(plant: Plant) -> Signal:
    """Return the signal of the measured state."""
    return Signal(MEASURED, plant.state.elements, plant.state.units)


def measured_output(plant: Plant) -> Signal:
    """Return the signal of the measured outputs."""
    return Signal(MEASURED_OUTPUT, plant.output.elements, plant.output.units)


def with_measured_state(plant: Plant, blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks behind one that writes the measured state or outputs, and their time, where a block reads them."""
    writes = measured_reads(plant, blocks)
    if not writes:
        return list(blocks)
    sources = {MEASURED: plant.state, MEASURED_OUTPUT: plant.output, MEASURED_TIME: time_signal(plant)}
    reads = tuple(sources[w.name] for w in writes)
    first = Block(
        "measured", Layout(reads), Layout(writes), lambda s: {w.name: getattr(s, sources[w.name].name) for w in writes}
    )
    return [first, *blocks]


def measured_reads(plant: Plant, blocks: Sequence[Block]) -> tuple[Signal, ...]:
    """Return the signals of the measured state and outputs and of their time, as far as some blocks read them."""
    every = measured_state(plant), measured_output(plant), replace(time_signal(plant), name=MEASURED_TIME)
    read = {name for block in blocks for name in block.reads.names}
    return tuple([signal for signal in every if signal.name in read])


_STATES, _COMMANDS, _OUTPUTS = "pair_states", "pair_commands", "pair_outputs"


@dataclass(frozen=True, eq=False)
class ResponsePairs:
    """The state and the command to which a measured response belongs, behind dead time and an estimator: the pairs of a learner.

        f_k = response at x_{k-D} to u_{k-1-D-d},      d: dead time of input and measurement, D: delay of the estimator, in cycles

    A measured state is as late as the response, by the dead time of the measurement, so it waits for the estimator's delay alone;
    the command waits for all three. Fractions are interpolated, as the dead times are. The regressors are those without dead time,
    d + D later.
    """

    problem: Problem  # with the plant that is measured
    dead_time: DeadTime  # that is believed
    with_outputs: bool = False  # whether the measured outputs of that instant belong to a pair
    # cycles by which the state is older; a map's response belongs to the state of the cycle before (`response_age`)
    age: int = 0

    @property
    def waiting(self) -> bool:
        """Whether a response belongs to another pair than the measured state and the last command."""
        return self._states.length > 1 or self._commands.length > 1

    @property
    def state(self) -> Signal:
        """The signal of the measured state; behind dead time a controller may act on a predicted one."""
        return measured_state(self.problem.plant) if self.waiting else self.problem.plant.state

    @property
    def seen(self) -> Signal:
        """The signal of the measured outputs; behind dead time a controller may act on predicted ones."""
        return measured_output(self.problem.plant) if self.waiting else self.problem.plant.output

    @property
    def cycles(self) -> float:
        """Number of the first cycle whose pair belongs to this run: before it, samples show the start."""
        late = self.dead_time.measurement / self.problem.period
        first = self.problem.sensing.warm_up_cycles(self.problem.plant, late)
        return max(first, math.ceil(late - NONE) + 1)

    @property
    def late(self) -> float:
        """How long before the cycle the response was realised, in units of time."""
        return self.dead_time.measurement + self._delay * self.problem.period

    @property
    def memory(self) -> tuple[Signal, ...]:
        """Past states and commands."""
        problem = self.problem
        states = self._states.memory(_STATES, problem.plant.state.elements, problem.start_state.tolist())
        commands = self._commands.memory(_COMMANDS, problem.plant.input.elements, problem.inputs_before.tolist())
        if not self.with_outputs:
            return (*states, *commands)
        outputs = self._states.memory(_OUTPUTS, problem.plant.output.elements, problem.start_output.tolist())
        return (*states, *commands, *outputs)

    def pair(self, s: Signals, newest: Expression) -> tuple[Expression, Expression, dict[str, Expression]]:
        """Return state and command of the response, and what is remembered."""
        state = getattr(s, MEASURED if self.waiting else self.problem.plant.state.name)
        state, states = self._states.arrived(s, _STATES, state)
        command, commands = self._commands.arrived(s, _COMMANDS, newest)
        return state, command, {**states, **commands}

    def output(self, s: Signals) -> tuple[Expression | None, dict[str, Expression]]:
        """Return the measured outputs of that instant, and what is remembered; None where they do not belong to a pair."""
        if not self.with_outputs:
            return None, {}
        return self._states.arrived(s, _OUTPUTS, getattr(s, self.seen.name))

    @cached_property
    def _delay(self) -> float:
        delay = self.problem.sensing.delay(self.problem.plant, self.problem.period)
        return delay if delay > NONE else 0.0

    @property
    def _states(self) -> Queue:
        return Queue(self._delay + self.age)

    @property
    def _commands(self) -> Queue:
        late, names = self.dead_time, self.problem.plant.inputs
        waits = (late.inputs.get(name, 0.0) + late.measurement for name in names)
        return Queue(tuple(wait / self.problem.period + self._delay for wait in waits))
