"""The one path from commands to what a controller is given, as whoever stands behind it believes it.

    command -> dead time -> lag -> model over a cycle -> sensors -> dead time, whole cycles -> estimator

| behind it | is given | by |
|---|---|---|
| the parallel model of `ModelReferenced` | the model's response, as late as the plant's | `model_block` |
| an observer | what acted until a sample was taken | `believe_block` |
| a learner | the state and the command of a response | `Pairs` |

A model is compared with a response that ends a cycle, so it is given the signals from outside of the last cycle. Its dead times are
whole cycles, those of the plant may be any. What really moves is in `fpirhc.simulation.moved`. Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from fpirhc.deformation.base import Deformation
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Evidence, Model, values_of
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, is_finite, left_after, left_in_mean
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.dead_time import DeadTime, Queue, every, whole
from fpirhc.task.exogenous import Exogenous, model_values, really_known, rows_of, signals_of
from fpirhc.task.problem import Problem

if TYPE_CHECKING:
    from fpirhc.controllers.contract import Controller

ACTED, NOW = "_signals_acted", "_parameters_now"  # what a model is told of the last cycle, and of this one


@dataclass(frozen=True, eq=False)
class PlantModel:
    """What a controller knows of its plant."""

    plant: Plant  # equations of the model
    signals: Mapping[str, Exogenous]  # measured disturbances, with their preview
    exact: bool = False  # whether its parameters are the exact ones

    @property
    def parameter(self) -> Signal:
        """The signal of its parameters, with the values that they have at first."""
        return replace(self.plant.parameter, start=tuple(map(float, self.parameters(self.plant))))

    def parameters(self, plant: Plant) -> np.ndarray:
        """Return the parameters with which the controller evaluates a plant, shape (np,)."""
        return plant.exact if self.exact else plant.approximate


def plant_model(problem: Problem, controller: Controller) -> PlantModel:
    """Return what the controller knows of its plant: the problem's equations, parameters and signals, or the real ones."""
    if not controller.exact_model:
        return PlantModel(problem.plant, problem.signals)
    return PlantModel(problem.moves.as_model(problem.plant), really_known(problem.signals), exact=True)


@dataclass(frozen=True, eq=False)
class Told:
    """What a model is told of signals from outside."""

    plant: Plant
    signals: Mapping[str, Exogenous]  # from outside, by name
    period: float

    @cached_property
    def places(self) -> list[int]:
        """Places among the parameters of the signals of which it is told something."""
        every = signals_of(self.plant, self.signals)
        return [self.plant.parameter.elements.index(name) for name, one in every.items() if one.told]

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
        reads, memory = Layout((self.plant.time, parameter)), Layout((last,) * remembers)
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
            left, share = (ca.vertcat(*(f(period, t) for t in taus)) for f in (left_after, left_in_mean))
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
        return any(every(self.lag))

    @cached_property
    def _told(self) -> Told:
        return Told(self.problem.plant, self.problem.signals, self.problem.period)


def believed_path(problem: Problem, deformation: Deformation) -> Path:
    """Return the way of the commands as a deformation believes it."""
    form, inputs = deformation.form, problem.plant.input
    last = Signal("_command_before", inputs.elements, inputs.units)
    return Path(problem, "mirror", last, Queue(form.cycles), whole(form.measurement), form.lag)


def stated_path(problem: Problem) -> Path:
    """Return the way of the commands as the problem states it, in whole cycles."""
    inputs, late, period = problem.plant.input, problem.dead_time, problem.period
    waits, seen = Queue(late.input_cycles(inputs.elements, period)), late.measurement_cycles(period)
    last = Signal("_commanded", inputs.elements, inputs.units, tuple(map(float, problem.inputs_before)))
    return Path(problem, "observer", last, waits, seen)


def model_block(path: Path) -> Block:
    """Block that writes '_modelled', the response that a model-referenced map reads in place of its last request."""
    return _twin(path) if path.problem.sensing.spreads(path.problem.plant) else answer_block(path)


def answer_block(path: Path) -> Block:
    """Block (measured state, last command, parameters) -> the model's response at what is measured: nothing can drift.

    On a map it is that of the cycle before. A response of relative order r of a map is complete r cycles after its command, so the
    model's waits as long: modelled_k = y^_r(x_{k-r}, u_{k-r}), u the input that acted then.
    """
    plant, modelled = path.problem.plant, path.problem.plant.response_signal("_modelled")
    states, before, seen = Queue(plant.response_age), f"{path.name}_state", measured(plant.state)
    waits = [Queue(max(count - 1, 0)) for count in plant.differences.values()]
    names = [f"{path.name}_{name}" for name in plant.controlled_names]
    queues = [w.memory(queue, (e,), (0.0,)) for queue, w, e in zip(names, waits, modelled.elements, strict=True)]

    def step(s: Signals) -> dict[str, Expression]:
        acted = path.acted(s)
        at, later = states.arrived(s, before, getattr(s, seen.name))
        shown: list[Expression] = []
        values = ca.vertsplit(plant.equations.controlled_response(at, acted.end, acted.parameters))
        for name, wait, value in zip(names, waits, values, strict=True):
            arrived, queue = wait.arrived(s, name, value)
            shown, later = [*shown, arrived], later | queue
        return {modelled.name: ca.vertcat(*shown), **acted.later, **later}

    past = states.memory(before, seen.elements, path.problem.start_state.tolist())
    memory = (*path.memory, *past, *(signal for queue in queues for signal in queue))
    return Block(path.name, Layout((seen, *path.reads)), Layout((modelled,)), step, Layout(memory))


def _twin(path: Path) -> Block:
    """Block (what is measured, last command, parameters) -> the model's response behind sensors and estimator."""
    problem, plant, estimator = path.problem, path.problem.plant, path.problem.sensing.estimator
    names, calm = estimator.measures(plant), np.zeros(len(plant.names))
    given, given_state = measured(plant.output), measured(plant.state)
    estimate = estimator.block(plant, problem.period, problem.start_output, Signal("_seen", names))
    own = tuple(replace(m, name=f"mirror_{m.name}") for m in estimate.memory.signals)
    moves, ahead = _memory_moves(problem, names), ca.DM(_drift(plant.output, problem.period))
    advance, seen = problem.integrator.step(plant, problem.period), _seen(problem)
    x, u, p = plant.symbols()
    outputs = ca.Function("fpirhc_mirror_outputs", [x, u, p], [plant.equations.output(x, u, p, calm)])
    first = outputs(problem.start_state, problem.inputs_before, plant.approximate).full().ravel()
    state = replace(plant.state, name="mirror_state", start=tuple(map(float, problem.start_state)))
    offsets = replace(plant.output, name="mirror_offset", start=tuple(map(float, problem.start_output - first)))

    def step(s: Signals) -> dict[str, Expression]:
        end, mean, parameters, age, later = path.acted(s)
        at = ca.if_else(age < 0.5, s.mirror_state, advance(s.mirror_state, mean, parameters, calm))
        # Outputs of the model are not the measured ones: the sensors are shown y^(x^) + o, with o a polynomial in y ... y^(r-1).
        offset = ca.if_else(age < 0.5, s.mirror_offset, ahead @ s.mirror_offset)
        past = [getattr(s, m.name) for m in own]
        shown, response, *memories = estimate.function(seen(at, end, parameters, offset), *past)
        believed, away = getattr(s, given_state.name), getattr(s, given.name) - shown
        # What separates the outputs moves the offset and what the estimator remembers, so the samples stay on one path.
        move = ca.if_else(is_finite(away), away, 0)  # what is not finite must not be remembered
        told = ca.if_else(is_finite(believed), believed, at)
        # The next cycle begins at the state that is given. One that outputs show is estimated, so it is late and noisy: there the
        # model keeps its own, put where the sensors show it, and an exact model answers as the plant does, to rounding.
        of_model = outputs(at, end, parameters)
        begins = plant.equations.state_of(of_model + offset + move, told)
        turn = of_model - outputs(begins, end, parameters)
        later |= {"mirror_state_next": begins, "mirror_offset_next": offset + move + turn}
        moved = zip(own, memories, moves, strict=True)
        return {"_modelled": response, **later, **{f"{m.name}_next": v + matrix @ move for m, v, matrix in moved}}

    reads = {signal.name: signal for signal in (given, given_state, *path.reads)}
    memory, writes = (*path.memory, state, offsets, *own), (plant.response_signal("_modelled"),)
    return Block("mirror", Layout(tuple(reads.values())), Layout(writes), step, Layout(memory))


def _seen(problem: Problem) -> ca.Function:
    """Function (state, input, parameters, offset of the outputs) -> what the sensors show, in whole quanta."""
    plant, names = problem.plant, problem.sensing.estimator.measures(problem.plant)
    (x, u, p), offset = plant.symbols(), ca.SX.sym("offset", plant.output.size)
    values = values_of(plant, x, u, p)
    values |= {e: values[e] + one for e, one in zip(plant.output.elements, ca.vertsplit(offset), strict=True)}
    shown = [problem.sensing.rounded(name, values[name]) for name in names]
    return ca.Function("fpirhc_mirror_seen", [x, u, p, offset], [ca.densify(ca.vertcat(*shown))])


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
    writes = Layout((*plant.motion, plant.response_signal("realised")))
    return Block("believe", reads, writes, step, memory)


def observed_model(problem: Problem) -> Model:
    """Return what the observer is built from: the model over a cycle, or at rest where a sample still shows the start."""
    plant, integrator = problem.plant, problem.integrator
    (x, u, p), w, moves = plant.symbols(), ca.SX.sym("w", len(plant.names)), ca.SX.sym("moves")
    later = ca.if_else(moves, integrator.step(plant, problem.period)(x, u, p, w), x)
    move = ca.Function("fpirhc_move", [x, u, p, w, moves], [later])
    return Model(plant, move, problem.start_state, problem.sensing.measures(plant))


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
    def state(self) -> Signal:
        """The signal of the measured state; behind dead time a controller may act on a predicted one."""
        return measured(self.problem.plant.state)

    @property
    def seen(self) -> Signal:
        """The signal of the measured outputs."""
        return measured(self.problem.plant.output)

    @property
    def cycles(self) -> float:
        """Number of the first cycle whose pair belongs to this run: before it, samples show the start."""
        late = self.dead_time.measurement / self.problem.period
        return max(self.problem.sensing.warm_up_cycles(self.problem.plant, late), Queue(late).length)

    @property
    def memory(self) -> tuple[Signal, ...]:
        """Past states, commands and outputs."""
        kept = [(self._states, self.problem.plant.state, self.problem.start_state)]
        kept += [(self._commands, self.problem.plant.input, self.problem.inputs_before)]
        kept += [(self._states, self.problem.plant.output, self.problem.start_output)] * self.with_outputs
        places = zip(("pair_states", "pair_commands", "pair_outputs"), kept, strict=False)
        return tuple(m for n, (queue, of, start) in places for m in queue.memory(n, of.elements, start.tolist()))

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
        late, period, names = self.dead_time, self.problem.period, self.problem.plant.inputs
        return Queue(late.input_cycles(names, period, late.measurement / period + self._delay))


def measured(signal: Signal) -> Signal:
    """Return the signal of what is measured of state or outputs, where a controller may act on what is predicted."""
    return Signal(f"_measured_{signal.name}", signal.elements, signal.units)
