"""A fixed-point iteration on the target of an inner controller: for plants that settle, whose output is y = h(u) when they have.

    target = reference + shift,        command = inner controller(target)

The shift may act in another unit, z = to(y): target = back(to(reference) + shift). Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, like, reference_block
from fpirhc.controllers.contract import without_deformation
from fpirhc.controllers.sensing_chain import compose_controller, embedded
from fpirhc.deformation.base import Deformation, RequestChange, automatic
from fpirhc.errors import InvalidValue, Mistakes, NotContractive, NotSupported
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import NotNegative
from fpirhc.fields.user_code import called, scalar_expression
from fpirhc.members import Example
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.maps import growth_of
from fpirhc.plant.motion import followed_units, time_signal
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Composite, Delay
from fpirhc.symbolic.expression import Signals, expression, is_finite, kind
from fpirhc.symbolic.layout import Expression, Layout, Named, Signal, scalar
from fpirhc.symbolic.live import largest, nominal
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

    def chain(self, plant: Plant, stages: int, coordinate: str, order: int) -> ca.Function:
        """Function (t, own signal) -> the coordinate's value and its derivatives up to `order`."""
        t, own, parts, _ = self._symbols(plant, stages)
        values = self.reference.chain(plant, stages, coordinate, order)(t, *parts[:-2])
        if coordinate in plant.controlled_names:
            unit = ca.DM(np.eye(order + 1)[:, :1])
            values = values + unit * parts[-2][plant.controlled_names.index(coordinate)]
        return ca.Function("fpirhc_target_chain", [t, own], [values])

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


_STILL = 1e-9  # smallest decay of a settling mode, as a share of the fastest mode's rate


@dataclass(frozen=True)
class ThroughModel(Checked):
    """The target passed through the model's dead time and lag.

    Args:
        lag: time constant with which the model follows a shift of its target, in the plant's unit of time; a tuple has one per
            controlled coordinate, 0 settles within a cycle. None: the slowest one of the model at the start, with the command held;
            0 for outputs of order 0, which the model moves at once.
        dead_time: from a target to its measured output; None: that of the problem, for the slowest input.
        plain: whether the output is compared with the reference, as in the published form, and the next target begins at the one in
            force. It corrects a right model too, while that is under way, and is quiet at gains that limit-cycle otherwise.
    """

    lag: NotNegative | tuple[NotNegative, ...] | None = field(default=None, metadata={"structure": True})
    dead_time: NotNegative | None = field(default=None, metadata={"structure": True})
    plain: bool = field(default=False, metadata={"setting": "where given", "structure": True})

    def stated(self, problem: Problem) -> ThroughModel:
        """Return the pairing with the lag as a number; one that cannot be known stays open, for `decays` to refuse."""
        try:
            lag = _own_lags(problem) if self.lag is None else self.lag
        except InvalidValue:
            return self
        return replace(self, lag=lag)

    def _late(self, late: DeadTime) -> float:
        return largest((0.0, *late.inputs.values())) + late.measurement if self.dead_time is None else self.dead_time

    def decays(self, problem: Problem) -> np.ndarray:
        """Return rho of every controlled coordinate.

        Raises:
            InvalidValue: a model that does not settle, a wrong number of lags.
        """
        count = len(problem.plant.controlled_names)
        lags = every(_own_lags(problem) if self.lag is None else self.lag)
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
        if (now := nominal(cycles)) > MOST:
            raise InvalidValue(f"{self!r}: {now:g} cycles of dead time, more than {MOST}")
        return Queue.up_to(cycles, self._late(nominal(late).at_longest) / problem.period)

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


def _own_lags(problem: Problem) -> float | tuple[float, ...]:
    """The model's own time constants, one per controlled quantity where some settle at once."""
    orders = list(problem.plant.response_orders.values())
    slowest = _slowest(problem) if any(orders) else 0.0
    return slowest if all(orders) else tuple(slowest if order else 0.0 for order in orders)


def _slowest(problem: Problem) -> float:
    """Slowest time constant of the model at the start, with the command held."""
    plant = problem.plant
    x, u, p = plant.symbols()
    slope = ca.Function("fpirhc_modes", [x, u, p], [ca.densify(ca.jacobian(plant.equations.rate(x, u, p), x))])
    matrix = np.asarray(slope(problem.start_state, problem.inputs_before, plant.approximate).full())
    modes = np.linalg.eigvals(matrix) if np.isfinite(matrix).all() else np.zeros(1)
    rates = -growth_of(plant)(modes)
    if rates.min() <= _STILL * np.abs(rates).max():
        raise InvalidValue(
            f"ThroughModel(): the model does not settle at the start with its command held (slowest rate {rates.min():.3g} "
            f"{problem.rate_unit}); say how fast the inner controller follows its target: ThroughModel(lag=...)"
        )
    return float(1 / rates.min())


Converted = Callable[[Expression, Named], Expression]


@dataclass(frozen=True, eq=False)
class TargetUnit(Checked):
    """The unit in which targets are deformed: a monotonic function of a coordinate, by the model's curve, and its inverse.

    Where the settled output is y = h(u) with a curve that saturates, an iteration on y has another gain at every target. On
    z = to(y), with `back` of z the model's h, a right model has the gain one everywhere.

    Args:
        to: function of (y, p) that returns z; finite for every measured y, so keep y inside the range of the curve.
        back: function of (z, p) that returns y.
        bounds: (lower, upper) of the target, in z.
    """

    to: Converted
    back: Converted
    bounds: tuple[float, float] = (-math.inf, math.inf)

    def __post_init__(self) -> None:
        if not self.bounds[0] < self.bounds[1]:
            raise InvalidValue(f"TargetUnit: bounds are {self.bounds!r}; write lower < upper")


_SAME = TargetUnit(lambda y, _: y, lambda z, _: z)
_AGREE = 1e-6  # of `to` and `back`, as a share of the coordinate


_RENAMED = {"reference": "target", "error": "target_error"}  # what the inner controller calls these
_COMMANDS = {"_unclipped_last": "command_unclipped", "_command_last": "command"}
_SAMPLES = 200


@dataclass(frozen=True, eq=False)
class Cascade(Controller):
    """The inner controller on a target that is deformed until the measured output is the reference.

    Args:
        controller: the inner one: `FeedforwardOnly()`, or any that follows the reference.
        deformation: the map on targets; a scale is in units of the output.
        paired: which target an output belongs to; None: that of the last cycle.
        units: by controlled coordinate, the unit in which its target is deformed; a scale of the map is in it. The coordinate's own
            where not named.

    Raises:
        InvalidProblem: a unit of what is not controlled, or one whose functions are not each other's inverse at the start.
    """

    controller: Controller
    deformation: Deformation
    paired: ThroughModel | None = field(default_factory=ThroughModel)
    units: Mapping[str, TargetUnit] = field(default_factory=dict, kw_only=True, metadata={"setting": "where given"})

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
        paired, map_ = self.paired, self.deformation
        return replace(
            self,
            paired=None if paired is None else paired.stated(problem),
            deformation=map_.with_scale_for(self._request_change(problem)) if automatic(map_) else map_,
        )

    def _request_change(self, problem: Problem) -> RequestChange:
        """Return the size of the reference's controlled quantities, which the shift may have to make up for at once."""
        plant, function = problem.plant, problem.reference.function(problem.plant)
        times = np.linspace(0.0, problem.duration, _SAMPLES)
        motion = np.array([np.asarray(function(t)[0].full()).ravel() for t in times])
        places = [plant.output.elements.index(n) for n in plant.controlled_names]
        outputs = np.vstack([problem.start_output[places], motion[:, places]])
        outputs = np.array([self._numbers(problem.plant, one, "to") for one in outputs])
        return RequestChange(float(np.linalg.norm(np.ptp(outputs, axis=0))), sudden=True)

    def _units(self, plant: Plant, values: Expression, parameters: Expression, way: str) -> Expression:
        """Values of the controlled coordinates, each by the function `way` of its unit: "to" or "back"."""
        if not self.units:
            return values
        named = Named(plant.parameter.elements, parameters, "parameter")
        converted = []
        for k, name in enumerate(plant.controlled_names):
            function = getattr(self.units.get(name, _SAME), way)
            what = f"Cascade: units['{name}'].{way}"
            converted.append(scalar_expression(what, called(what, function, values[k], named), of=function))
        return ca.vertcat(*converted)

    def _numbers(self, plant: Plant, values: np.ndarray, way: str) -> np.ndarray:
        """The same of numbers (n,), with the model's parameters."""
        converted = self._units(plant, ca.SX(values), ca.SX(plant.approximate), way)
        return np.asarray(ca.evalf(converted).full()).ravel()

    def _steepness(self, plant: Plant) -> ca.Function | None:
        """Function (controlled outputs, parameters) -> dz/dy of every one; None without units."""
        if not self.units:
            return None
        y, p = ca.SX.sym("y", len(plant.controlled_names)), ca.SX.sym("p", plant.parameter.size)
        slopes = ca.jacobian(self._units(plant, y, p, "to"), y)
        return ca.Function("fpirhc_steepness", [y, p], [ca.densify(ca.diag(slopes))])

    def _as_coordinates(self, plant: Plant, first: np.ndarray, there: np.ndarray) -> np.ndarray:
        """By how much every controlled coordinate would change for all of its value in the other unit, (n,)."""
        function = self._steepness(plant)
        if function is None:
            return np.zeros(len(first))
        slopes = np.abs(np.asarray(function(first, plant.approximate).full()).ravel())
        return np.divide(np.abs(there), slopes, out=np.zeros(len(first)), where=slopes > 0)

    def _check_units(self, problem: Problem) -> None:
        """Raise where a unit is of nothing, or its functions are not each other's inverse at the reference's start."""
        plant, mistakes = problem.plant, Mistakes("Cascade")
        mistakes.unknown("units: controlled coordinate", self.units, plant.controlled_names)
        mistakes.raise_if_any()
        first = _first_reference(problem)
        there = self._numbers(plant, first, "to")
        again = self._numbers(plant, there, "back")
        # What `to` rounds at a coordinate near zero, 0 °C in kelvins, `back` cannot know.
        sizes = np.fmax(np.abs(first), self._as_coordinates(plant, first, there))
        for k, name in enumerate(plant.controlled_names):
            if not abs(again[k] - first[k]) <= _AGREE * sizes[k]:
                mistakes.add(
                    f"units['{name}']: to({first[k]:g}) is {there[k]:g}, and back of it {again[k]:g}; expected {first[k]:g}, the "
                    "reference at the start: give functions that are each other's inverse, and a reference inside their range"
                )
        mistakes.raise_if_any()

    def check(self, problem: Problem) -> None:
        """Raise if the inner controller, the map or the pairing does not fit the problem.

        Raises:
            InvalidProblem: a unit of what is not controlled, or one whose functions are not each other's inverse.
            NotContractive: a gain of the wrong sign.
            NotSupported: a model-referenced map, or one with a pairing of its own; a controller that predicts over the dead time
                inside.
            InvalidValue: see `ThroughModel`.
        """
        self._check_units(problem)
        self.controller.check(self.inner_problem(problem))
        self.deformation.mirror.require_last_request(
            "Cascade cannot use a model-referenced deformation: `paired` already compares with the model; use the map itself"
        )
        if self.deformation.iteration.pairing is not None:
            raise NotSupported(
                f"Cascade: {type(self.deformation).__name__} pairs by itself; give the map inside, and "
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

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        reference, shift = reference_block(problem), self._shift_block(problem)
        inner = compose_controller(self.inner_problem(problem), self.controller)
        written = {*reference.writes.names, *shift.writes.names}
        last = (
            Delay(scalar("clipped_last"), "clipped"),
            *(Delay(like(problem.plant.input, last), source) for last, source in _COMMANDS.items()),
        )
        return [reference, shift, _renamed(inner, written)], list(last)

    def _shift_block(self, problem: Problem) -> Block:
        """Block (reference, measured outputs, what a limit did to the last command) -> shift of the target."""
        plant, names = problem.plant, problem.plant.controlled_names
        seen, pairing = plant.output, self.paired
        places, units = [seen.elements.index(n) for n in names], tuple(followed_units(plant)[n] for n in names)
        begun = self._numbers(plant, problem.start_output[places], "to")
        first = self._numbers(plant, _first_reference(problem), "to")
        start, own = tuple(map(float, begun)), self.deformation.memory(names)
        lower, upper = (ca.DM([self.units.get(n, _SAME).bounds[end] for n in names]) for end in (0, 1))
        # The plain form begins at the target in force from its first cycle on, and moves it once samples count.
        held = tuple(map(float, begun - first)) if pairing is not None and pairing.plain else ()
        last = (
            Signal("shift_last", names, start=held),
            Signal("target_last", names, start=start),
            scalar("shift_cycles"),
        )
        response, steepness = plant.equations.controlled_response, self._steepness(plant)
        memory = Layout((*last, *(pairing.memory(problem, first, begun - first) if pairing else ()))) + own

        def step(s: Signals) -> dict[str, Expression]:
            shown, before = getattr(s, seen.name)[places], s.shift_last
            wanted, output = (self._units(plant, one, s.parameters, "to") for one in (s.reference[places], shown))
            in_force = pairing.in_force(problem, s, wanted) if pairing else s.target_last
            undeformed = pairing.undeformed(s, in_force) if pairing else wanted
            remembered = {m: getattr(s, m) for m in own.names}
            request, after = self.deformation.step(in_force, output, undeformed, remembered)
            change = request - undeformed
            running = ca.logic_and(s.shift_cycles > problem.warm_up_cycles - 0.5, is_finite(change))
            beyond, sent = (response(s.state, getattr(s, u), s.parameters) for u in _COMMANDS)
            away = beyond - sent if steepness is None else steepness(shown, s.parameters) * (beyond - sent)
            onwards = ca.logic_not(ca.dot(change - before, away) < 0)  # NaN is no way back
            grows = ca.logic_and(ca.logic_and(s.clipped_last > 0.5, onwards), ca.fabs(change) > ca.fabs(before))
            shift = ca.if_else(running, ca.if_else(grows, before, change), before)
            target, own_shift = wanted + shift, shift
            if self.units:
                target = ca.fmin(ca.fmax(target, lower), upper)
                shift = target - wanted
                own_shift = self._units(plant, target, s.parameters, "back") - s.reference[places]
            paired = pairing.remembered(problem, s, wanted, shift) if pairing else {}
            counted = {"shift_cycles_next": ca.fmin(s.shift_cycles + 1, problem.warm_up_cycles)}
            own_next = {f"{m}_next": ca.if_else(running, after[m], remembered[m]) for m in own.names}
            held = {"shift_last_next": shift, "target_last_next": target, **counted}
            return {SHIFT: own_shift, "shift": own_shift, **held, **paired, **own_next}

        commands = (like(plant.input, name) for name in _COMMANDS)
        measured = (*measured_signals(plant), plant.parameter)
        reads = Layout((Signal("reference", seen.elements), *measured, scalar("clipped_last"), *commands))
        writes = Layout((Signal(SHIFT, names, units), Signal("shift", names, units)))
        return Block("shift", reads, writes, step, memory)


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

    lossy = inner.bridged_if_any
    bridged = None if lossy is None else lambda: _renamed(lossy(), written)
    return replace(block, writes=writes, step=step, bridged=bridged)


# What is left is the dead time of the problem.
EXAMPLES = (Example(problem="heat_exchanger", controller="Cascade", left=0.4, changes={"reality": None}),)
