"""The mirror: the model's response seen the way the plant's is, for a model-referenced deformation.

    commands -> believed dead time -> believed actuator lag -> model -> [sensors' quanta -> late samples -> estimator] -> modelled

Where the response itself is measured, the model's response is that of this instant, f^(x_k, u_{k-1}), with u_{k-1} the input that
acted according to the beliefs. Where the response is estimated from samples, a twin of the plant produces them (`_twin`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.controllers.model_inputs import MEASURED, CommandPath, measured_output, measured_state
from fpirhc.deformation.base import Deformation
from fpirhc.plant.maps import response_age
from fpirhc.plant.motion import controlled_places
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import response_names, values_of
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, expression, is_finite, total
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.dead_time import Queue
from fpirhc.task.problem import Problem


def mirror_blocks(problem: Problem, deformation: Deformation) -> tuple[list[Block], list[Delay]]:
    """Return the block that writes '_modelled', the response that a model-referenced map reads, with what it remembers."""
    path = believed_path(problem, deformation)
    estimator, part = problem.sensing.estimator, path.fraction > 0
    if estimator.of_steps or (estimator.shows_response and not part):
        return [instant_mirror(path)], []
    path = replace(path, counts=True)
    if problem.plant.outputs:
        return [_twin(path, _Outputs(path))], []
    return [_twin(path, _States(path))], [Delay(problem.plant.response_signal(BEFORE), "_deformation")]


def believed_path(problem: Problem, deformation: Deformation, owner: str = "mirror") -> CommandPath:
    """Return the way of the commands to the model of a deformation; `owner` begins the names of what is remembered."""
    mirror, inputs = deformation.mirror, problem.plant.input
    last, waits = Signal("_command_before", inputs.elements, inputs.units), Queue(mirror.cycles)
    return CommandPath(problem, owner, last, waits, mirror.measurement, mirror.lag, counts=False)


class Answers(NamedTuple):
    """The responses that a model gives."""

    response: Callable[[Expression, Expression, Expression], Expression]  # function of (state, input, parameters)
    orders: Mapping[str, int]  # of the responses, by name
    signal: Signal  # that holds them


def _controlled(plant: Plant) -> Answers:
    orders = {name: plant.chains[name] for name in plant.controlled_names}
    return Answers(plant.equations.controlled_response, orders, plant.response_signal("_modelled"))


def instant_mirror(path: CommandPath, answers: Answers | None = None) -> Block:
    """Return the block (measured state, last command, parameters) -> the model's response that is measured in this cycle.

    There is no twin that could drift. The model answers from the measured state, or on a map from that of the cycle before. A
    response of relative order r of a map is complete r cycles after its command, so the model's waits as long:
    modelled_k = y^_r(x_{k-r}, u_{k-r}), u the input that acted then according to the beliefs.

    `answers`: of the model; None: the controlled responses.
    """
    plant = path.problem.plant
    response, orders, written = answers or _controlled(plant)
    age, start = response_age(plant), tuple(map(float, path.problem.start_state))
    last, queued = f"{path.owner}_state_before", f"{path.owner}_answers"
    before = (Signal(last, plant.state.elements, plant.state.units, start),) * age
    waits = [age * (order - 1) for order in orders.values()]
    waiting = tuple(f"{name}@{i}" for name, cycles in zip(orders, waits, strict=True) for i in range(1, cycles + 1))
    queues = (Signal(queued, waiting),) if waiting else ()

    def step(s: Signals) -> dict[str, Expression]:
        acting, _, remembered = path.acted(s)
        at = getattr(s, last if age else MEASURED)
        parameters, signals = path.parameters(s)
        past = ca.vertsplit(getattr(s, queued)) if waiting else []
        modelled, later = [], []
        for answer, cycles in zip(ca.vertsplit(response(at, acting, parameters)), waits, strict=True):
            queue, past = [answer, *past[:cycles]], past[cycles:]
            modelled.append(queue[-1])
            later += queue[:-1]
        remembered |= {f"{one.name}_next": getattr(s, MEASURED) for one in before} | signals
        if later:
            remembered[f"{queued}_next"] = ca.vertcat(*later)
        return {written.name: ca.vertcat(*modelled), **remembered}

    reads = measured_state(plant), *path.reads
    return Block(path.owner, Layout(reads), Layout((written,)), step, Layout((*path.memory, *before, *queues)))


BEFORE = "_deformation_before"
_STATE, _OFFSET, _ACTED = "mirror_state", "mirror_offset", "mirror_acted"


After: TypeAlias = Callable[[Expression], dict[str, Expression]]  # of a move of the estimate: what the twin remembers


def _twin(path: CommandPath, motion: _States | _Outputs) -> Block:
    """Block (what is measured, last command, parameters) -> the model's response behind the estimator.

    The motion shows a sample, the estimator makes a state and a response of it, and whatever separates this state from the measured
    one moves the motion and what the estimator remembers, so that the samples stay on one path.
    """
    problem, plant = path.problem, path.problem.plant
    estimator = problem.sensing.estimator
    estimate = estimator.block(plant, problem.period, motion.start, Signal("_seen", estimator.measures(plant)))
    own = tuple(replace(m, name=f"mirror_{m.name}") for m in estimate.memory.signals)
    moves = memory_moves(problem, estimator.measures(plant))

    def step(s: Signals) -> dict[str, Expression]:
        end, mean, remembered = path.acted(s)
        parameters, signals = path.parameters(s)
        waits = path.cycles(s) < path.late + 0.5  # the samples still show the start
        sample, more, after = motion.sample(s, end, mean, parameters, waits)
        shown, response, *memories = estimate.function(sample, *(getattr(s, m.name) for m in own))
        away = getattr(s, motion.reads[0].name) - shown
        move = ca.if_else(is_finite(away), away, 0)  # what is not finite must not be remembered
        remembered |= after(move) | signals
        for signal, value, matrix in zip(own, memories, moves, strict=True):
            remembered[f"{signal.name}_next"] = value + matrix @ move
        return {"_modelled": response if more is None else response + more, **remembered}

    reads, memory = Layout((*motion.reads, *path.reads)), Layout((*path.memory, *motion.memory, *own))
    writes = Layout((plant.response_signal("_modelled"),))
    return Block("mirror", reads, writes, step, memory, opaque=problem.integrator.opaque)


class _States:
    """A model that goes on by itself under the commands and the deformations of the past.

    The deformation acts on it as a forcing with the other sign, so that it moves as the plant would if the model were right.
    """

    def __init__(self, path: CommandPath) -> None:
        self._path, problem, plant = path, path.problem, path.problem.plant
        names = problem.sensing.estimator.measures(plant)
        self.start = problem.start_state
        self.reads = measured_state(plant), plant.response_signal(BEFORE)
        self._seen, self._controlled = _seen(problem, names, response_names(plant)), controlled_places(plant)
        self._advance, self._past = problem.integrator.step(plant, problem.period), _Deformations(path)
        resting = np.asarray(self._seen(self.start, problem.inputs_before, plant.approximate, 0).full()).ravel()
        late = (Signal("mirror_sample", names, start=tuple(map(float, resting))),) if path.fraction else ()
        state = Signal(_STATE, plant.state.elements, plant.state.units, tuple(map(float, self.start)))
        self.memory = self._past.memory, state, *late
        self._ahead = ca.DM(drift(plant.output, path.fraction * problem.period))
        places = {e: k for k, e in enumerate(plant.state.elements)}
        rows = [np.asarray(self._ahead)[places[n]] if n in places else np.zeros(plant.state.size) for n in names]
        self._shown = ca.DM(np.array(rows))

    def sample(
        self, s: Signals, end: Expression, mean: Expression, parameters: Expression, waits: Expression
    ) -> tuple[Expression, Expression | None, After]:
        """Return the sample of the cycle, what it adds to the estimated response, and what is remembered after a move."""
        acting, answered, next_deformations = self._past.seen(s)
        at = ca.if_else(waits, s.mirror_state, self._advance(s.mirror_state, mean, parameters, -acting))
        sample, part = self._seen(at, end, parameters, -acting[self._controlled]), self._path.fraction

        def after(move: Expression) -> dict[str, Expression]:
            late = {"mirror_sample_next": sample + self._shown @ move} if part else {}
            return {f"{_STATE}_next": at + self._ahead @ move, **next_deformations, **late}

        return (1 - part) * sample + part * s.mirror_sample if part else sample, answered, after


class _Deformations:
    """Deformations of earlier cycles: the one that acts, and their share in the estimated response."""

    def __init__(self, path: CommandPath) -> None:
        plant = path.problem.plant
        self._plant, self._names = plant, plant.controlled_names
        self._acting = path.queue
        estimator, period = path.problem.sensing.estimator, path.problem.period
        every_weight = [estimator.weights(plant.orders[k], period) for k in controlled_places(plant)]
        self._weights = [np.convolve(w, [1 - path.fraction, path.fraction]) for w in every_weight]
        self._length = max(max(w.size for w in self._weights) - 1, 1) + self._acting.length - 1

    @property
    def memory(self) -> Signal:
        return Signal("mirror_deformations", tuple(f"{e}@{k}" for k in range(1, self._length + 1) for e in self._names))

    def seen(self, s: Signals) -> tuple[Expression, Expression, dict[str, Expression]]:
        """Return the forcing that stands for the acting deformation, its estimated response, and what is remembered."""
        size = len(self._names)
        column = ca.vertcat(getattr(s, BEFORE), s.mirror_deformations)
        late = [self._acting.delayed(column[size * j :], size) for j in range(max(w.size for w in self._weights))]
        answered = [
            total(v * late[j][k] for j, v in enumerate(weights) if v != 0) for k, weights in enumerate(self._weights)
        ]
        forcing: list[Expression] = [expression(0.0)] * len(self._plant.names)
        for place, value in zip(controlled_places(self._plant), ca.vertsplit(late[0]), strict=True):
            forcing[place] = value
        remembered = {"mirror_deformations_next": column[: size * self._length]}
        return ca.vertcat(*forcing), ca.vertcat(*answered), remembered


def _seen(problem: Problem, names: Sequence[str], shifted: Sequence[str]) -> ca.Function:
    """Function (state, command that acted, parameters, shift) -> what the sensors show without noise, rounded as they round.

    `shifted`: names of the quantities to which the entries of the shift are added.
    """
    (x, u, p), shift = problem.plant.symbols(), ca.SX.sym("shift", len(shifted))
    values = values_of(problem.plant, x, u, p)
    values |= {name: values[name] + one for name, one in zip(shifted, ca.vertsplit(shift), strict=True)}
    shown = [problem.sensing.rounded(name, values[name]) for name in names]
    return ca.Function("fpirhc_mirror_seen", [x, u, p, shift], [ca.densify(ca.vertcat(*shown))])


def memory_moves(problem: Problem, names: Sequence[str]) -> list[ca.DM]:
    """Return the matrices that turn a move of the estimated state, or outputs, into moves of what the estimator remembers.

    What is remembered at a start is linear in the start; a cycle later the start would have been on the same path.
    """
    motion = problem.plant.output
    ahead, size = drift(motion, problem.period), motion.size
    columns = [_remembered(problem, names, unit) for unit in (np.zeros(size), *np.eye(size))]
    return [ca.DM(np.column_stack([c[k] - columns[0][k] for c in columns[1:]]) @ ahead) for k in range(len(columns[0]))]


def _remembered(problem: Problem, names: Sequence[str], start: np.ndarray) -> list[np.ndarray]:
    """What the estimator remembers at a start, signal by signal."""
    block = problem.sensing.estimator.block(problem.plant, problem.period, start, Signal("_seen", tuple(names)))
    return [m.start_vector() for m in block.memory.signals]


def drift(motion: Signal, time: float) -> np.ndarray:
    """Return the matrix by which a motion goes on for that time while all highest derivatives are zero: Taylor's formula."""
    elements = motion.elements
    drift = np.zeros((len(elements), len(elements)))
    for k, element in enumerate(elements):
        for j, other in enumerate(elements):
            power = len(other) - len(element)
            if other.rstrip("'") == element.rstrip("'") and power >= 0:
                drift[k, j] = time**power / math.factorial(power)
    return drift


class _Outputs:
    """A model that moves over a cycle from the state that is given, x_{k-1}, to x^ = F(x_{k-1}, u), and shows its outputs there.

    Outputs that the model computes are not the measured ones, so it has an offset o, a polynomial in y ... y^(r-1) as the plans
    have: y~_k = y^(x^) + o_k. After each cycle the offset is moved to where the estimate of the twin is the controller's, and it
    takes up the difference between x^ and the state that is given next.

    Behind a fraction phi of a cycle the state that is given is interpolated, and moves as the plant does with the mean of the
    commands that acted; see `fpirhc.controllers.observed_state.sample_path`.
    """

    def __init__(self, path: CommandPath) -> None:
        self._path, problem, plant = path, path.problem, path.problem.plant
        names, inputs = problem.sensing.estimator.measures(plant), plant.input.elements
        self.start = problem.start_output
        self.reads = measured_output(plant), measured_state(plant)
        self._ahead = ca.DM(drift(plant.output, problem.period))
        self._advance, self._chain = problem.integrator.step(plant, problem.period), _chain(problem)
        self._seen, self._calm = _seen(problem, names, plant.output.elements), np.zeros(len(plant.names))
        rest = tuple(map(float, [*problem.inputs_before] * 2))
        acted = Signal(_ACTED, (*(f"{e}.end" for e in inputs), *(f"{e}.mean" for e in inputs)), start=rest)
        self.memory = (*_starts(problem), *((acted,) if path.fraction else ()))

    def sample(
        self, s: Signals, end: Expression, mean: Expression, parameters: Expression, waits: Expression
    ) -> tuple[Expression, Expression | None, After]:
        """Return the sample of the cycle, nothing that it adds to the response, and what is remembered after a move."""
        path, part, remembered = self._path, self._path.fraction, dict[str, Expression]()
        if part:
            whole = path.cycles(s) > path.late + 1.5
            remembered[f"{_ACTED}_next"] = ca.vertcat(end, mean)
            both = (1 - part) * ca.vertcat(end, mean) + part * getattr(s, _ACTED)
            end, mean = ca.vertsplit(ca.if_else(whole, both, ca.vertcat(end, mean)), path.last.size)
            if path.signalled:
                older = (1 - part) * parameters + part * path.parameters_before(s)
                parameters = ca.if_else(whole, older, parameters)
        later = self._advance(s.mirror_state, mean, parameters, self._calm)
        later = ca.if_else(whole, later, s.mirror_state + (1 - part) * (later - s.mirror_state)) if part else later
        at = ca.if_else(waits, s.mirror_state, later)
        offset = ca.if_else(waits, s.mirror_offset, self._ahead @ s.mirror_offset)

        def after(move: Expression) -> dict[str, Expression]:
            measured = getattr(s, MEASURED)
            measured = ca.if_else(is_finite(measured), measured, at)
            turn = self._chain(at, end, parameters) - self._chain(measured, end, parameters)
            return {f"{_STATE}_next": measured, f"{_OFFSET}_next": offset + move + turn, **remembered}

        return self._seen(at, end, parameters, offset), None, after


def _starts(problem: Problem) -> tuple[Signal, Signal]:
    """The state that was given last, and the offset of the model's outputs from the real ones."""
    plant, start = problem.plant, problem.start_state
    own = np.asarray(_chain(problem)(start, problem.inputs_before, plant.approximate).full()).ravel()
    offset = tuple(map(float, problem.start_output - own))
    return (
        Signal(_STATE, plant.state.elements, plant.state.units, tuple(map(float, start))),
        Signal(_OFFSET, plant.output.elements, plant.output.units, offset),
    )


def _chain(problem: Problem) -> ca.Function:
    """Function (state, command, parameters) -> the model's outputs and their derivatives below the relative order."""
    plant = problem.plant
    x, u, p = plant.symbols()
    entries = plant.equations.output(x, u, p, np.zeros(len(plant.names)))
    return ca.Function("fpirhc_mirror_chain", [x, u, p], [entries])
