"""A fixed-point iteration on the target of an inner controller: for plants that settle, whose output is y = h(u) when they have.

    target = reference + shift,        command = inner controller(target)

A map may iterate in another unit of the output, as a user's own does in the problem anaesthesia_people. Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, like, reference_block
from fpirhc.controllers.built import Built, build
from fpirhc.controllers.composed import compose_controller, embedded
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation.base import Deformation, RequestChange, automatic
from fpirhc.errors import InvalidValue, NotContractive, NotSupported
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import NotNegative
from fpirhc.members import Example
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.motion import followed_units, time_signal
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Composite, Delay
from fpirhc.symbolic.expression import Signals, expression, is_finite, kind
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.dead_time import MOST, DeadTime, Queue, every
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Reference, Steps

SHIFT = "_target_shift"  # given from outside: by how much every controlled coordinate is shifted
_OWN = "_target_own"  # the reference's own signals, the shift, and the time


@dataclass(frozen=True, eq=False)
class Shifted(Reference):
    """The motion of another reference plus a shift of its controlled coordinates, which is held along a horizon.

    Whatever is decided before a run uses the motion without shift. Derivatives are not shifted: the shift changes slowly.
    """

    reference: Reference  # that is shifted. Its own signals are given from outside too.

    @property
    def opaque(self) -> bool:
        return self.reference.opaque

    @property
    def set_points(self) -> Mapping[str, Steps]:
        return self.reference.set_points

    def coordinates(self, t: Expression) -> Mapping[str, Expression]:
        return self.reference.coordinates(t)

    def function(self, plant: Plant) -> ca.Function:
        """Function t -> (nominal state (nx), nominal response (n)) without shift."""
        return self.reference.function(plant)

    def given(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        every = followed_units(plant)
        units = tuple(every[name] for name in plant.controlled_names)
        return (*self.reference.own(plant, stages), Signal(SHIFT, plant.controlled_names, units))

    def own(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        names = tuple(column for signal in self.given(plant, stages) for column in signal.columns)
        return (Signal(_OWN, (*names, "time")),)

    def block(self, plant: Plant, stages: int, period: float) -> Block:
        del period
        signals = self.given(plant, stages)

        def step(s: Signals) -> dict[str, Expression]:
            return {_OWN: ca.vertcat(*(getattr(s, signal.name) for signal in signals), s.time)}

        return Block("target", Layout((time_signal(plant), *signals)), Layout(self.own(plant, stages)), step)

    def motion_now(self, plant: Plant, stages: int, ahead: float = 0.0) -> ca.Function:
        """Function (t, own signal) -> (state, response), now or after some time with the shift held."""
        t, own, parts, places = self._symbols(plant, stages)
        state, response = self.reference.motion_now(plant, stages, ahead)(t, *parts[:-2])
        shifted = state + places @ parts[-2]
        return ca.Function("fpirhc_target", [t, own], [shifted, response], ["t", "own"], ["state", "response"])

    def preview(self, plant: Plant, nodes: np.ndarray) -> ca.Function:
        """Function (t, own signal) -> (states (nx, N + 1), responses (n, N + 1)) at the nodes of a horizon."""
        t, own, parts, places = self._symbols(plant, len(nodes) - 1)
        known = self.reference.preview(plant, nodes)
        if known is not None:
            states, responses = known(parts[-1], *parts[:-2])
        else:
            at_nodes = [self.reference.function(plant)(parts[-1] + float(time)) for time in nodes]
            states, responses = (ca.horzcat(*columns) for columns in zip(*at_nodes, strict=True))
        shifted = states + ca.repmat(places @ parts[-2], 1, len(nodes))
        names = ["t", "own"], ["states", "responses"]
        return ca.Function("fpirhc_target_preview", [t, own], [shifted, responses], *names)

    def largest_jump(self, plant: Plant) -> float:
        return self.reference.largest_jump(plant)

    def _symbols(self, plant: Plant, stages: int) -> tuple[Expression, Expression, list[Expression], ca.DM]:
        """Time, the own signal, its parts, and the matrix that puts the shift into the state."""
        matrix, signals = kind(self.opaque), self.given(plant, stages)
        own = matrix.sym("own", self.own(plant, stages)[0].size)
        ends = np.cumsum([0, *(signal.size for signal in signals), 1]).tolist()
        places = ca.DM(plant.output.size, len(plant.controlled_names))
        for column, name in enumerate(plant.controlled_names):
            places[plant.output.elements.index(name), column] = 1
        return matrix.sym("t"), own, ca.vertsplit(own, ends), places


@dataclass(frozen=True)
class ThroughModel(Checked):
    """The target passed through the model's dead time and lag.

    Args:
        lag: time constant with which the model follows a shift of its target, in the plant's unit of time; a tuple has one per
            controlled coordinate, 0 settles within a cycle, as outputs of order 0 do.
        dead_time: from a target to its measured output; None: that of the problem, for the slowest input.
        plain: whether the output is compared with the reference, as in the published form, and the next target begins at the one in
            force. It corrects a right model too, while that is under way, and is quiet at gains that limit-cycle otherwise.
    """

    lag: NotNegative | tuple[NotNegative, ...] = field(metadata={"structure": True})
    dead_time: NotNegative | None = field(default=None, metadata={"structure": True})
    plain: bool = field(default=False, metadata={"setting": "where given", "structure": True})

    def _late(self, late: DeadTime) -> float:
        return max((0.0, *late.inputs.values())) + late.measurement if self.dead_time is None else self.dead_time

    def decays(self, problem: Problem) -> np.ndarray:
        """Return rho of every controlled coordinate.

        Raises:
            InvalidValue: a wrong number of lags.
        """
        count = len(problem.plant.controlled_names)
        lags = every(self.lag)
        if len(lags) not in (1, count):
            raise InvalidValue(
                f"{self!r}: there are {count} controlled coordinates; give one lag for each, or one for all"
            )
        rho = [math.exp(-problem.period / lag) if lag else 0.0 for lag in lags]
        return np.array(rho * count if len(rho) == 1 else rho)

    def queue(self, problem: Problem) -> Queue:
        """Return the queue of targets, newest first: that of the last cycle.

        Raises:
            InvalidValue: more than 1000 cycles.
        """
        late = problem.dead_time
        cycles = self._late(late) / problem.period
        if cycles > MOST:
            raise InvalidValue(f"{self!r}: {cycles:g} cycles of dead time, more than {MOST}")
        return Queue(cycles)

    def memory(self, problem: Problem, first: np.ndarray, away: np.ndarray) -> tuple[Signal, ...]:
        """Return references and shifts on their way, newest first, and the shift in force: at first the distance of the start.

        Args:
            first: reference at the start, one per controlled coordinate.
            away: distance of the start from it.
        """
        names, length = problem.plant.controlled_names, self.queue(problem).length
        queued = tuple(f"{n}@{k}" for k in range(1, length + 1) for n in names)
        return (
            Signal("references_sent", queued, start=tuple(map(float, first)) * length),
            Signal("shifts_sent", queued),
            Signal("shift_in_force", names, start=tuple(map(float, away))),
        )

    def in_force(self, problem: Problem, s: Signals, wanted: Expression) -> Expression:
        """Return the target that was in force when the output of this cycle was measured; `wanted` is the reference of now."""
        queue = self.queue(problem)
        return queue.delayed(queue.pushed(s.references_sent, wanted), wanted.numel()) + s.shift_in_force

    def undeformed(self, s: Signals, in_force: Expression) -> Expression:
        """Return the target less a shift: that in force of the plain form, the last one of the model-referenced form."""
        return in_force - (s.shift_in_force if self.plain else s.shift_last)

    def remembered(self, problem: Problem, s: Signals, wanted: Expression, shift: Expression) -> dict[str, Expression]:
        """Return the memory one cycle later."""
        queue, rho = self.queue(problem), ca.DM(self.decays(problem))
        shifts = queue.pushed(s.shifts_sent, shift)
        return {
            "references_sent_next": queue.pushed(s.references_sent, wanted),
            "shifts_sent_next": shifts,
            "shift_in_force_next": rho * s.shift_in_force + (1 - rho) * queue.delayed(shifts, shift.numel()),
        }


def _first_reference(problem: Problem) -> np.ndarray:
    """The controlled coordinates' reference at the start, (n,)."""
    plant = problem.plant
    first = np.asarray(problem.reference.function(plant)(0.0)[0].full()).ravel()
    return first[[plant.output.elements.index(n) for n in plant.controlled_names]]


_RENAMED = {"reference": "target", "error": "target_error"}  # what the inner controller calls these
_COMMANDS = {"_unclipped_last": "command_unclipped", "_command_last": "command"}
_SAMPLES = 200


@dataclass(frozen=True, eq=False)
class Cascade(Controller):
    """The inner controller on a target that is deformed until the measured output is the reference.

    Args:
        controller: the inner one: `FeedforwardOnly()`, or any that follows the reference.
        deformation: the map on targets; a scale is in units of the output.
        paired: which target an output belongs to, `ThroughModel(lag=...)`; None: that of the last cycle.
    """

    controller: Controller
    deformation: Deformation
    paired: ThroughModel | None

    @property
    def inner(self) -> Controller:
        """The inner controller."""
        return self.controller

    def inner_problem(self, problem: Problem) -> Problem:
        return replace(problem, reference=Shifted(problem.reference))

    deforms = "target"

    planner = None  # plans of the inner controller follow the target, and not the reference of the problem

    def with_deformation(self, deformation: Deformation) -> Controller:  # type: ignore[override]
        return replace(self, deformation=deformation) if deformation.adapts else without_deformation(self.controller)

    def with_defaults(self, problem: Problem) -> Cascade:
        map_ = self.deformation
        return replace(self, deformation=map_.with_scale_for(_request_change(problem))) if automatic(map_) else self

    def check(self, problem: Problem) -> None:
        """Raise if the inner controller, the map or the pairing does not fit the problem.

        Raises:
            NotContractive: a gain of the wrong sign.
            NotSupported: a model-referenced map, or one with a pairing of its own; a controller that predicts over the dead time
                inside.
            InvalidValue: see `ThroughModel`.
        """
        self.controller.check(self.inner_problem(problem))
        if self.deformation.form.pairs:
            raise NotSupported(
                "Cascade cannot use a model-referenced deformation: `paired` already compares with the model; use the map itself"
                if self.deformation.form.modelled
                else f"Cascade: {type(self.deformation).__name__} pairs by itself; give the map inside, and "
                "ThroughModel(dead_time=...)"
            )
        if self.deformation.effective_gain() < 0:
            raise NotContractive(
                f"Cascade: an effective gain of {self.deformation.effective_gain():.3g} moves the target away from the reference; "
                "use the other sign"
            )
        if self.paired is not None:
            self.paired.decays(problem)
            self.paired.queue(problem)

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        reference, shift = reference_block(built), self._shift_block(built)
        inner = compose_controller(build(self.inner_problem(built.problem), self.controller))
        written = {*reference.writes.names, *shift.writes.names}
        last = (
            Delay(scalar("clipped_last"), "clipped"),
            *(Delay(like(built.plant.input, last), source) for last, source in _COMMANDS.items()),
        )
        return [reference, shift, _renamed(inner, written)], list(last)

    def _shift_block(self, built: Built) -> Block:
        """Block (reference, measured outputs, what a limit did to the last command) -> shift of the target."""
        plant, names = built.plant, built.plant.controlled_names
        seen, pairing = plant.output, self.paired
        places, units = [seen.elements.index(n) for n in names], tuple(followed_units(plant)[n] for n in names)
        begun, first = built.problem.start_output[places], _first_reference(built.problem)
        start, own = tuple(map(float, begun)), self.deformation.memory(names)
        # The plain form begins at the target in force from its first cycle on, and moves it once samples count.
        held = tuple(map(float, begun - first)) if pairing is not None and pairing.plain else ()
        last = (
            Signal("shift_last", names, start=held),
            Signal("target_last", names, start=start),
            scalar("shift_cycles"),
        )
        response = plant.equations.controlled_response
        memory = Layout((*last, *(pairing.memory(built.problem, first, begun - first) if pairing else ()))) + own

        def step(s: Signals) -> dict[str, Expression]:
            wanted, output, before = s.reference[places], getattr(s, seen.name)[places], s.shift_last
            in_force = pairing.in_force(built.problem, s, wanted) if pairing else s.target_last
            undeformed = pairing.undeformed(s, in_force) if pairing else wanted
            remembered = {m: getattr(s, m) for m in own.names}
            request, after = self.deformation.step(in_force, output, undeformed, remembered)
            change = request - undeformed
            running = ca.logic_and(s.shift_cycles > built.warm_up - 0.5, is_finite(change))
            beyond, sent = (response(s.state, getattr(s, u), s.parameters) for u in _COMMANDS)
            onwards = ca.logic_not(ca.dot(change - before, beyond - sent) < 0)  # NaN is no way back
            grows = ca.logic_and(ca.logic_and(s.clipped_last > 0.5, onwards), ca.fabs(change) > ca.fabs(before))
            shift = ca.if_else(running, ca.if_else(grows, before, change), before)
            paired = pairing.remembered(built.problem, s, wanted, shift) if pairing else {}
            counted = {"shift_cycles_next": ca.fmin(s.shift_cycles + 1, built.warm_up)}
            own_next = {f"{m}_next": ca.if_else(running, after[m], remembered[m]) for m in own.names}
            held = {"shift_last_next": shift, "target_last_next": wanted + shift, **counted}
            return {SHIFT: shift, "shift": shift, **held, **paired, **own_next}

        commands = (like(plant.input, name) for name in _COMMANDS)
        measured = (*measured_signals(plant), plant.parameter)
        reads = Layout((Signal("reference", seen.elements), *measured, scalar("clipped_last"), *commands))
        writes = Layout((Signal(SHIFT, names, units), Signal("shift", names, units)))
        return Block("shift", reads, writes, step, memory)


def _request_change(problem: Problem) -> RequestChange:
    """Return the size of the reference's controlled quantities, which the shift may have to make up for at once."""
    plant, function = problem.plant, problem.reference.function(problem.plant)
    times = np.linspace(0.0, problem.duration, _SAMPLES)
    motion = np.array([np.asarray(function(t)[0].full()).ravel() for t in times])
    places = [plant.output.elements.index(n) for n in plant.controlled_names]
    outputs = np.vstack([problem.start_output[places], motion[:, places]])
    return RequestChange(float(np.linalg.norm(np.ptp(outputs, axis=0))), sudden=True)


def _renamed(inner: Composite, written: set[str]) -> Block:
    """The inner controller as one block, with other names for what the outer blocks write too."""
    block = embedded("inner", inner, {})
    names = {s.name: _RENAMED.get(s.name, s.name) for s in block.writes.signals}
    shown = {name: other for name, other in names.items() if other not in written}
    writes = Layout(tuple(replace(s, name=shown[s.name]) for s in block.writes.signals if s.name in shown))

    def step(s: Signals) -> Mapping[str, Expression]:
        values = {name: expression(value) for name, value in block.step(s).items()}
        renamed = {other: values[name] for name, other in shown.items()}
        return {**renamed, **{f"{m}_next": values[f"{m}_next"] for m in block.memory.names}}

    return replace(block, writes=writes, step=step)


# What is left is the dead time of the problem.
EXAMPLES = (Example(problem="heat_exchanger", controller="Cascade", left=0.4, changes={"reality": None}),)
