"""The first half of the path of a run: from the command to what moves. `loop` has the second, to what the controller is given.

    command -> dead time -> what moves, for one cycle -> its motion and response -> sensors -> dead time -> controller

What moves is a reality, the model itself with its exact parameters, or a body outside, which is sent inputs and answers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import casadi as ca
import numpy as np

from fpirhc.controllers.believed import PlantModel
from fpirhc.errors import InvalidProblem
from fpirhc.plant.chain import quantities, response_names
from fpirhc.plant.integrators import own_step
from fpirhc.plant.plant import Plant
from fpirhc.simulation.tables import LOGGED, added, by_place, disturbance_signal
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, vector
from fpirhc.task.dead_time import Queue, delay_block
from fpirhc.task.exogenous import model_values, real_values
from fpirhc.task.external_plant import ExternalPlant
from fpirhc.task.problem import Problem

REALITY_STATE = "reality_state"  # signal of the state of a reality, in its own coordinates
SENT = "_acting"  # signal of the inputs that a foreign reality is sent
ANSWER = "foreign"  # what it answers; as it comes, with an underscore before it


def acting_blocks(mover: Mover, disturbed: tuple[Signal, ...]) -> list[Block]:
    """Blocks of the command's way to the plant, and of the plant over one period."""
    problem, plant, late = mover.problem, mover.problem.plant, mover.problem.dead_time
    if not (
        problem.moves.simulated and any(late.inputs.values())
    ):  # what is outside has the dead time of its inputs itself
        return [mover.advance(disturbed, plant.input)]
    waits = [Queue(late.inputs.get(name, 0.0) / problem.period) for name in plant.inputs]
    arriving = Signal("arriving", plant.input.elements, plant.input.units, tuple(map(float, problem.inputs_before)))
    return [delay_block("send_command", plant.input, arriving, waits), mover.advance(disturbed, arriving)]


class Mover(ABC):
    """What a run moves, as the loop meets it."""

    sent: ClassVar[tuple[str, ...]]
    """Signals that the step returns to it."""

    parameters: str = "_exact"
    """Signal of the parameters with which it moves in a cycle."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    def begin(self, read: Sequence[np.ndarray], seed: int) -> None:  # noqa: B027
        """Fill in what the first cycle of a run reads beside memory and tables: nothing, where what moves is inside."""

    def after(self, cycle: int, sent: Sequence[np.ndarray]) -> str:  # noqa: ARG002
        """Return why the run ends after this cycle; empty where it goes on."""
        return ""

    def end(self) -> None:  # noqa: B027
        """Leave what moves as it is to be left, however the run ended."""

    @property
    @abstractmethod
    def states(self) -> tuple[str, ...]:
        """Elements of the model's state that it has."""

    @property
    def motion(self) -> tuple[Signal, ...]:
        """Signals of state and outputs, with the states that it has; without any, no state."""
        state, *outputs = self.problem.plant.motion
        shown = self.states
        if shown == state.elements:
            return (state, *outputs)
        units = dict(zip(state.elements, state.entry_units, strict=True))
        own = [replace(state, elements=shown, units=tuple(units[e] for e in shown))] if shown else []
        return (*own, *outputs)

    @property
    @abstractmethod
    def shows_itself(self) -> bool:
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
    return Body(problem, problem.moves) if isinstance(problem.moves, ExternalPlant) else Equations(problem)


class Equations(Mover):
    """A plant of equations inside the loop: the reality, or the model itself with its exact parameters."""

    sent = ()

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        if real_values(problem.real_plant, problem.signals) is not None:
            self.parameters = _REAL_NOW

    @property
    def states(self) -> tuple[str, ...]:
        return self.problem.reality_or_model.shown(self.problem.plant.state.elements)

    shows_itself = True

    reads = ()

    @property
    def delays(self) -> list[Delay]:
        problem, plant = self.problem, self.problem.real_plant
        start, acting = (tuple(map(float, v)) for v in (problem.real_start, problem.inputs_before))
        exact = tuple(map(float, problem.real_parameters))
        return [
            Delay(Signal("_state_before", plant.state.elements, plant.state.units, start), "_state_after"),
            Delay(Signal("_acting_before", plant.input.elements, plant.input.units, acting), "_acting"),
            Delay(like(plant.forcing, "_forcing_before"), "_forcing"),
            Delay(Signal("_exact", plant.parameter.elements, plant.parameter.units, exact), self.parameters),
        ]

    def sense(self, motion: Sequence[Signal], response: Signal) -> Block:
        """Block -> state and outputs, and the response just before this cycle's command; with a reality also its state.

        The response is computed here and not at the end of the last cycle, because it shares its costly terms with the first
        Runge-Kutta evaluation of this cycle. Outputs are those of the moving plant, with its exact parameters.
        """
        problem, moved = self.problem, self.problem.reality_or_model
        answer = moved.function(response_names(problem.plant))
        reads, writes = real_signals(problem), (*motion, response)
        own = () if problem.reality is None else (like(moved.plant.state, REALITY_STATE),)
        shown = {one.name: moved.function(one.elements) for one in motion}
        shifts = bool(problem.disturbed_outputs)
        if shifts:
            reads, writes = (*reads, disturbance_signal(problem)), (*writes, like(problem.plant.output, LOGGED))

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
        opaque = values is not None and not values.is_a("SXFunction")
        state = like(plant.state, "_state_before")
        exact = like(plant.parameter, self.parameters if values is None else Mover.parameters)
        reads = (state, arriving, exact, *([] if values is None else [problem.plant.time]), *disturbed)
        writes = (like(plant.state, "_state_after"), like(plant.input, "_acting"), like(plant.forcing, "_forcing"))

        def step(s: Signals) -> dict[str, Expression]:
            u, w = getattr(s, arriving.name), expression(ca.DM.zeros(len(plant.names)))
            if disturbed:
                adds = by_place(problem, s.disturbance)
                u = u + ca.vertcat(*(adds.get(name, 0) for name in plant.inputs))
                w = ca.vertcat(*(adds.get(name, 0) for name in plant.names))
            after, now = s._state_before, getattr(s, exact.name)
            for k in range(count):
                there = now if values is None else values(s.time + (k + 0.5) * (problem.period / count), now)
                after = one(after, u, there, w)
            return {"_state_after": after, "_acting": u, "_forcing": w}

        return Block("advance", Layout(reads), Layout(writes), step, opaque=opaque)


class Body(Mover):
    """A body outside, which is sent inputs and answers with measurements."""

    sent = (SENT,)

    def __init__(self, problem: Problem, body: ExternalPlant) -> None:
        super().__init__(problem)
        self._body, self._cycles = body, 0
        units = quantities(problem.plant)
        self.measures = {name: units[name] for name in body.measures}

    def begin(self, read: Sequence[np.ndarray], seed: int) -> None:
        [self._answer] = read
        self._answer[:] = self._body.first(seed)

    def after(self, cycle: int, sent: Sequence[np.ndarray]) -> str:
        self._cycles = cycle + 1
        try:
            self._answer[:] = self._body.read(cycle * self.problem.period, sent[0].copy())
        except InvalidProblem as error:
            return str(error)
        return ""

    def end(self) -> None:
        self._body.end(self._cycles * self.problem.period, self.problem.plant.inputs)

    @property
    def states(self) -> tuple[str, ...]:
        state, *outputs = self.problem.plant.motion
        return tuple(e for e in state.elements if e in self.measures) if outputs else state.elements

    @property
    def shows_itself(self) -> bool:
        plant = self.problem.plant
        return {*plant.output.elements, *response_names(plant)} <= set(self.measures)

    @property
    def reads(self) -> tuple[Signal, ...]:
        return (vector(f"_{ANSWER}", tuple(self.measures), tuple(self.measures.values())),)

    @property
    def delays(self) -> list[Delay]:
        return []

    def sense(self, motion: Sequence[Signal], response: Signal) -> Block:
        """Block (answer) -> motion and response in the model's order; what is not measured is zero."""
        names, answered = list(self.measures), response_names(self.problem.plant)
        wanted = {**{signal.name: signal.elements for signal in motion}, response.name: answered}

        def step(s: Signals) -> dict[str, Expression]:
            answer = getattr(s, ANSWER)
            return {
                signal: ca.vertcat(*(answer[names.index(n)] if n in names else 0 for n in elements))
                for signal, elements in wanted.items()
            }

        return Block("sense", Layout((like(self.reads[0], ANSWER),)), Layout((*motion, response)), step)

    def advance(self, disturbed: tuple[Signal, ...], arriving: Signal) -> Block:
        """Block (arriving command, disturbances of inputs) -> the inputs that it is sent."""
        problem, plant = self.problem, self.problem.plant

        def step(s: Signals) -> dict[str, Expression]:
            u = getattr(s, arriving.name)
            if disturbed:
                adds = by_place(problem, s.disturbance)
                u = u + ca.vertcat(*(adds.get(name, 0) for name in plant.inputs))
            return {SENT: u}

        return Block("send", Layout((arriving, *disturbed)), Layout((like(plant.input, SENT),)), step)


def real_signals(problem: Problem) -> tuple[Signal, ...]:
    """What the plant that moves carries over a cycle: state, acting input, parameters, forcing."""
    plant = problem.real_plant
    names = "_state_before", "_acting_before", "_exact"
    signals = (like(s, n) for s, n in zip((plant.state, plant.input, plant.parameter), names, strict=True))
    return (*signals, like(plant.forcing, "_forcing_before"))


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
    if model.outside:
        t, p = ca.SX.sym("t"), ca.SX.sym("p", model.parameter.size)
        believed = model_values(model, known.signals) or ca.Function("fpirhc_signals", [t, p], [p])
        blocks.append(_block("told", problem, model, believed, "signals_told", ("parameters", "")))
    return blocks


def _block(
    name: str, problem: Problem, plant: Plant, values: ca.Function, shown: str, ends: tuple[str, str], steps: int = 1
) -> Block:
    """Block (time, parameters `ends[0]`) -> the mean of their signals, `shown`, and the parameters `ends[1]` where that has a name.

    The values are those in the middle of equal steps of the cycle, and the parameters those of the last one.
    """
    places = [plant.parameter.elements.index(n) for n in plant.outside]
    source, target = ends
    units = tuple(plant.parameter.units[k] for k in places)
    writes = (Signal(shown, plant.outside, units), *([like(plant.parameter, target)] if target else []))

    def step(s: Signals) -> dict[str, Expression]:
        every = [values(s.time + (k + 0.5) * (problem.period / steps), getattr(s, source)) for k in range(steps)]
        mean = ca.sum2(ca.horzcat(*every))[places] / steps if steps > 1 else every[0][places]
        return {shown: mean, **({target: every[-1]} if target else {})}

    reads = Layout((plant.time, like(plant.parameter, source)))
    return Block(name, reads, Layout(writes), step, opaque=not values.is_a("SXFunction"))
