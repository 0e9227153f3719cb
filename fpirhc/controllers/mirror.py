"""The mirror: the model's response on the same way as the plant's, for a model-referenced deformation.

    commands -> believed dead time -> believed actuator lag -> model -> [sensors' quanta -> late samples -> estimator] -> modelled

Where the response itself is measured, the modelled response is that of this instant, f^(x_k, u_{k-1}), where u_{k-1} is the command
that acted according to the believed dead times and lags. Where the response is estimated from samples, a twin of the plant runs
beside it: the model minus the deformation, f^(x, u) - delta, which is the believed behaviour of the plant, integrated over the
cycle. Its samples pass the same estimator, and the estimator's response to delta is added again. With an exact model delta is zero,
and both estimates are the same number, equally late, rounded and smoothed.

A twin would drift away from the plant. So after each cycle it is shifted until its own estimate of the state is the controller's.
The memory of its estimator is shifted along the same path, a polynomial of a degree below the plant's order. Such a path does not
change any estimate of the response: the twin's response is always the model's, and never that of the shift.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.deformation.base import Deformation, Mirror, is_finite
from fpirhc.deformation.queue import Queue, every
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import response_names
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, expression, total
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.problem import Problem

MEASURED = "_measured_state"  # the state that the response belongs to; a controller may act on a predicted state
_BEFORE = "_deformation_before"
_NONE = 1e-9  # a fraction of a cycle below this is none


def mirror_blocks(problem: Problem, deformation: Deformation) -> tuple[list[Block], list[Delay]]:
    """Return the block that writes '_modelled', with what it remembers; nothing for a map that is given its own last request."""
    mirror = deformation.mirror
    if mirror is None:
        return [], []
    estimated = not problem.sensing.estimator.shows_response or mirror.measurement % 1 > _NONE
    path = _Path(problem, mirror, estimated or max(every(mirror.cycles)) + mirror.measurement > 0)
    if not estimated:
        return [_instant_block(path)], []
    return [_twin_block(path)], [Delay(problem.plant.response_signal(_BEFORE), "_deformation")]


def with_measured_state(plant: Plant, blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks, preceded by a block that copies the state to the measured state where some block reads that."""
    if not any(MEASURED in block.reads for block in blocks):
        return list(blocks)
    target = measured_state(plant)
    first = Block("measured", Layout((plant.state,)), Layout((target,)), lambda s: {MEASURED: s.state})
    return [first, *blocks]


def measured_state(plant: Plant) -> Signal:
    """Return the signal of the measured state."""
    return Signal(MEASURED, plant.state.elements, plant.state.units)


@dataclass(frozen=True, eq=False)
class _Path:
    """The believed way from the commands to the model.

    The whole cycles of the measurement's dead time stand before the model: the twin lives in the time of the samples.

    Args:
        problem: that the mirror is built for.
        mirror: the believed dead times and lags.
        counts: whether the first cycles of a run differ from the others.
    """

    problem: Problem
    mirror: Mirror
    counts: bool

    @property
    def late(self) -> int:
        """Whole cycles of the measurement's dead time."""
        return math.floor(self.mirror.measurement + _NONE)

    @property
    def fraction(self) -> float:
        """The fraction of a cycle beyond `late`."""
        rest = self.mirror.measurement - self.late
        return rest if rest > _NONE else 0.0

    @property
    def decays(self) -> tuple[float, ...]:
        """Share of an actuator's distance from its command that remains after one cycle; empty where no actuator lags."""
        taus = every(self.mirror.lag)
        return tuple(math.exp(-self.problem.period / t) if t else 0.0 for t in taus) if any(taus) else ()

    @property
    def queue(self) -> Queue:
        """The queue of commands; the newest one is that of the last cycle."""
        if isinstance(self.mirror.cycles, tuple):
            return Queue(tuple(c + self.late for c in self.mirror.cycles))
        return Queue(self.mirror.cycles + self.late)

    @property
    def memory(self) -> tuple[Signal, ...]:
        """Commands on their way, positions of lagging actuators, and the number of cycles so far."""
        plant, length = self.problem.plant, self.queue.length
        start = tuple(self.problem.dead_time.commands_before(plant))
        names = tuple(f"{e}@{k}" for k in range(1, length) for e in plant.input.elements)
        queued = (Signal("mirror_commands", names, start=start * (length - 1)),) if length > 1 else ()
        lagging = (Signal("mirror_actuators", plant.input.elements, plant.input.units, start),) if self.decays else ()
        counted = (scalar("mirror_cycles"),) if self.counts else ()
        return (*queued, *lagging, *counted)

    @property
    def reads(self) -> tuple[Signal, ...]:
        """Signals that every mirror reads."""
        plant = self.problem.plant
        before = Signal("_command_before", plant.input.elements, plant.input.units)
        return measured_state(plant), before, plant.parameter

    def acted(self, s: Signals) -> tuple[Expression, Expression, dict[str, Expression]]:
        """Return the input that acted in the last cycle, at its end and in the mean, and what is remembered."""
        size, newest = self.problem.plant.input.size, s._command_before
        remembered: dict[str, Expression] = {}
        if self.counts:
            first = ca.DM(self.problem.dead_time.commands_before(self.problem.plant))
            newest = ca.if_else(s.mirror_cycles < 0.5, first, newest)
            remembered["mirror_cycles_next"] = ca.fmin(s.mirror_cycles + 1, self.late + 1)
        column = newest
        if self.queue.length > 1:
            column = ca.vertcat(newest, s.mirror_commands)
            remembered["mirror_commands_next"] = column[: size * (self.queue.length - 1)]
        arriving = self.queue.delayed(column, size)
        if not self.decays:
            return arriving, arriving, remembered
        decay = ca.DM(self.decays) if len(self.decays) > 1 else self.decays[0]
        share = ca.DM(_mean_shares(every(self.mirror.lag), self.problem.period))
        away = s.mirror_actuators - arriving
        end = arriving + decay * away
        return end, arriving + share * away, {**remembered, "mirror_actuators_next": end}


def _mean_shares(taus: Sequence[float], period: float) -> list[float]:
    """Mean over one cycle of the remaining share of an actuator's distance from its command: (tau / T) (1 - e^(-T / tau))."""
    return [t / period * -math.expm1(-period / t) if t else 0.0 for t in taus]


def _instant_block(path: _Path) -> Block:
    """Block (measured state, last command, parameters) -> the model's response at this instant."""
    plant = path.problem.plant
    x, u, p = plant._symbols()
    response = ca.Function("fpirhc_modelled", [x, u, p], [plant.controlled_response_function(x, u, p)])

    def step(s: Signals) -> dict[str, Expression]:
        end, _, remembered = path.acted(s)
        return {"_modelled": response(getattr(s, MEASURED), end, s.parameters), **remembered}

    writes = Layout((plant.response_signal("_modelled"),))
    return Block("mirror", Layout(path.reads), writes, step, Layout(path.memory))


def _twin_block(path: _Path) -> Block:
    """Block (measured state, last command, last deformation, parameters) -> the response that the estimator makes of the twin."""
    problem, plant = path.problem, path.problem.plant
    start, names = problem.start_state, problem.sensing.estimator.measures(plant)
    estimate = problem.sensing.estimator.block(plant, problem.period, start, Signal("_seen", names))
    own = tuple(Signal(f"mirror_{m.name}", m.elements, m.units, m.start) for m in estimate.memory.signals)
    twin = Signal("mirror_state", plant.state.elements, plant.state.units, tuple(map(float, start)))
    sensors, calm = _sensors(problem, names), np.zeros(len(plant.names))
    resting = np.asarray(sensors(start, np.zeros(plant.input.size), plant.approximate, calm).full()).ravel()
    late = (Signal("mirror_sample", names, start=tuple(map(float, resting))),) if path.fraction else ()
    advance = problem.integrator.step(plant, problem.period)
    shifts, past = _Shifts(problem, names, path), _Deformations(path)

    def step(s: Signals) -> dict[str, Expression]:
        end, mean, remembered = path.acted(s)
        acting, response_to_deformation, deformations_next = past.acting(s)
        at_rest = s.mirror_cycles < path.late + 0.5  # the samples still show the start
        at = ca.if_else(at_rest, s.mirror_state, advance(s.mirror_state, mean, s.parameters, -acting))
        sample = sensors(at, end, s.parameters, -acting)
        late_sample = (1 - path.fraction) * sample + path.fraction * s.mirror_sample if late else sample
        state, response, *memories = estimate.function(late_sample, *(getattr(s, m.name) for m in own))
        away = getattr(s, MEASURED) - state
        # A shift that is not finite must not be remembered.
        shift = ca.if_else(is_finite(away), away, 0)
        remembered |= {"mirror_state_next": at + shifts.state @ shift, **deformations_next}
        if late:
            remembered["mirror_sample_next"] = sample + shifts.sample @ shift
        for signal, value, matrix in zip(own, memories, shifts.memory, strict=True):
            remembered[f"{signal.name}_next"] = value + matrix @ shift
        return {"_modelled": response + response_to_deformation, **remembered}

    writes = Layout((plant.response_signal("_modelled"),))
    memory = Layout((*path.memory, past.memory, twin, *late, *own))
    reads = Layout((*path.reads, plant.response_signal(_BEFORE)))
    return Block("mirror", reads, writes, step, memory, opaque=problem.integrator.opaque)


class _Deformations:
    """Deformations of earlier cycles: the one that acts, and the estimator's response to them."""

    def __init__(self, path: _Path) -> None:
        plant = path.problem.plant
        self._plant, self._names = plant, plant.controlled_names
        self._acting = path.queue
        estimator, period = path.problem.sensing.estimator, path.problem.period
        every_weight = [estimator.weights(plant.orders[k], period) for k in plant.controlled_indices]
        self._weights = [np.convolve(w, [1 - path.fraction, path.fraction]) for w in every_weight]
        self._length = max(max(w.size for w in self._weights) - 1, 1) + self._acting.length - 1

    @property
    def memory(self) -> Signal:
        return Signal("mirror_deformations", tuple(f"{e}@{k}" for k in range(1, self._length + 1) for e in self._names))

    def acting(self, s: Signals) -> tuple[Expression, Expression, dict[str, Expression]]:
        """Return the acting deformation as forcing of every coordinate, the estimated response to it, and what is remembered."""
        size = len(self._names)
        column = ca.vertcat(getattr(s, _BEFORE), s.mirror_deformations)
        late = [self._acting.delayed(column[size * j :], size) for j in range(max(w.size for w in self._weights))]
        responses = [
            total(v * late[j][k] for j, v in enumerate(weights) if v != 0) for k, weights in enumerate(self._weights)
        ]
        forcing: list[Expression] = [expression(0.0)] * len(self._plant.names)
        for place, value in zip(self._plant.controlled_indices, ca.vertsplit(late[0]), strict=True):
            forcing[place] = value
        remembered = {"mirror_deformations_next": column[: size * self._length]}
        return ca.vertcat(*forcing), ca.vertcat(*responses), remembered


def _sensors(problem: Problem, names: Sequence[str]) -> ca.Function:
    """Function (state, command that acted, parameters, forcing) -> sensor readings without noise, rounded to the quanta."""
    plant = problem.plant
    x, u, p = plant._symbols()
    w = ca.SX.sym("w", len(plant.names))
    values = dict(zip(plant.state.elements, ca.vertsplit(x), strict=True))
    forced = plant.controlled_response_function(x, u, p) + w[list(plant.controlled_indices)]
    values |= dict(zip(response_names(plant), ca.vertsplit(forced), strict=True))
    entries = []
    for name in names:
        sensor = problem.sensing.sensors.get(name)
        quantum = sensor.quantum if sensor is not None else None
        entries.append(values[name] if quantum is None else quantum * ca.floor(values[name] / quantum + 0.5))
    return ca.Function("fpirhc_mirror_seen", [x, u, p, w], [ca.densify(ca.vertcat(*entries))])


class _Shifts:
    """Matrices that turn a shift of the estimated state into shifts of the twin and of its estimator's memory."""

    def __init__(self, problem: Problem, names: Sequence[str], path: _Path) -> None:
        plant, period = problem.plant, problem.period
        self.state = ca.DM(_drift(plant, path.fraction * period))
        places = {e: k for k, e in enumerate(plant.state.elements)}
        rows = [np.asarray(self.state)[places[n]] if n in places else np.zeros(plant.state.size) for n in names]
        self.sample = ca.DM(np.array(rows))
        ahead = _drift(plant, period)
        # The memory at a start is linear in the start, and one cycle later the start would lie on the same path.
        columns = [
            _remembered(problem, names, unit) for unit in (np.zeros(plant.state.size), *np.eye(plant.state.size))
        ]
        self.memory = [
            ca.DM(np.column_stack([c[k] - columns[0][k] for c in columns[1:]]) @ ahead) for k in range(len(columns[0]))
        ]


def _remembered(problem: Problem, names: Sequence[str], start: np.ndarray) -> list[np.ndarray]:
    """The estimator's memory at a start, signal by signal."""
    block = problem.sensing.estimator.block(problem.plant, problem.period, start, Signal("_seen", tuple(names)))
    return [m.start_vector() for m in block.memory.signals]


def _drift(plant: Plant, time: float) -> np.ndarray:
    """Matrix of a state's motion over that time with all highest derivatives zero: Taylor's formula."""
    elements = plant.state.elements
    drift = np.zeros((len(elements), len(elements)))
    for k, element in enumerate(elements):
        for j, other in enumerate(elements):
            power = len(other) - len(element)
            if other.rstrip("'") == element.rstrip("'") and power >= 0:
                drift[k, j] = time**power / math.factorial(power)
    return drift
