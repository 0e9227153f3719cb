"""The one path of a run: from the command to what moves, and from there to what the controller is given.

    command -> dead time -> what moves, for one cycle -> its motion and response -> sensors -> dead time -> controller

What moves is a reality, the model itself with its exact parameters, or a body outside, which is sent inputs and answers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.controllers.base import like, rename
from fpirhc.controllers.contract import PlantModel
from fpirhc.controllers.gate import LOST
from fpirhc.controllers.reference_states import given_signals, motion_of, own_signals, own_values
from fpirhc.controllers.seeing import sensor_ranges
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.integrators import own_step
from fpirhc.plant.motion import followed_units, forcing_units, outside_names, time_signal
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import backward_difference, combine, response_names
from fpirhc.simulation.ranges import Ranges, physical_ranges, ranges_of
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, Value, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar, vector
from fpirhc.task.dead_time import MEASUREMENT, Queue, delay_block
from fpirhc.task.disturbance import disturbed_place
from fpirhc.task.exogenous import model_values, real_values
from fpirhc.task.external_plant import ExternalPlant, quantities
from fpirhc.task.problem import Problem

Shown: TypeAlias = tuple[tuple[Signal, ...], Signal]  # signals of the motion, and of the response
REALITY_STATE = "reality_state"  # signal of the state of a reality, in its own coordinates
SENT = "_acting"  # signal of the inputs that a foreign reality is sent
CHUNK = 500  # cycles of a compiled call: long enough to hide Python, short enough for progress and Ctrl-C
SHORT = 25  # of the virtual machine, for which a longer chain takes longer than it saves
_RAW, _HELD = "_foreign", "_foreign_held"
_LOST_QUEUE = "lost_samples_queue"
_PAST, _FULL = "_outputs_past", "_outputs_known"


def sensing_blocks(mover: Mover, *, predicts: bool) -> list[Block]:
    """Motion and response as the controller is given them; where these are not the plant's own, also the true ones and error."""
    problem, plant = mover.problem, mover.problem.plant
    response = plant.response_signal("realised")
    if problem.sees_plant:
        sense = [mover.sense(measured_signals(plant), response)]
        return [*sense, _truth_block(problem, plant.output)] if predicts or problem.dead_time.inputs else sense
    true, shown = _true_blocks(mover, response)
    if predicts and not mover.shows_truth and all(map(problem.moves.shows, problem.judged_names)):
        true = [*true, _truth_block(problem, shown[0][-1])]  # the reference of the controller is that of a later time
    if problem.sensing.ideal and MEASUREMENT not in problem.dead_time.queued:
        return true  # with coordinates measured in place of others
    return [*true, *_late_blocks(problem, shown)]


def acting_blocks(mover: Mover, disturbed: tuple[Signal, ...]) -> list[Block]:
    """Blocks of the command's way to the plant, and of the plant over one period."""
    problem, plant, late = mover.problem, mover.problem.plant, mover.problem.dead_time.simulated
    queued = [name for name in plant.inputs if name in late.queued]
    if not queued:
        return [mover.advance(disturbed, plant.input)]
    waits = [late.wait(name, problem.period) if name in queued else Queue(0.0) for name in plant.inputs]
    arriving = Signal("arriving", plant.input.elements, plant.input.units, tuple(map(float, problem.inputs_before)))
    return [delay_block("send_command", plant.input, arriving, waits), mover.advance(disturbed, arriving)]


def disturbance_signals(problem: Problem) -> tuple[Signal, ...]:
    """Return the signal of all disturbances in the order of the problem, or nothing when there are none."""
    if not problem.disturbances:
        return ()
    return (disturbance_signal(problem),)


class Exchange:
    """What passes between a run and what it moves after every call of the loop: nothing, where that is inside."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    def ranges(self, trace: Layout) -> Ranges:
        """Return what ends the run: the physical ranges of what moves, and errors beyond all sense."""
        return ranges_of(self.problem, trace)

    def begin(self, read: Sequence[np.ndarray]) -> None:
        """Fill in what the first cycle reads beside memory and tables."""

    def after(self, cycle: int, sent: Sequence[np.ndarray]) -> tuple[str, str] | None:  # noqa: ARG002
        """Return why the run ends after this cycle, and what to do; None where it goes on."""
        return None

    def end(self) -> None:
        """Leave what moves as it is to be left, however the run ended."""


class _Conversation(Exchange):
    """A body is sent the inputs of every cycle, and answers with measurements."""

    def __init__(self, problem: Problem, body: ExternalPlant, seed: int) -> None:
        super().__init__(problem)
        self._body, self._seed, self._bridged, self._cycles = body, seed, 0, 0

    def ranges(self, trace: Layout) -> Ranges:
        return physical_ranges(self.problem, trace)

    def begin(self, read: Sequence[np.ndarray]) -> None:
        self._answer, self._held = read
        self._held[0] = 0.0
        self._answer[:] = self._body.first(self._seed)

    def after(self, cycle: int, sent: Sequence[np.ndarray]) -> tuple[str, str] | None:
        self._cycles = cycle + 1
        reading = self._body.read(cycle * self.problem.period, sent[0].copy())
        self._bridged = 0 if reading.values is not None else self._bridged + 1
        self._held[0] = float(reading.values is None)
        if reading.values is not None:
            self._answer[:] = reading.values
        return (reading.mistake, self._body.remedy) if self._bridged > self._body.holds else None

    def end(self) -> None:
        self._body.end(self._cycles * self.problem.period, self.problem.plant.inputs)


class Mover(ABC):
    """What a run moves, as the loop meets it."""

    cycles_of_call: ClassVar[int] = CHUNK
    """Cycles that one call of the compiled loop runs."""
    cycles_interpreted: ClassVar[int] = SHORT
    """The same in the virtual machine."""
    sent: ClassVar[tuple[str, ...]]
    """Signals that the step returns to it."""

    parameters: str = "_exact"
    """Signal of the parameters with which it moves in a cycle."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    def exchange(self, seed: int) -> Exchange:  # noqa: ARG002
        """Return what passes between a run with this seed and what it moves."""
        return Exchange(self.problem)

    @property
    @abstractmethod
    def states(self) -> tuple[str, ...]:
        """Elements of the model's state that it has."""

    @property
    def motion(self) -> tuple[Signal, ...]:
        """Signals of state and outputs, with the states that it has; without any, no state."""
        state, *outputs = measured_signals(self.problem.plant)
        shown = self.states
        if shown == state.elements:
            return (state, *outputs)
        units = dict(zip(state.elements, state.entry_units, strict=True))
        own = [replace(state, elements=shown, units=tuple(units[e] for e in shown))] if shown else []
        return (*own, *outputs)

    @property
    @abstractmethod
    def shows_truth(self) -> bool:
        """Whether it shows everything that is judged: the model's whole state or outputs, and their responses."""

    @property
    @abstractmethod
    def reads(self) -> tuple[Signal, ...]:
        """Signals that the step reads from it."""

    @property
    @abstractmethod
    def delays(self) -> list[Delay]:
        """What it carries from cycle to cycle inside the loop."""

    @abstractmethod
    def sense(self, motion: Sequence[Signal], response: Signal) -> Block:
        """Block -> its state and outputs, and its response just before this cycle's command."""

    @abstractmethod
    def advance(self, disturbed: tuple[Signal, ...], arriving: Signal) -> Block:
        """Block of its motion over one period with the arriving command held."""


def moving(problem: Problem) -> Mover:
    """Return what the run of a problem moves."""
    return Equations(problem) if problem.foreign is None else Body(problem, problem.foreign)


class Equations(Mover):
    """A plant of equations inside the loop: the reality, or the model itself with its exact parameters."""

    sent = ()

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        if real_values(problem.real_plant, problem.signals) is not None:
            self.parameters = _REAL_NOW

    @property
    def states(self) -> tuple[str, ...]:
        return self.problem.truth.shown(self.problem.plant.state.elements)

    shows_truth = True

    reads = ()

    @property
    def delays(self) -> list[Delay]:
        problem, plant = self.problem, self.problem.real_plant
        start, acting = (tuple(map(float, v)) for v in (problem.real_start, problem.inputs_before))
        exact = tuple(map(float, problem.real_parameters))
        return [
            Delay(Signal("_state_before", plant.state.elements, plant.state.units, start), "_state_after"),
            Delay(Signal("_acting_before", plant.input.elements, plant.input.units, acting), "_acting"),
            Delay(_forcing(plant, "_forcing_before"), "_forcing"),
            Delay(Signal("_exact", plant.parameter.elements, plant.parameter.units, exact), self.parameters),
        ]

    def sense(self, motion: Sequence[Signal], response: Signal) -> Block:
        """Block -> state and outputs, and the response just before this cycle's command; with a reality also its state.

        The response is computed here and not at the end of the last cycle, because it shares its costly terms with the first
        Runge-Kutta evaluation of this cycle. Outputs are those of the moving plant, with its exact parameters.
        """
        problem, truth = self.problem, self.problem.truth
        answer = truth.function(response_names(problem.plant))
        reads, writes = _real_signals(problem), (*motion, response)
        own = () if problem.reality is None else (like(truth.plant.state, REALITY_STATE),)
        shown = {one.name: truth.function(one.elements) for one in motion}
        shifts = bool(problem.disturbed_outputs)
        if shifts:
            reads, writes = (*reads, disturbance_signal(problem)), (*writes, logged_signal(problem))

        def step(s: Signals) -> dict[str, Expression]:
            now = (s._state_before, s._acting_before, s._exact, s._forcing_before)
            values = {response.name: answer(*now)}
            values |= {name: function(*now) for name, function in shown.items()}
            if shifts:
                below, answered = added(problem, s.disturbance)
                sums = {response.name: answered, motion[-1].name: below}
                values |= {name: values[name] + more for name, more in sums.items()} | {LOGGED: below}
            return {**values, **{one.name: s._state_before for one in own}}

        return Block("sense", Layout(reads), Layout((*writes, *own)), step)

    def advance(self, disturbed: tuple[Signal, ...], arriving: Signal) -> Block:
        problem, plant, count = self.problem, self.problem.real_plant, self.problem.signal_steps
        integrator, values = problem.real_integrator, None if count == 1 else real_values(plant, problem.signals)
        one = integrator.step(plant, problem.period) if values is None else own_step(plant, integrator, problem.period)
        opaque = integrator.opaque or (values is not None and not values.is_a("SXFunction"))
        state = like(plant.state, "_state_before")
        exact = like(plant.parameter, self.parameters if values is None else Mover.parameters)
        reads = (state, arriving, exact, *([] if values is None else [time_signal(problem.plant)]), *disturbed)
        writes = (like(plant.state, "_state_after"), like(plant.input, "_acting"), _forcing(plant, "_forcing"))

        def step(s: Signals) -> dict[str, Expression]:
            u, w = getattr(s, arriving.name), expression(ca.DM.zeros(len(plant.names)))
            if disturbed:
                adds = _by_place(problem, s.disturbance)
                u = u + ca.vertcat(*(adds.get((True, name), 0) for name in plant.inputs))
                w = ca.vertcat(*(adds.get((False, name), 0) for name in plant.names))
            after, now = s._state_before, getattr(s, exact.name)
            for k in range(count):
                there = now if values is None else values(s.time + (k + 0.5) * (problem.period / count), now)
                after = one(after, u, there, w)
            return {"_state_after": after, "_acting": u, "_forcing": w}

        return Block("advance", Layout(reads), Layout(writes), step, opaque=opaque)


class Body(Mover):
    """A body outside, which is sent inputs and answers with measurements."""

    sent = (SENT,)
    cycles_of_call = cycles_interpreted = 1  # it answers after each

    def __init__(self, problem: Problem, body: ExternalPlant) -> None:
        super().__init__(problem)
        self._body = body
        units = quantities(problem.plant)
        self.measures = {name: units[name] for name in body.measures}

    def exchange(self, seed: int) -> Exchange:
        return _Conversation(self.problem, self._body, seed)

    @property
    def states(self) -> tuple[str, ...]:
        state, *outputs = measured_signals(self.problem.plant)
        return tuple(e for e in state.elements if e in self.measures) if outputs else state.elements

    @property
    def shows_truth(self) -> bool:
        plant = self.problem.plant
        return {*plant.output.elements, *response_names(plant)} <= set(self.measures)

    @property
    def reads(self) -> tuple[Signal, ...]:
        return vector(_RAW, tuple(self.measures), tuple(self.measures.values())), scalar(_HELD)

    @property
    def delays(self) -> list[Delay]:
        return []

    def sense(self, motion: Sequence[Signal], response: Signal) -> Block:
        """Block (answer) -> motion and response in the model's order, and the answer as it came; what is not measured is zero."""
        names, answered = list(self.measures), response_names(self.problem.plant)
        wanted = {**{signal.name: signal.elements for signal in motion}, response.name: answered}

        def step(s: Signals) -> dict[str, Expression]:
            answer = s._foreign
            shown = {
                signal: ca.vertcat(*(answer[names.index(n)] if n in names else 0 for n in elements))
                for signal, elements in wanted.items()
            }
            return {**shown, "foreign": answer, "foreign_held": s._foreign_held}

        writes = (*motion, response, like(self.reads[0], "foreign"), scalar("foreign_held"))
        return Block("sense", Layout(self.reads), Layout(writes), step)

    def advance(self, disturbed: tuple[Signal, ...], arriving: Signal) -> Block:
        """Block (arriving command, disturbances of inputs) -> the inputs that it is sent."""
        problem, plant = self.problem, self.problem.plant

        def step(s: Signals) -> dict[str, Expression]:
            u = getattr(s, arriving.name)
            if disturbed:
                adds = _by_place(problem, s.disturbance)
                u = u + ca.vertcat(*(adds.get((True, name), 0) for name in plant.inputs))
            return {SENT: u}

        return Block("send", Layout((arriving, *disturbed)), Layout((like(plant.input, SENT),)), step)


def _true_blocks(mover: Mover, response: Signal) -> tuple[list[Block], Shown]:
    """Blocks of the true motion, response and error; and the signals that sensors see."""
    problem, motion = mover.problem, mover.motion
    hidden = tuple(like(s, f"_seen_{s.name}") for s in motion), like(response, "_seen")
    if not mover.shows_truth:
        return [mover.sense(*hidden)], hidden
    true = tuple(like(s, f"plant_{s.name}") for s in motion), like(response, "plant_realised")
    sense = mover.sense(*true)
    if problem.sensing.estimator.of_steps:
        sense = with_true_response(problem, sense, true[0][-1], true[1])
    blocks = [sense, _truth_block(problem, true[0][-1])]
    if not problem.truth.seen:
        return blocks, true
    direct = problem.sensing.ideal and MEASUREMENT not in problem.dead_time.queued
    shown = (motion, response) if direct else hidden
    return [*blocks, _seen_block(problem, shown)], shown


def _late_blocks(problem: Problem, shown: Shown) -> list[Block]:
    """Blocks of sensors and their dead time, from what the sensors see to what the controller is given.

    Sensors are those of the outputs where the plant has some; its state then comes with the dead time alone.
    """
    plant, late, sensing = problem.plant, problem.dead_time.measurement_wait(problem.period), problem.sensing
    first = problem.first_output
    starts = (problem.start_state, first)[-len(measured_signals(plant)) :]
    states_pass = sensing.observer is None  # a believed state is the controller's own
    states = [*zip(shown[0], measured_signals(plant), starts, strict=True)] if states_pass else []
    if not sensing.ideal:
        others = states[:-1]
        sensors = [
            *_late_states(others, late),
            *sensing.blocks(plant, problem.first_shown, late, (*shown[0], shown[1])),
        ]
        if sensing.estimates:
            return sensors
        raw = sensing.raw(plant, problem.first_shown, late)
        return [*sensors, sensing.estimator.block(plant, problem.period, first, raw)]
    assert late is not None
    resting = tuple(problem.first_shown[name] for name in response_names(plant))
    realised = replace(shown[1], name="realised", start=resting)
    return [*_late_states(states, late), delay_block("see_response", shown[1], realised, [late] * realised.size)]


def cycles_per_call(problem: Problem, *, compiled: bool) -> int:
    """Return how many cycles one call of the loop runs: one where samples may be lost, and the caller replays them."""
    mover = moving(problem)
    many = mover.cycles_of_call if compiled else mover.cycles_interpreted
    return 1 if loses(mover) else many


def loses(mover: Mover) -> bool:
    """Return whether samples may be lost, or lie outside the range of their sensor."""
    return bool(lost_blocks(mover) or sensor_ranges(mover.problem))


def lost_blocks(mover: Mover) -> list[Block]:
    """Blocks that say whether the sample that a controller is given is lost, `LOST`; none where none can be."""
    problem = mover.problem
    drawn, held = problem.sensing.drawn, [one for one in mover.reads if one.name == _HELD]
    if not held and problem.sensing.lost(ca.SX.zeros(sum(one.size for one in drawn))) is None:
        return []
    late = problem.dead_time.measurement_wait(problem.period) or Queue(0.0)

    def step(s: Signals) -> dict[str, Expression]:
        lost = problem.sensing.lost(ca.vertcat(*(getattr(s, one.name) for one in drawn)))
        now = ca.mmax(ca.vertcat(*([] if lost is None else [lost]), *(getattr(s, one.name) for one in held)))
        arrived, remembered = late.arrived(s, _LOST_QUEUE, now)
        return {LOST.name: arrived, **remembered}

    memory = Layout(late.memory(_LOST_QUEUE, ("sample",), (0.0,)))
    return [Block("lose", Layout((*drawn, *held)), Layout((LOST,)), step, memory)]


def _late_states(states: Sequence[tuple[Signal, Signal, np.ndarray]], late: Queue | None) -> list[Block]:
    """Blocks of the dead time from true signals to measured ones, with the values before the run."""
    if late is None:
        return [rename(f"see_{to.name}", true, to) for true, to, _ in states]
    return [
        delay_block(f"see_{to.name}", true, replace(to, start=tuple(map(float, start))), [late] * to.size)
        for true, to, start in states
    ]


def _truth_block(problem: Problem, motion: Signal) -> Block:
    """Block (time, true state or outputs) -> true error of the judged ones."""
    plant = problem.plant
    places = [plant.output.elements.index(c) for c in problem.judged_names]
    own = [motion.elements.index(c) for c in problem.judged_names]  # what moves may not have every state of the model
    writes = Layout(
        (vector("true_error", problem.judged_names, [followed_units(plant)[c] for c in problem.judged_names]),)
    )
    if given_signals(problem):
        reads = Layout((like(plant.output, "reference"), motion))
        return Block(
            "truth", reads, writes, lambda s: {"true_error": s.reference[places] - getattr(s, motion.name)[own]}
        )
    function, reads = motion_of(problem), Layout((time_signal(plant), motion, *own_signals(problem)))

    def step(s: Signals) -> dict[str, Expression]:
        along = function(s.time, *own_values(problem, s))[0]
        return {"true_error": along[places] - getattr(s, motion.name)[own]}

    return Block("truth", reads, writes, step, opaque=problem.reference.opaque)


def _seen_block(problem: Problem, shown: Shown) -> Block:
    """Block -> the state, the outputs and the response that are measured in place of the true ones."""
    motion, response = shown
    functions = {one.name: problem.truth.function(one.elements, seen=True) for one in motion}
    functions[response.name] = problem.truth.function(response_names(problem.plant), seen=True)

    def step(s: Signals) -> dict[str, Expression]:
        now = (s._state_before, s._acting_before, s._exact, s._forcing_before)
        return {name: function(*now) for name, function in functions.items()}

    return Block("seen", Layout(_real_signals(problem)), Layout((*motion, response)), step)


def _real_signals(problem: Problem) -> tuple[Signal, ...]:
    """What the plant that moves carries over a cycle: state, acting input, parameters, forcing."""
    plant = problem.real_plant
    names = "_state_before", "_acting_before", "_exact"
    signals = (like(s, n) for s, n in zip((plant.state, plant.input, plant.parameter), names, strict=True))
    return (*signals, _forcing(plant, "_forcing_before"))


def _forcing(plant: Plant, name: str) -> Signal:
    """Signal of what disturbances add to the response of every coordinate."""
    return Signal(name, plant.names, forcing_units(plant))


def with_true_response(problem: Problem, sense: Block, motion: Signal, response: Signal) -> Block:
    """Return the block of the true motion, with the true response of a map in place of the one that it writes.

    `motion`: signal of the state, or of the outputs where the plant has some.
    """
    period = problem.period
    orders = problem.plant.response_orders
    if not any(orders.values()):
        return sense  # a response of order 0 is the output, and no difference
    places = {c: problem.plant.output.elements.index(c) for c in orders}
    entries = [(c, j) for c, order in orders.items() for j in range(1, order + 1)]
    past = Signal(_PAST, tuple(f"{c}@{j}" for c, j in entries))
    known = Signal(_FULL)

    def step(s: Signals) -> dict[str, Value]:
        values = dict(sense.step(s))
        before = dict(zip(entries, ca.vertsplit(getattr(s, _PAST)), strict=True))
        now = expression(values[motion.name])
        samples = {c: [now[k], *(before[c, j] for j in range(1, orders[c] + 1))] for c, k in places.items()}
        enough = getattr(s, _FULL)
        values[response.name] = ca.vertcat(
            *(
                ca.if_else(enough > order - 0.5, _difference(samples[c], order) / period**order, 0)
                for c, order in orders.items()
            )
        )
        values[f"{_PAST}_next"] = ca.vertcat(*(samples[c][j - 1] for c, j in entries))
        values[f"{_FULL}_next"] = ca.fmin(enough + 1, max(orders.values()))
        return values

    return replace(sense, step=step, memory=sense.memory + Layout((past, known)))


def _difference(samples: Sequence[Expression], order: int) -> Expression:
    return combine(backward_difference(order), samples)


_REAL_NOW = "_exact_now"


def outside_blocks(mover: Mover, known: PlantModel) -> list[Block]:
    """Return blocks that write the real parameters of this cycle, 'signals' and 'signals_told'; none without signals."""
    problem, real, model = mover.problem, mover.problem.real_plant, known.plant
    blocks = []
    if mover.parameters == _REAL_NOW:
        values = real_values(real, problem.signals)
        assert values is not None
        ends = Mover.parameters, _REAL_NOW
        blocks.append(_block("outside", problem, real, values, "signals", ends, problem.signal_steps))
    if outside_names(model):
        believed = model_values(model, known.signals) or _unchanged(model)
        blocks.append(_block("told", problem, model, believed, "signals_told", ("parameters", "")))
    return blocks


def _block(
    name: str, problem: Problem, plant: Plant, values: ca.Function, shown: str, ends: tuple[str, str], steps: int = 1
) -> Block:
    """Block (time, parameters `ends[0]`) -> the mean of their signals, `shown`, and the parameters `ends[1]` where that has a name.

    The values are those in the middle of equal steps of the cycle, and the parameters those of the last one.
    """
    places = [plant.parameter.elements.index(n) for n in outside_names(plant)]
    source, target = ends
    units = tuple(plant.parameter.units[k] for k in places)
    writes = (Signal(shown, outside_names(plant), units), *([like(plant.parameter, target)] if target else []))

    def step(s: Signals) -> dict[str, Expression]:
        every = [values(s.time + (k + 0.5) * (problem.period / steps), getattr(s, source)) for k in range(steps)]
        mean = ca.sum2(ca.horzcat(*every))[places] / steps if steps > 1 else every[0][places]
        return {shown: mean, **({target: every[-1]} if target else {})}

    reads = Layout((time_signal(plant), like(plant.parameter, source)))
    return Block(name, reads, Layout(writes), step, opaque=not values.is_a("SXFunction"))


def _unchanged(plant: Plant) -> ca.Function:
    t, p = ca.SX.sym("t"), ca.SX.sym("p", plant.parameter.size)
    return ca.Function("fpirhc_signals", [t, p], [p])


SIGNAL = "disturbance"  # what a loop reads in every cycle
LOGGED = "output_disturbance"


def disturbance_columns(problem: Problem) -> tuple[tuple[str, int], ...]:
    """Return name and derivative of every column of the disturbances: first all names, then d', d'', ... of outputs."""
    orders = problem.disturbed_outputs
    higher = ((name, k) for name, order in orders.items() for k in range(1, order + 1))
    return (*((name, 0) for name in problem.disturbances), *higher)


def disturbance_signal(problem: Problem) -> Signal:
    """Return the signal that a loop reads: every disturbance, and the derivatives of those of outputs."""
    return Signal(SIGNAL, tuple(name + "'" * k for name, k in disturbance_columns(problem)))


def disturbance_values(problem: Problem, times: np.ndarray, seed: int) -> np.ndarray:
    """Return all columns at some times, shape (m, columns); each disturbance has its own stream."""
    streams = np.random.SeedSequence(seed).spawn(len(problem.disturbances))
    values = [
        one.values(times, np.random.default_rng(stream))
        for one, stream in zip(problem.disturbances.values(), streams, strict=True)
    ]
    by_name = dict(zip(problem.disturbances, values, strict=True))
    for name, k in disturbance_columns(problem):
        if k and problem.integrator.steps_maps:
            values.append(np.diff(by_name[name], prepend=by_name[name][:1]) / problem.period)
        elif k:
            values.append(problem.disturbances[name].derivative(times, k))
    return np.column_stack(values) if values else np.zeros((len(times), 0))


def logged_signal(problem: Problem) -> Signal:
    """Return the signal of what disturbances add to y, y', ... below the responses."""
    output = problem.plant.output
    return Signal(LOGGED, output.elements, output.units)


def _by_place(problem: Problem, disturbance: Expression) -> dict[tuple[bool, str], Expression]:
    """Return what disturbances add by (whether to an input, name)."""
    values, inputs = ca.vertsplit(disturbance), problem.plant.inputs
    return {disturbed_place(key, inputs): value for key, value in zip(problem.disturbances, values, strict=False)}


def added(problem: Problem, disturbance: Expression) -> tuple[Expression, Expression]:
    """Return what disturbances add to y, y', ... below the responses, and to the controlled responses."""
    plant, orders = problem.plant, problem.disturbed_outputs
    values: Mapping[str, Expression] = dict(
        zip(disturbance_signal(problem).elements, ca.vertsplit(disturbance), strict=True)
    )
    own = {e: v for e, v in values.items() if e.rstrip("'") in orders}
    below = [own.get(e, 0) for e in plant.output.elements]
    return ca.vertcat(*below), ca.vertcat(*(own.get(n + "'" * orders.get(n, 0), 0) for n in plant.controlled_names))
