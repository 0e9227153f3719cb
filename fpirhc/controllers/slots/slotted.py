"""Time slots: one input serves several coordinates in turn. Theory: docs/theory.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import casadi as ca
import numpy as np

from fpirhc.contraction.delayed import converges, delayed, largest_gain
from fpirhc.contraction.spectrum import Spectrum, assess_gain
from fpirhc.controllers.base import (
    Controller,
    Response,
    clip,
    deform_block,
    like,
    reference_block,
    under_names,
    warm_up_block,
)
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import late_deformation
from fpirhc.controllers.path import Answers, answer_block, measured_output
from fpirhc.controllers.reference_states import stages_of
from fpirhc.controllers.slots.schedules import Schedule
from fpirhc.controllers.slots.slot import (
    Channel,
    First,
    Slot,
    channel,
    delays_for_channel,
    for_channel,
    integrators,
    measured_order,
    reads_equations,
)
from fpirhc.deformation.base import Deformation, Identity
from fpirhc.deformation.model_referenced import settled
from fpirhc.errors import FpirhcError, Mistakes, NotContractive
from fpirhc.fields.kinds import Accuracy, CountOrZero, NotNegative
from fpirhc.members import Example
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.motion import followed_units, time_signal
from fpirhc.sensing.base import spline_weights
from fpirhc.sensing.positions import PositionDifference
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, Value, expression, is_finite, left_after
from fpirhc.symbolic.layout import Expression, Layout, Signal, discrete, scalar
from fpirhc.symbolic.open import expressed
from fpirhc.task.problem import Problem


@dataclass(frozen=True)
class Slotted(Controller):
    """One coordinate at a time, by a schedule.

    Args:
        slots: one per coordinate.
        schedule: chooses the active slot (Periodic).
        blend: time constant with which the offset of a switch decays, s; 0: the law is joined at once, and the command jumps
            one cycle after the switch.
        blank: number of cycles at the start of a slot in which the difference between request and desired response stays constant,
            for measurements of y^(r) that need as many cycles after a switch.
        smallest_gain: share of its size at the start that |beta| must keep; below it the command is held (signal `slot_held`).

    References:
        J. K. Tar, J. F. Bito, I. J. Rudas, Contradiction resolution in the adaptive control of underactuated mechanical systems
        evading the framework of optimal controllers, Acta Polytechnica Hungarica 13(1), 2016, for the idea; the switching is
        our own.
    """

    slots: Sequence[Slot]
    schedule: Schedule
    blend: NotNegative
    blank: CountOrZero = 0
    smallest_gain: Accuracy = 0.05

    @property
    def deformation(self) -> Deformation:
        """The deformation of the first slot that adapts; Identity() where no slot does."""
        return next((s.deformation for s in self.slots if s.adapts), Identity())

    def response(self, problem: Problem) -> Response:
        """Return the response y^(r) of every slot's coordinate: by the equations of what moves, or from what is measured."""
        channels = self.channels(problem)
        function = _response(problem, channels) if reads_equations(problem) else None
        return Response(_realised(problem, channels), function)

    def with_deformation(self, deformation: Deformation) -> Slotted:
        return replace(self, slots=tuple(replace(slot, deformation=deformation) for slot in self.slots))

    def with_defaults(self, problem: Problem) -> Slotted:
        slots = [replace(s, deformation=late_deformation(s.deformation, problem)) for s in self.slots]
        same = all(a.deformation is b.deformation for a, b in zip(slots, self.slots, strict=True))
        return self if same else replace(self, slots=tuple(slots))

    def _late(self, problem: Problem) -> list[str]:
        """Sentences about slots for which a run is too short."""
        names, unit = [s.coordinate for s in self.slots], problem.time_unit
        shortest, sequence = min(self.schedule.dwells(names, problem).values()), self.schedule.sequence(problem)
        end = f"and the run ends at {problem.duration:g} {unit}"
        if not sequence and len(names) > 1 and shortest >= problem.duration:
            return [f"one slot alone gets a turn: it lasts {shortest:g} {unit}, {end}"]
        starts = accumulate((duration for _, duration in sequence), initial=0.0)
        turns = zip(sequence, starts, strict=False)
        return [
            f"slot '{name}' gets no turn: it would begin at {at:g} {unit}, {end}"
            for (name, _), at in turns
            if at >= problem.duration
        ]

    def channels(self, problem: Problem) -> list[Channel]:
        """Return the slots on the plant."""
        return [channel(problem, slot, k) for k, slot in enumerate(self.slots)]

    def check(self, problem: Problem) -> None:
        """Raise if the slots or the schedule do not fit the problem.

        Raises:
            InvalidProblem: mistakes of slots and schedule, all together; a slot that lasts too long.
            NotContractive: the gain of a deformation has the wrong sign or is too large at the start.
        """
        self._check_parts(problem)
        self._check_blank(problem)
        channels = self.channels(problem)
        for one in channels:
            _check_gain(problem, one)

    def _check_parts(self, problem: Problem) -> None:
        """Raise with all mistakes of slots and schedule, which is not asked about slots that the plant does not know."""
        mistakes = Mistakes("Slotted")
        names = [s.coordinate for s in self.slots]
        if not names:
            mistakes.add("there are no slots; give at least one Slot(coordinate, tracking)")
        for name in sorted({n for n in names if names.count(n) > 1}):
            mistakes.add(f"coordinate '{name}' has more than one slot; give it one, which the schedule may repeat")
        for slot in self.slots:
            _check_slot(problem, slot, mistakes)
        if names and set(names) <= set(followed_units(problem.plant)):
            self.schedule.check(list(dict.fromkeys(names)), problem, mistakes)
        mistakes.raise_if_any()

    def _check_blank(self, problem: Problem) -> None:
        """Raise where a slot that adapts is over before its map learns."""
        dwells, mistakes = self.schedule.dwells([s.coordinate for s in self.slots], problem), Mistakes("Slotted")
        for one in self.slots:
            cycles = dwells[one.coordinate] / problem.period
            if one.deformation.adapts and self.blank >= cycles * (1 + 1e-9):
                mistakes.add(
                    f"slot '{one.coordinate}' lasts {cycles:.4g} cycles, and its map learns nothing in the first "
                    f"blank = {self.blank}; choose a smaller blank"
                )
        mistakes.raise_if_any()

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        channels = self.channels(built.problem)
        realised = _realised(built.problem, channels)
        blocks = [*_realised_blocks(built, channels), reference_block(built)]
        blocks += [state_block(built, one, self.smallest_gain) for one in channels]
        blocks += [self.schedule.block(built.problem, channels), switch_block(channels)]
        delays: list[Delay] = []
        for one in channels:
            light, law = one.plant, one.slot.tracking
            blocks.append(for_channel(law.law(light, built.period), one, {"time"}, {"desired": one.wire("law")}))
            blocks += [_mirror(built, one, name) for name in one.slot.deformation.mirror.models]
            blocks.append(join_block(built, realised, one, self.blend, self.blank))
            names = {name: f"{name}_{one.slot.coordinate}" for name in one.slot.deformation.shown()}
            names["warm_up"] = one.wire("valid")
            blocks.append(for_channel(deform_block(light, one.slot.deformation), one, set(), names, settled_in(one)))
            delays += delays_for_channel(law.delays(light), one)
        blocks += [command_block(built, channels), judge_block(), _count_block(built, channels)]
        blocks += [
            for_channel(c.slot.tracking.update(c.plant, built.period), c, {"clipped", "time"}, {"_held": "_repeated"})
            for c in channels
        ]
        counted = {"warm_up": "_warm_up_now", "_slot_before": "slot", "_age_before": "_age"}
        delays += [Delay(discrete(now), source) for now, source in counted.items()]
        remembered = {"_offset_before": "_offset", "_distance_before": "_distance"}
        delays += [Delay(scalar(now), source) for now, source in remembered.items()]
        delays.append(Delay(built.before, "command"))
        delays.append(Delay(by_slot(channels, "_deformed_before"), "deformed"))
        return blocks, delays


def _check_slot(problem: Problem, slot: Slot, mistakes: Mistakes) -> None:
    name = slot.coordinate
    try:
        channel(problem, slot, 0)
        slot.deformation.largest_step()  # raises where a scale is not set
    except FpirhcError as error:
        mistakes.add(f"slot '{name}': {error}")
        return
    if name not in problem.judged_names:
        every = ", ".join(repr(n) for n in [*problem.judged_names, name])
        mistakes.add(
            f"slot '{name}' is not among the coordinates that are judged; write Problem(..., judged=({every}))"
        )


def _realised(problem: Problem, channels: Sequence[Channel]) -> Signal:
    """The signal of y^(r) of every slot; 'realised' is that of the plant's controlled quantities where it is measured."""
    return by_slot(channels, "realised" if reads_equations(problem) else "realised_of_slots")


def _realised_blocks(built: Built, channels: Sequence[Channel]) -> list[Block]:
    """Blocks (measured outputs, realised) -> y^(r) of every slot, measured or differenced; none where equations give it."""
    if reads_equations(built.problem):
        return []
    plant, motion, differences = built.plant, measured_output(built.plant), "_slot_differences"
    measured, realised = plant.response_signal("realised"), _realised(built.problem, channels)
    differenced = [c for c in channels if c.differences]
    names = tuple(c.slot.coordinate for c in differenced)
    blocks, reads = [], [measured]
    if differenced:
        orders = [measured_order(plant, n) for n in names]
        places = [motion.elements.index(n + "'" * k) for n, k in zip(names, orders, strict=True)]
        samples = Signal("_slot_samples", names)
        blocks = [
            Block(
                "slot_samples",
                Layout((motion,)),
                Layout((samples,)),
                lambda s: {samples.name: getattr(s, motion.name)[places]},
            ),
            _difference_block(built, differenced, orders, samples, differences),
        ]
        reads.append(Signal(differences, names))

    def step(s: Signals) -> dict[str, Expression]:
        entries = [
            getattr(s, differences)[names.index(c.slot.coordinate)]
            if c.differences
            else s.realised[plant.controlled_names.index(c.slot.coordinate)]
            for c in channels
        ]
        return {realised.name: ca.vertcat(*entries)}

    return [*blocks, Block("slot_responses", Layout(tuple(reads)), Layout((realised,)), step)]


def _difference_block(
    built: Built, channels: Sequence[Channel], orders: Sequence[int], samples: Signal, differences: str
) -> Block:
    """Block (samples) -> their backward differences, which go on over gaps as those of positions do."""
    plant, at = built.plant, (built.problem.start_state, built.plant.approximate)
    quantities = {c.slot.coordinate: (c.chain.unit, c.differences) for c in channels}
    light = integrators(plant, quantities, tuple(quantities))
    starts = {
        c.slot.coordinate + "'" * k: v
        for c, order in zip(channels, orders, strict=True)
        for k, v in enumerate(np.asarray(c.chain.states(*at).full()).ravel()[order:])
    }
    first = np.array([starts[e] for e in light.state.elements])
    estimate = PositionDifference().block(light, built.period, first, samples)
    names = {light.state.name: "_slot_chains", "realised": differences, "estimate_past": "_slot_past"}
    return under_names(replace(estimate, name="slot_differences"), names)


def _usable_from(problem: Problem, one: Channel, measurement: float) -> float:
    """Number of the first cycle whose y^(r) is of samples of this run; `measurement` is its dead time."""
    if reads_equations(problem):
        return 1
    plant, estimator, late = problem.plant, problem.sensing.estimator, math.ceil(measurement / problem.period)
    chain, name = one.chain, one.slot.coordinate
    if not one.differences:
        return 1 if estimator.measures_all else late + estimator.fills(chain.order)
    estimated = measured_order(plant, name) and not estimator.measures_all
    return late + one.differences + (estimator.fills(plant.chains[name]) if estimated else 0)


def _count_block(built: Built, channels: Sequence[Channel]) -> Block:
    """Block that counts the cycles until every y^(r) may be used."""
    late = built.problem.dead_time.measurement
    return warm_up_block(max(_usable_from(built.problem, c, late) for c in channels))


def _mirror(built: Built, one: Channel, name: str) -> Block:
    """Block -> y^(r) of the model at what is measured and under the command that acted, as late as the plant's."""
    chain, calm = one.chain, ca.DM.zeros(len(built.plant.names))
    path = built.path(one.slot.deformation, f"mirror_{one.number}")
    answers = Answers(lambda x, u, p: chain.response(x, u, p, calm), {chain.coordinate: chain.order}, one.signal(name))
    return answer_block(path, answers)


def _response(problem: Problem, channels: Sequence[Channel]) -> ca.Function:
    """Function (state, input, parameters, forcing) of what moves -> y^(r) of every slot."""
    return problem.truth.function([c.chain.coordinate + "'" * c.chain.order for c in channels])


def _check_gain(problem: Problem, one: Channel) -> None:
    """Raise NotContractive where the deformation does not converge with J = beta of the plant / beta of the model, at the start."""
    deformation, known = one.slot.deformation, problem.of_equations
    if not one.slot.adapts:
        return
    truth, place = known.real_plant, problem.plant.input.elements.index(one.chain.input)
    x, u, p = truth.symbols()
    response = _response(known, [one])(x, u, p, ca.SX.zeros(len(truth.names)))
    gain = ca.Function("fpirhc_slot_gain", [x, u, p], [ca.jacobian(response, u[place])])
    exact = float(gain(known.real_start, np.zeros(u.numel()), known.real_parameters))
    report = assess_gain(deformation, Spectrum(np.array([exact / one.start_gain])))
    if not report.contractive:
        raise NotContractive(f"slot '{one.slot.coordinate}': {report.text}")
    weights = _weights(problem, one)
    if weights.size == 1:
        return
    dead_time = problem.dead_time.inputs.get(one.chain.input, 0.0) + problem.dead_time.measurement
    seen = delayed(weights, dead_time / problem.period)
    asked = deformation, np.array([[exact / one.start_gain]]), [seen]
    if not converges(*asked):
        most, size = largest_gain(*asked), abs(deformation.effective_gain())
        raise NotContractive(
            f"slot '{one.slot.coordinate}': its response is of several cycles, so the iteration converges only for effective gains "
            f"below {most:.3g}, and this one is {size:.3g}; use a smaller gain"
        )


def _weights(problem: Problem, one: Channel) -> np.ndarray:
    """Weights of past requests in the measured y^(r)."""
    if reads_equations(problem):
        return np.ones(1)
    estimator = problem.sensing.estimator
    if estimator.of_steps or not one.differences:
        return estimator.weights(one.chain.order, problem.period)
    return spline_weights(one.differences)


def by_slot(channels: Sequence[Channel], name: str) -> Signal:
    """A signal that holds a y^(r) of every slot."""
    return Signal(name, tuple(c.slot.coordinate for c in channels), tuple(c.chain.response_unit for c in channels))


def state_block(built: Built, one: Channel, smallest_gain: float) -> Block:
    """Block -> the slot's chain, its target, y^(r),N, alpha and beta of the model, and whether beta is large enough.

    What is measured of the chain is the measured value; the rest is the model's.
    """
    plant, chain, seen = built.plant, one.chain, built.plant.output
    elements = one.plant.state.elements
    derivatives = built.problem.reference.chain(plant, stages_of(built.problem), chain.coordinate, chain.order)
    place = plant.input.elements.index(chain.input)
    smallest = smallest_gain * abs(one.start_gain)

    def step(s: Signals) -> dict[str, Expression]:
        nominal = derivatives(s.time, *built.own_values(s))
        others = ca.vertcat(*(0 if k == place else s._command_before[k] for k in range(plant.input.size)))
        gain = chain.gain(s.state, others, s.parameters)
        measured = dict(zip(seen.elements, ca.vertsplit(getattr(s, seen.name)), strict=True))
        modelled = ca.vertsplit(chain.states(s.state, s.parameters))
        good = ca.fabs(gain) >= expressed(smallest, gain)
        values = {
            "state": ca.vertcat(*(measured.get(e, own) for e, own in zip(elements, modelled, strict=True))),
            "target": nominal[: chain.order] if chain.order > 1 else nominal[0],
            "nominal": nominal[chain.order],
            "free": chain.response(s.state, others, s.parameters, ca.DM.zeros(len(plant.names))),
            "gain": gain,
            "good": good,
            # Not zero, so that no slot that is not chosen divides by it.
            "divisor": ca.if_else(good, gain, ca.copysign(smallest, one.start_gain)),
        }
        return {one.wire(name): value for name, value in values.items()}

    writes = [one.signal(n, elements) for n in ("state", "target")]
    writes += [one.signal(n) for n in ("nominal", "free", "gain", "good", "divisor")]
    motion, before = measured_signals(plant), like(plant.input, "_command_before")
    reads = (time_signal(plant), *motion, plant.parameter, before, *built.own)
    return Block(
        f"slot_state_{one.number}", Layout(reads), Layout(tuple(writes)), step, opaque=built.problem.reference.opaque
    )


def _column(s: Signals, channels: Sequence[Channel], name: str) -> Expression:
    return ca.vertcat(*(getattr(s, c.wire(name)) for c in channels))


def switch_block(channels: Sequence[Channel]) -> Block:
    """Block -> per slot whether it is active and whether it was active in the last cycle too; cycles since it began."""
    reads = Layout((scalar("slot"), scalar("_slot_before"), scalar("_age_before"), scalar("warm_up")))

    def step(s: Signals) -> dict[str, Expression]:
        goes_on = ca.logic_and(s.warm_up > 0.5, s.slot == s._slot_before)
        flags = {"_age": ca.if_else(goes_on, s._age_before + 1, 0)}
        for one in channels:
            active = s.slot == one.number
            flags[one.wire("active")] = active
            flags[one.wire("warm_up")] = ca.logic_and(active, goes_on)
        return flags

    writes = [c.signal(n) for c in channels for n in ("active", "warm_up")]
    return Block("switch", reads, Layout((scalar("_age"), *writes)), step)


def join_block(built: Built, measured: Signal, one: Channel, blend: float, blank: int) -> Block:
    """Block that joins the slot's law to the plant's last motion: the desired response and the pair of the last cycle.

    `measured`: signal of y^(r) of every slot.
    """
    decay = left_after(built.period, blend)
    place = built.plant.input.elements.index(one.chain.input)
    request_before, models = _request_before(one), [n.removeprefix("_") for n in one.slot.deformation.mirror.models]
    names = ("law", "free", "gain", "active", "warm_up", *models)
    first = _usable_from(built.problem, one, built.problem.dead_time.measurement)
    at_once = first == 1

    def step(s: Signals) -> dict[str, Expression]:
        law, free, gain, active, goes_on, *modelled = (getattr(s, one.wire(name)) for name in names)
        running, realised = s.warm_up > 0.5, getattr(s, measured.name)[one.number]
        usable = running if at_once else s.warm_up > first - 0.5
        switched = ca.logic_and(ca.logic_and(active, running), ca.logic_not(goes_on))
        last_request = free + gain * s._command_before[place]
        response = realised if one.slot.adapts else last_request
        for model in modelled:  # what the form adds is the difference of model and plant, and the command stays
            response = last_request + realised - model
        if one.slot.adapts and not at_once:
            response = ca.if_else(usable, response, last_request)
        offset = ca.if_else(switched, response - law, decay * s._offset_before)
        desired = law + ca.if_else(active, offset, 0)
        blanked = ca.logic_and(ca.logic_and(active, running), s._age < blank - 0.5)
        own_request = ca.if_else(switched, last_request, s._deformed_before[one.number])
        pair = next(iter(modelled), own_request)
        values = {
            "offset": offset,
            "desired": desired,
            "distance": ca.if_else(switched, last_request - desired, s._distance_before),
            "realised": realised if at_once else ca.if_else(usable, realised, pair),
            "valid": ca.logic_and(ca.logic_and(active, usable), ca.logic_not(blanked)),
            "blanked": blanked,
            **({} if models else {request_before: own_request}),
        }
        return {one.wire(name): value for name, value in values.items()}

    shared = [scalar(n) for n in ("warm_up", "_age", "_offset_before", "_distance_before")]
    columns = [measured, replace(measured, name="_deformed_before")]
    reads = [*(one.signal(n) for n in names), *shared, *columns, like(built.plant.input, "_command_before")]
    own = () if models else (request_before,)
    results = ("offset", "desired", "distance", "realised", "valid", "blanked", *own)
    return Block(f"join_{one.number}", Layout(tuple(reads)), Layout(tuple(one.signal(n) for n in results)), step)


def _request_before(one: Channel) -> str:
    """Name of the request that the slot's map is given: the response of the model in a model-referenced form, else its last one."""
    return one.slot.deformation.mirror.request.removeprefix("_")


def settled_in(one: Channel) -> First:
    """Return what the slot's deformation remembers when it begins: the pair of the last command, just realised."""
    request = one.wire(_request_before(one))

    def first(s: Signals) -> Mapping[str, Expression]:
        return settled(one.slot.deformation, getattr(s, request), getattr(s, one.wire("realised")))

    return first


_FLAGS = ("active", "good", "blanked")
_VALUES = ("nominal", "desired", "deformed_unclipped", "distance", "offset", "free", "gain", "divisor")
_PER_SLOT = (*_FLAGS, *_VALUES)


def command_block(built: Built, channels: Sequence[Channel]) -> Block:
    """Block that inverts the active slot's request, clips the command, and writes what the command means for every slot."""
    plant = built.plant
    lower, upper = built.ends
    places = [plant.input.elements.index(c.chain.input) for c in channels]

    def step(s: Signals) -> dict[str, Value]:
        slot = {name: _column(s, channels, name) for name in _PER_SLOT}
        requests = ca.if_else(slot["blanked"], slot["desired"] + slot["distance"], slot["deformed_unclipped"])
        commands = (requests - slot["free"]) / slot["divisor"]
        unclipped = _column_of_inputs(slot["active"], commands, places, s._command_before)
        good = _pick(slot["active"], slot["good"]) > 0.5
        finite = is_finite(unclipped)
        usable = ca.logic_and(finite, good)
        command = clip(ca.if_else(usable, unclipped, s._command_before), lower, upper)
        entries = ca.vertcat(*(command[p] for p in places))
        # Exactly the request where nothing was clipped.
        clipped_requests = requests + slot["gain"] * (entries - commands)
        exact = ca.logic_and(slot["active"], usable)
        cut_off = slot["gain"] * (commands - entries)
        return {
            "command": command,
            "nominal": slot["nominal"],
            "desired": slot["desired"],
            "deformed": ca.if_else(exact, clipped_requests, slot["free"] + slot["gain"] * entries),
            "clipped": ca.mmax(command != unclipped),
            "slot_held": ca.logic_not(good),
            "_held": ca.logic_not(finite),
            "_repeated": ca.logic_not(usable),
            "_offset": _finite(_pick(slot["active"], slot["offset"])),
            "_distance": _finite(_pick(slot["active"], slot["distance"])),
            **{c.wire("_cut_off"): cut_off[k] for k, c in enumerate(channels)},
        }

    reads = [c.signal(n) for c in channels for n in _PER_SLOT]
    responses = [by_slot(channels, n) for n in ("nominal", "desired", "deformed")]
    scalars = [scalar(n) for n in ("clipped", "slot_held", "_held", "_repeated", "_offset", "_distance")]
    writes = (plant.input, *responses, *scalars, *(c.signal("_cut_off") for c in channels))
    return Block("command", Layout((*reads, like(plant.input, "_command_before"))), Layout(writes), step)


def _column_of_inputs(active: Expression, commands: Expression, places: list[int], before: Expression) -> Expression:
    """The command of the active slot at the place of its input; the other inputs keep their last command."""
    own = [active * ca.DM([p == k for p in places]) for k in range(before.numel())]
    return ca.vertcat(*(_pick(mask, commands, before[k]) for k, mask in enumerate(own)))


def _pick(active: Expression, values: Expression, otherwise: Value = 0) -> Expression:
    """The value of the active slot. It is not a sum, because one value that is not finite would spoil a sum."""
    value = otherwise
    for k in range(values.numel()):
        value = ca.if_else(active[k] > 0.5, values[k], value)
    return expression(value)


def _finite(value: Expression) -> Expression:
    """Zero in place of a number that is not finite: the number would be remembered for the rest of the slot."""
    return ca.if_else(is_finite(value), value, 0)


def judge_block() -> Block:
    """Block -> status: whether the command was held, because it was not finite or because the gain is too small."""

    def step(s: Signals) -> dict[str, Expression]:
        return {"status": ca.fmax(s._held * int(Status.NON_FINITE), s.slot_held * int(Status.HELD))}

    return Block("judge", Layout((scalar("_held"), scalar("slot_held"))), Layout((scalar("status"),)), step)


EXAMPLES = (Example(problem="mass_spring_slots", controller="slots"),)
