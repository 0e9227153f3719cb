"""The one path from commands to what a controller is given, as whoever stands behind it believes it.

    command -> dead time -> lag -> model over a cycle -> sensors -> dead time, whole cycles -> estimator

| behind it | is given | by |
|---|---|---|
| the parallel model of `ModelReferenced` | the model's response, as late as the plant's | `model_blocks` |
| an observer | what acted until a sample was taken | `believe_block` |
| a learner | the state and the command of a response | `Pairs` |

A model is compared with a response that ends a cycle, so it is given the signals from outside of the last cycle. Its dead times are
whole cycles, those of the plant may be any. What really moves is in `fpirhc.simulation.path`. Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.deformation.base import Deformation
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.integrators import Integrator, RungeKutta4
from fpirhc.plant.maps import response_age
from fpirhc.plant.motion import controlled_places, time_signal
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Evidence, Model, response_names, values_of
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, expression, is_finite, total
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import left_after, left_in_mean, numbers, stays
from fpirhc.task.dead_time import DeadTime, Queue, every, whole
from fpirhc.task.exogenous import Exogenous, known_places, model_values, rows_of
from fpirhc.task.problem import Problem

ACTED, NOW = "_signals_acted", "_parameters_now"  # what a model is told of the last cycle, and of this one
# What is measured, where a controller may act on what is predicted.
MEASURED, MEASURED_OUTPUT, MEASURED_TIME = "_measured_state", "_measured_output", "_measured_time"


# ---- what a model is told, and what acted -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Told:
    """What a model is told of signals from outside."""

    plant: Plant
    signals: Mapping[str, Exogenous]  # from outside, by name
    period: float

    @cached_property
    def places(self) -> list[int]:
        """Places among the parameters of the signals of which it is told something."""
        return list(known_places(self.plant, self.signals))

    @property
    def reads(self) -> tuple[Signal, ...]:
        """The signals of the last cycle, in the first cycle those of the cycle itself; nothing where it is told nothing."""
        if not self.places:
            return ()
        plant, at = self.plant, np.array([self.period / 2])
        first = rows_of(model_values(plant, self.signals), at, plant.approximate)[0][self.places]
        names, units = (tuple(v[k] for k in self.places) for v in (plant.parameter.elements, plant.parameter.units))
        return (Signal(ACTED, names, units, tuple(map(float, first))),)

    def block(self, *, remembers: bool) -> Block | None:
        """Block (time, parameters) -> parameters of this cycle, and the signals of the last one where it `remembers`."""
        values = model_values(self.plant, self.signals)
        if values is None:
            return None
        parameter, half, (acted,) = self.plant.parameter, self.period / 2, self.reads
        last = replace(acted, name="signals_last")

        def step(s: Signals) -> dict[str, Expression]:
            now = values(s.time + half, s.parameters)
            return {NOW: now, ACTED: s.signals_last, "signals_last_next": now[self.places]} if remembers else {NOW: now}

        writes = Layout((Signal(NOW, parameter.elements, parameter.units), *((acted,) * remembers)))
        reads, memory = Layout((time_signal(self.plant), parameter)), Layout((last,) * remembers)
        return Block("signals", reads, writes, step, memory, not values.is_a("SXFunction"))


class Acted(NamedTuple):
    """What acted in the cycle that a sample ends."""

    end: Expression  # input at the end of the cycle
    mean: Expression  # and in the mean over it
    parameters: Expression  # of the model, with the signals of that cycle
    age: Expression  # number of samples of this run before this one; below 0 it is from before the run
    later: dict[str, Expression]  # what is remembered


@dataclass(frozen=True, eq=False)
class Path:
    """The way of the commands to a sample."""

    problem: Problem  # with the model
    name: str  # begins the names of what is remembered
    last: Signal  # the command of the last cycle
    inputs: Queue  # how late commands are
    late: int = 0  # cycles by which samples are late
    lag: float | tuple[float, ...] = 0.0  # time constant of the actuators, one for all or one for each

    @property
    def reads(self) -> tuple[Signal, ...]:
        """The last command, the parameters, and the signals of the last cycle."""
        return (self.last, self.problem.plant.parameter, *self._told.reads)

    @cached_property
    def memory(self) -> tuple[Signal, ...]:
        """Commands and signals on their way, positions of lagging actuators, and the number of cycles."""
        inputs, start = self.problem.plant.input, tuple(map(float, self.problem.inputs_before))
        told = [Queue(self.late).memory(f"{self.name}_signals", t.elements, t.start) for t in self._told.reads]
        return (
            *self.waits.memory(f"{self.name}_commands", inputs.elements, start),
            *(Signal(f"{self.name}_actuators", inputs.elements, inputs.units, start),) * self._lags,
            scalar(f"{self.name}_cycles"),
            *(signal for signals in told for signal in signals),
        )

    def acted(self, s: Signals) -> Acted:
        """Return what acted, and what is remembered."""
        end, later = self.waits.arrived(s, f"{self.name}_commands", getattr(s, self.last.name))
        mean, parameters = end, s.parameters
        if self._lags:
            taus, period = every(self.lag), self.problem.period
            left, share = (numbers([f(period, t) for t in taus], end) for f in (left_after, left_in_mean))
            away = getattr(s, f"{self.name}_actuators") - end
            end, mean = end + left * away, end + share * away
            later[f"{self.name}_actuators_next"] = end
        if self._told.places:
            acted, signals = Queue(self.late).arrived(s, f"{self.name}_signals", getattr(s, ACTED))
            values = dict(zip(self._told.places, ca.vertsplit(acted), strict=True))
            parameters = ca.vertcat(*(values.get(k, s.parameters[k]) for k in range(s.parameters.numel())))
            later |= signals
        cycles = getattr(s, f"{self.name}_cycles")
        later[f"{self.name}_cycles_next"] = ca.fmin(cycles + 1, self.late + 1)
        return Acted(end, mean, parameters, cycles - self.late, later)

    @cached_property
    def waits(self) -> Queue:
        """How late the commands are that acted when a sample was taken."""
        return self.inputs.later(self.late)

    @property
    def _lags(self) -> bool:
        return not all(stays(t, 0.0) for t in every(self.lag))

    @cached_property
    def _told(self) -> Told:
        return Told(self.problem.plant, self.problem.signals, self.problem.period)


def believed_path(problem: Problem, deformation: Deformation, name: str = "mirror") -> Path:
    """Return the way of the commands as a deformation believes it; `name` begins the names of what is remembered."""
    mirror, inputs = deformation.mirror, problem.plant.input
    last = Signal("_command_before", inputs.elements, inputs.units)
    return Path(problem, name, last, Queue(mirror.cycles), whole(mirror.measurement), mirror.lag)


def stated_path(problem: Problem) -> Path:
    """Return the way of the commands as the problem states it, in whole cycles."""
    inputs, late, period = problem.plant.input, problem.dead_time, problem.period
    waits = Queue(tuple(whole(late.inputs.get(name, 0.0) / period) for name in inputs.elements))
    last = Signal("_commanded", inputs.elements, inputs.units, tuple(map(float, problem.inputs_before)))
    return Path(problem, "observer", last, waits, whole(late.measurement / period))


# ---- the parallel model -----------------------------------------------------------------------------------------------------


class Answers(NamedTuple):
    """The responses that a model gives."""

    response: Callable[[Expression, Expression, Expression], Expression]  # function of (state, input, parameters)
    orders: Mapping[str, int]  # of the responses, by name
    signal: Signal  # that holds them


def model_blocks(path: Path) -> tuple[list[Block], list[Delay]]:
    """Return the block that writes '_modelled', the response that a model-referenced map reads, and what it remembers."""
    estimator, plant = path.problem.sensing.estimator, path.problem.plant
    if estimator.of_steps or estimator.shows_response:
        return [answer_block(path)], []
    if plant.outputs:
        return [_twin(path, _Beside(path))], []
    return [_twin(path, _Forced(path))], [Delay(plant.response_signal(BEFORE), "_deformation")]


def answer_block(path: Path, answers: Answers | None = None) -> Block:
    """Block (measured state, last command, parameters) -> the model's response at what is measured: nothing can drift.

    On a map it is that of the cycle before. A response of relative order r of a map is complete r cycles after its command, so the
    model's waits as long: modelled_k = y^_r(x_{k-r}, u_{k-r}), u the input that acted then. `answers`: None: the controlled ones.
    """
    plant = path.problem.plant
    orders = {name: plant.chains[name] for name in plant.controlled_names}
    given = answers or Answers(plant.equations.controlled_response, orders, plant.response_signal("_modelled"))
    age, start = response_age(plant), tuple(map(float, path.problem.start_state))
    before = replace(plant.state, name=f"{path.name}_state_before", start=start)
    waits = [Queue(age * (order - 1)) for order in given.orders.values()]
    queues = [w.memory(f"{path.name}_{name}", (name,), (0.0,)) for name, w in zip(given.orders, waits, strict=True)]

    def step(s: Signals) -> dict[str, Expression]:
        acted = path.acted(s)
        at = getattr(s, before.name if age else MEASURED)
        shown: list[Expression] = []
        later = {f"{before.name}_next": getattr(s, MEASURED)} if age else {}
        values = ca.vertsplit(given.response(at, acted.end, acted.parameters))
        for name, wait, value in zip(given.orders, waits, values, strict=True):
            arrived, queue = wait.arrived(s, f"{path.name}_{name}", value)
            shown, later = [*shown, arrived], later | queue
        return {given.signal.name: ca.vertcat(*shown), **acted.later, **later}

    memory = (*path.memory, *((before,) * age), *(signal for queue in queues for signal in queue))
    return Block(path.name, Layout((measured_state(plant), *path.reads)), Layout((given.signal,)), step, Layout(memory))


BEFORE = "_deformation_before"
# a sample, what is added to the response that is estimated of it, and what is remembered after a move of the estimate
Sample: TypeAlias = tuple[Expression, Expression | float, Callable[[Expression], dict[str, Expression]]]


def _twin(path: Path, model: _Beside | _Forced) -> Block:
    """Block (what is measured, last command, parameters) -> the model's response behind sensors and estimator.

    The model shows a sample, the estimator makes a state and a response of it, and whatever separates this state from the measured
    one moves the model and what the estimator remembers, so that the samples stay on one path.
    """
    problem, plant, estimator = path.problem, path.problem.plant, path.problem.sensing.estimator
    names = estimator.measures(plant)
    estimate = estimator.block(plant, problem.period, model.start, Signal("_seen", names))
    own = tuple(replace(m, name=f"mirror_{m.name}") for m in estimate.memory.signals)
    moves = _memory_moves(problem, names)

    def step(s: Signals) -> dict[str, Expression]:
        acted = path.acted(s)
        sample, adds, after = model.sample(s, acted)
        shown, response, *memories = estimate.function(sample, *(getattr(s, m.name) for m in own))
        away = getattr(s, model.reads[0].name) - shown
        move = ca.if_else(is_finite(away), away, 0)  # what is not finite must not be remembered
        later = acted.later | after(move)
        for signal, value, matrix in zip(own, memories, moves, strict=True):
            later[f"{signal.name}_next"] = value + matrix @ move
        return {"_modelled": response + adds, **later}

    reads, memory = Layout((*model.reads, *path.reads)), Layout((*path.memory, *model.memory, *own))
    return Block(
        "mirror", reads, Layout((plant.response_signal("_modelled"),)), step, memory, problem.integrator.opaque
    )


class _Forced:
    """A model that goes on by itself under the commands, forced by the deformations of the past with the other sign.

    So it moves as the plant would if the model were right. The response that the estimator makes of a deformation is added.
    """

    def __init__(self, path: Path) -> None:
        problem, plant = path.problem, path.problem.plant
        self.start, self.reads = problem.start_state, (measured_state(plant), plant.response_signal(BEFORE))
        self._advance, self._places = problem.integrator.step(plant, problem.period), controlled_places(plant)
        self._seen = _seen(problem, response_names(plant))
        names, estimator = plant.controlled_names, problem.sensing.estimator
        self._weights = [estimator.weights(plant.orders[k], problem.period) for k in self._places]
        self._waits = path.waits
        length = max(max(w.size for w in self._weights) - 1, 1) + self._waits.length - 1
        past = tuple(f"{e}@{k}" for k in range(1, length + 1) for e in names)
        state = replace(plant.state, name="mirror_state", start=tuple(map(float, self.start)))
        self.memory = (state, Signal("mirror_deformations", past))

    def sample(self, s: Signals, acted: Acted) -> Sample:
        """Return the sample of the cycle, what is added to its response, and what is remembered after a move."""
        column, size = ca.vertcat(getattr(s, BEFORE), s.mirror_deformations), len(self._places)
        late = [self._waits.delayed(column[size * j :], size) for j in range(max(w.size for w in self._weights))]
        forcing: list[Expression] = [expression(0.0)] * self._advance.numel_in(3)
        for place, value in zip(self._places, ca.vertsplit(late[0]), strict=True):
            forcing[place] = -value
        moved = self._advance(s.mirror_state, acted.mean, acted.parameters, ca.vertcat(*forcing))
        at = ca.if_else(acted.age < 0.5, s.mirror_state, moved)
        adds = [total(v * late[j][k] for j, v in enumerate(w) if v != 0) for k, w in enumerate(self._weights)]
        later = {"mirror_deformations_next": column[: self.memory[1].size]}
        seen = self._seen(at, acted.end, acted.parameters, -late[0])
        return seen, ca.vertcat(*adds), lambda move: {"mirror_state_next": at + move, **later}


class _Beside:
    """A model that moves over a cycle from the state that is given, x_{k-1}, to x^ = F(x_{k-1}, u), and shows its outputs there.

    Outputs that the model computes are not the measured ones, so it has an offset o, a polynomial in y ... y^(r-1) as the plans
    have: y~_k = y^(x^) + o_k. After each cycle the offset is moved to where the estimate of the twin is the controller's, and it
    takes up the difference between x^ and the state that is given next.
    """

    def __init__(self, path: Path) -> None:
        problem, plant = path.problem, path.problem.plant
        self.start, self.reads = problem.start_output, (measured_output(plant), measured_state(plant))
        self._advance, self._calm = problem.integrator.step(plant, problem.period), np.zeros(len(plant.names))
        self._seen, self._ahead = _seen(problem, plant.output.elements), ca.DM(_drift(plant.output, problem.period))
        x, u, p = plant.symbols()
        self._chain = ca.Function("fpirhc_mirror_chain", [x, u, p], [plant.equations.output(x, u, p, self._calm)])
        own = self._chain(problem.start_state, problem.inputs_before, plant.approximate).full().ravel()
        state = replace(plant.state, name="mirror_state", start=tuple(map(float, problem.start_state)))
        self.memory = (state, replace(plant.output, name="mirror_offset", start=tuple(map(float, self.start - own))))

    def sample(self, s: Signals, acted: Acted) -> Sample:
        """Return the sample of the cycle, nothing that is added to its response, and what is remembered after a move."""
        waits, end, parameters = acted.age < 0.5, acted.end, acted.parameters
        moved = self._advance(s.mirror_state, acted.mean, parameters, self._calm)
        at = ca.if_else(waits, s.mirror_state, moved)
        offset = ca.if_else(waits, s.mirror_offset, self._ahead @ s.mirror_offset)

        def after(move: Expression) -> dict[str, Expression]:
            measured = getattr(s, MEASURED)
            measured = ca.if_else(is_finite(measured), measured, at)
            turn = self._chain(at, end, parameters) - self._chain(measured, end, parameters)
            return {"mirror_state_next": measured, "mirror_offset_next": offset + move + turn}

        return self._seen(at, end, parameters, offset), 0.0, after


def _seen(problem: Problem, shifted: Sequence[str]) -> ca.Function:
    """Function (state, input, parameters, shift) -> what the sensors show, in whole quanta; the shift is added to `shifted`."""
    plant, names = problem.plant, problem.sensing.estimator.measures(problem.plant)
    (x, u, p), shift = plant.symbols(), ca.SX.sym("shift", len(shifted))
    values = values_of(plant, x, u, p)
    values |= {name: values[name] + one for name, one in zip(shifted, ca.vertsplit(shift), strict=True)}
    shown = [problem.sensing.rounded(name, values[name]) for name in names]
    return ca.Function("fpirhc_mirror_seen", [x, u, p, shift], [ca.densify(ca.vertcat(*shown))])


def _memory_moves(problem: Problem, names: Sequence[str]) -> list[ca.DM]:
    """Matrices that turn a move of the estimate into moves of what the estimator remembers, which is linear in its start."""
    plant, seen = problem.plant, Signal("_seen", tuple(names))

    def remembered(start: np.ndarray) -> list[np.ndarray]:
        block = problem.sensing.estimator.block(plant, problem.period, start, seen)
        return [m.start_vector() for m in block.memory.signals]

    rest, *columns = map(remembered, (np.zeros(plant.output.size), *np.eye(plant.output.size)))
    ahead = _drift(plant.output, problem.period)  # a cycle later the start would have been on the same path
    return [ca.DM(np.column_stack([c[k] - rest[k] for c in columns]) @ ahead) for k in range(len(rest))]


def _drift(motion: Signal, time: float) -> np.ndarray:
    """Matrix by which a motion goes on for that time while all highest derivatives are zero: Taylor's formula."""
    powers = [
        [len(o) - len(e) if o.rstrip("'") == e.rstrip("'") else -1 for o in motion.elements] for e in motion.elements
    ]
    return np.array([[time**k / math.factorial(k) if k >= 0 else 0.0 for k in row] for row in powers])


# ---- the observer -----------------------------------------------------------------------------------------------------------


def believe_block(problem: Problem, raw: Signal, shown: np.ndarray) -> Block:
    """Block (raw measurements, parameters, last command) -> (state, [output], realised).

        model predicts -> what no sensor shows is taken from the prediction -> estimator -> observer corrects

    `shown`: first state, or outputs, that the sensors see; the estimator begins there.
    """
    plant, sensing, path = problem.plant, problem.sensing, stated_path(problem)
    observer, names = sensing.observer, sensing.estimator.measures(plant)
    assert observer is not None
    estimate = sensing.estimator.block(plant, problem.period, shown, Signal("_completed", names))
    model = observed_model(problem)
    predict, correct, own = observer.predict(model), observer.correct(model), observer.memory(model)

    def step(s: Signals) -> dict[str, Expression]:
        acted, memory = path.acted(s), {m: getattr(s, m) for m in own.names}
        measured = dict(zip(raw.elements, ca.vertsplit(getattr(s, raw.name)), strict=True))
        evidence = Evidence(measured, acted.end, acted.parameters, acted.age > 0.5, acted.age > -0.5)
        predicted = predict(evidence, memory)
        completed = {**values_of(plant, predicted, acted.end, acted.parameters), **measured}
        past = [getattr(s, m) for m in estimate.memory.names]
        motion, realised, *later = estimate.function(ca.vertcat(*(completed[n] for n in names)), *past)
        state, following = correct(evidence, memory, predicted)
        following = following | dict(zip(estimate.memory.names, later, strict=True))
        results = {plant.output.name: motion, "state": state, "realised": realised, **acted.later}
        return results | {f"{m}_next": value for m, value in following.items()}

    reads, memory = Layout((raw, *path.reads)), Layout((*path.memory, *own.signals)) + estimate.memory
    writes = Layout((*measured_signals(plant), plant.response_signal("realised")))
    return Block("believe", reads, writes, step, memory)


def observed_model(problem: Problem) -> Model:
    """Return what the observer is built from: the model over a cycle, or at rest where a sample still shows the start."""
    plant, integrator = problem.plant, believed_integrator(problem)
    (x, u, p), w, moves = plant.symbols(), ca.SX.sym("w", len(plant.names)), ca.SX.sym("moves")
    later = ca.if_else(moves, integrator.step(plant, problem.period)(x, u, p, w), x)
    move = ca.Function("fpirhc_move", [x, u, p, w, moves], [later])
    return Model(plant, move, problem.start_state, problem.sensing.measures(plant))


def believed_integrator(problem: Problem) -> Integrator:
    """Return the integrator of the model: the problem's, or a Runge-Kutta step where that is a call without Jacobian."""
    return RungeKutta4() if problem.integrator.opaque else problem.integrator


# ---- the learner ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Pairs:
    """The state and the command to which a measured response belongs, behind dead time and an estimator.

        f_k = response at x_{k-D} to u_{k-1-D-d},      d: dead time of input and measurement, D: delay of the estimator, in cycles

    A measured state is as late as the response, by the dead time of the measurement, so it waits for the estimator's delay alone;
    the command waits for all three. Sums are rounded to the nearest whole cycles.
    """

    problem: Problem  # with the plant that is measured
    dead_time: DeadTime  # that is believed
    with_outputs: bool = False  # whether the measured outputs of that instant belong to a pair
    age: int = 0  # cycles by which the state is older; a map's response belongs to the state of the cycle before

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
        """The signal of the measured outputs."""
        return measured_output(self.problem.plant) if self.waiting else self.problem.plant.output

    @property
    def cycles(self) -> float:
        """Number of the first cycle whose pair belongs to this run: before it, samples show the start."""
        late = self.dead_time.measurement / self.problem.period
        return max(self.problem.sensing.warm_up_cycles(self.problem.plant, late), math.ceil(late - 1e-9) + 1)

    @property
    def late(self) -> float:
        """How long before the cycle the response was realised, in units of time."""
        return self.dead_time.measurement + self._delay * self.problem.period

    @property
    def memory(self) -> tuple[Signal, ...]:
        """Past states, commands and outputs."""
        kept = [(self._states, self.problem.plant.state, self.problem.start_state)]
        kept += [(self._commands, self.problem.plant.input, self.problem.inputs_before)]
        kept += [(self._states, self.problem.plant.output, self.problem.start_output)] * self.with_outputs
        places = zip(("pair_states", "pair_commands", "pair_outputs"), kept, strict=False)
        return tuple(
            m for name, (queue, one, start) in places for m in queue.memory(name, one.elements, start.tolist())
        )

    def pair(self, s: Signals, newest: Expression) -> tuple[Expression, Expression, dict[str, Expression]]:
        """Return state and command of the response, and what is remembered."""
        state, states = self._states.arrived(s, "pair_states", getattr(s, self.state.name))
        command, commands = self._commands.arrived(s, "pair_commands", newest)
        return state, command, {**states, **commands}

    def output(self, s: Signals) -> tuple[Expression | None, dict[str, Expression]]:
        """Return the measured outputs of that instant, and what is remembered; None where they do not belong to a pair."""
        return self._states.arrived(s, "pair_outputs", getattr(s, self.seen.name)) if self.with_outputs else (None, {})

    @cached_property
    def _delay(self) -> float:
        return self.problem.sensing.delay(self.problem.plant, self.problem.period)

    @property
    def _states(self) -> Queue:
        return Queue(whole(self._delay) + self.age)

    @property
    def _commands(self) -> Queue:
        late, period = self.dead_time, self.problem.period
        waits = (late.inputs.get(name, 0.0) + late.measurement for name in self.problem.plant.inputs)
        return Queue(tuple(whole(wait / period + self._delay) for wait in waits))


# ---- what is measured, where a controller acts on what is predicted -------------------------------------------------------------


def measured_state(plant: Plant) -> Signal:
    """Return the signal of the measured state, which the response belongs to."""
    return Signal(MEASURED, plant.state.elements, plant.state.units)


def measured_output(plant: Plant) -> Signal:
    """Return the signal of the outputs of the same instant."""
    return Signal(MEASURED_OUTPUT, plant.output.elements, plant.output.units)
