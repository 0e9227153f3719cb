"""Time slots: one input serves several coordinates in turn.

A plant with fewer inputs than coordinates cannot prescribe all of them at once. Instead of weighing them in one cost, time is cut
into slots: in each one coordinate y follows its reference with its own relative order r,

    y^(r) = alpha(x) + beta(x) u,        u = (r^Def - alpha) / beta  by the model,

while the others follow the zero dynamics of y. A slot need not be stable alone; the schedule must be, see `floquet_radius`.

At a switch the command is continuous. The first request of a slot is what the last command means for it by the model,
r_0 = alpha + beta u, and the law is joined without a step,

    desired = law + offset e^(-(t - t_0) / blend),    offset = y^(r) as it is - law  at t_0,

where y^(r) as it is means the realised one for a slot that adapts (its deformation then begins at a fixed point: the request r_0
was just realised) and r_0 for one that does not. So the command of the first cycle of a slot is the last command, and the
change per cycle afterwards is at most

    ( |offset| (1 - e^(-period / blend)) + |change of law and of alpha| + |step of the deformation| ) / |beta|.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.contraction import Spectrum, assess_gain
from fpirhc.controllers.base import FINITE, Controller, Response, clip, deform_block, error_signal, like
from fpirhc.controllers.floquet import radius_of
from fpirhc.controllers.schedules import Schedule
from fpirhc.controllers.slot import Channel, Slot, channel, delays_for_channel, for_channel
from fpirhc.controllers.slot_modes import linear_modes
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.identity import Identity
from fpirhc.errors import FpirhcError, InvalidValue, Mistakes, NotContractive
from fpirhc.problem import Problem
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar


@dataclass(frozen=True)
class Slotted(Controller):
    """One coordinate at a time, by a schedule.

    Parameters:
        slots: what each slot controls; one per coordinate.
        schedule: which slot is active (FixedSchedule, Periodic, ByError, ByLookAhead).
        blend: time constant with which the offset of a switch decays, s; 0: the law is joined at once, and the command jumps
            one cycle after the switch.
        blank: cycles at the start of a slot in which the request keeps its distance from the desired response, for measurements
            of y^(r) that need as many cycles after a switch.
        smallest_gain: share of its size at the start that |beta| must keep; below it the command is held (signal `slot_held`).
        largest_growth: by how much a diverging zero dynamics may grow within one slot.

    Raises:
        InvalidValue: a number out of range.

    References:
        J. K. Tar, J. F. Bito, I. J. Rudas, Contradiction resolution in the adaptive control of underactuated mechanical systems
        evading the framework of optimal controllers, Acta Polytechnica Hungarica 13(1), 2016, for the idea; the switching is
        our own.
    """

    slots: Sequence[Slot]
    schedule: Schedule
    blend: float
    blank: int = 0
    smallest_gain: float = 0.05
    largest_growth: float = 100.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.blend) and self.blend >= 0):
            raise InvalidValue(f"Slotted(blend={self.blend!r}): expected a number of seconds of at least 0")
        if not (isinstance(self.blank, int) and self.blank >= 0):
            raise InvalidValue(f"Slotted(blank={self.blank!r}): expected a whole number of cycles of at least 0")
        if not 0 < self.smallest_gain < 1:
            raise InvalidValue(f"Slotted(smallest_gain={self.smallest_gain!r}): expected a share between 0 and 1")
        if not self.largest_growth > 1:
            raise InvalidValue(f"Slotted(largest_growth={self.largest_growth!r}): expected a factor above 1")

    @property
    def adaptive(self) -> Deformation:
        """The first slot's deformation that iterates, or Identity."""
        return next((s.deformation for s in self.slots if s.adapts), Identity())

    def response(self, problem: Problem) -> Response:
        """y^(r) of every slot's coordinate."""
        channels = self.channels(problem)
        names = tuple(c.slot.coordinate for c in channels)
        signal = Signal("realised", names, tuple(c.chain.response_unit for c in channels))
        x, u, p = problem.plant._symbols()
        w = ca.SX.sym("w", len(problem.plant.names))
        found = ca.vertcat(*(c.chain.response(x, u, p, w) for c in channels))
        return Response(signal, ca.Function("fpirhc_slots_realised", [x, u, p, w], [found]))

    def notes(self, problem: Problem) -> tuple[str, ...]:
        """The Floquet radius of the schedule, and each slot's fastest divergence."""
        found = radius_of(problem, self.channels(problem), self.schedule, self.blend)
        if found.radius is None:
            return (f"no Floquet radius: {found.reason}",)
        alone = ", ".join(
            f"{name} {round(values.real.max(), 6) + 0.0:.3g}" for name, values in found.eigenvalues.items()
        )
        verb = "shrink" if found.radius < 1 else "grow"
        return (
            f"Floquet radius {found.radius:.3g} per period of {found.period:g} s: near the set-point errors {verb} "
            f"(largest real part in each slot alone, 1/s: {alone})",
        )

    def channels(self, problem: Problem) -> list[Channel]:
        """The slots on the plant."""
        return [channel(problem, slot, k) for k, slot in enumerate(self.slots)]

    def check(self, problem: Problem) -> None:
        """Raise if the slots or the schedule do not fit the problem.

        Raises:
            InvalidProblem: all mistakes together. NotInvertible: y^(r) not affine in the input. NotContractive: a deformation's
            gain of the wrong sign or too large at the start.
        """
        mistakes = Mistakes("Slotted")
        names = [s.coordinate for s in self.slots]
        if not names:
            mistakes.add("there are no slots; give at least one Slot(coordinate, tracking)")
        for name in sorted({n for n in names if names.count(n) > 1}):
            mistakes.add(
                f"coordinate '{name}' has more than one slot; a schedule may visit one slot as often as it likes"
            )
        for slot in self.slots:
            _check_slot(problem, slot, mistakes)
        self.schedule.check(names, problem, mistakes)
        mistakes.raise_if_any()
        channels = self.channels(problem)
        for one in channels:
            _check_gain(problem, one)
        self._check_growth(problem, channels)

    def _check_growth(self, problem: Problem, channels: Sequence[Channel]) -> None:
        """By the model, at the reference's last point; without a set-point nothing is said."""
        modes, _ = linear_modes(problem, channels, problem.plant.approximate, 0.0)
        dwells = self.schedule.dwells([c.slot.coordinate for c in channels], problem)
        mistakes = Mistakes("Slotted")
        for one, mode in zip(channels, modes, strict=False):
            name, exponent = one.slot.coordinate, mode.rate * dwells[one.slot.coordinate]
            if exponent > math.log(self.largest_growth):
                mistakes.add(
                    f"slot '{name}' lasts {dwells[name]:g} s, in which its zero dynamics, diverging at {mode.rate:.3g} 1/s, grow "
                    f"e^{exponent:.3g} times, more than largest_growth = {self.largest_growth:g}; make it shorter than "
                    f"{math.log(self.largest_growth) / mode.rate:.3g} s"
                )
        mistakes.raise_if_any()

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        """Blocks reference, schedule; per slot tracking, join, deform; then command, judge, tracking updates."""
        channels = self.channels(problem)
        blocks = [_reference_block(problem)]
        blocks += [_state_block(problem, one, self.smallest_gain) for one in channels]
        blocks += [_admissible_block(channels), self.schedule.block(problem, channels), _switch_block(channels)]
        delays: list[Delay] = []
        for one in channels:
            light, law = one.plant, one.slot.tracking
            blocks.append(for_channel(law.law(light, problem.period), one, {"time"}, {"desired": one.wire("law")}))
            blocks.append(_join_block(problem, channels, one, self.blend, self.blank))
            shown = {name: f"{name}_{one.slot.coordinate}" for name in one.slot.deformation.shown()}
            shown["started"] = one.wire("valid")
            blocks.append(for_channel(deform_block(light, one.slot.deformation), one, set(), shown))
            delays += delays_for_channel(law.delays(light), one)
        blocks += [_command_block(problem, channels), _judge_block()]
        blocks += [
            for_channel(c.slot.tracking.update(c.plant, problem.period), c, {"clipped", "time"}, {}) for c in channels
        ]
        remembered = {"started": "_running", "_slot_before": "slot", "_age_before": "_age"}
        remembered |= {"_offset_before": "_offset", "_kept_before": "_kept"}
        delays += [Delay(scalar(now), source) for now, source in remembered.items()]
        delays.append(Delay(like(problem.plant.input, "_command_before"), "command"))
        delays.append(Delay(_by_slot(channels, "_deformed_before"), "deformed"))
        return blocks, delays


def _check_slot(problem: Problem, slot: Slot, mistakes: Mistakes) -> None:
    name = slot.coordinate
    try:
        channel(problem, slot, 0)
    except FpirhcError as error:
        mistakes.add(f"slot '{name}': {error}")
        return
    if name not in problem.judged_names:
        every = ", ".join(repr(n) for n in [*problem.judged_names, name])
        mistakes.add(
            f"slot '{name}' is not among the coordinates that are judged; write Problem(..., judged=({every}))"
        )


def _check_gain(problem: Problem, one: Channel) -> None:
    """J = beta / beta of the model, at the start."""
    if not one.slot.adapts:
        return
    exact = float(one.chain.gain(problem.start_state, np.zeros(problem.plant.input.size), problem.plant.exact))
    report = assess_gain(one.slot.deformation, Spectrum(np.array([exact / one.start_gain])))
    if not report.contractive:
        raise NotContractive(f"slot '{one.slot.coordinate}': {report.text}")


def _by_slot(channels: Sequence[Channel], name: str) -> Signal:
    """A signal that holds a y^(r) of every slot."""
    return Signal(name, tuple(c.slot.coordinate for c in channels), tuple(c.chain.response_unit for c in channels))


def _reference_block(problem: Problem) -> Block:
    """Block (time, state) -> (reference state, error of the judged coordinates)."""
    plant, function = problem.plant, problem.reference.function(problem.plant)
    places = [plant.state.elements.index(c) for c in problem.judged_names]

    def step(s: Any) -> dict[str, Expression]:
        reference = function(s.time)[0]
        return {"reference": reference, "error": reference[places] - s.state[places]}

    writes = Layout((like(plant.state, "reference"), error_signal(problem, "error")))
    reads = Layout((scalar("time", "s"), plant.state))
    return Block("reference", reads, writes, step, opaque=problem.reference.opaque)


def _state_block(problem: Problem, one: Channel, smallest_gain: float) -> Block:
    """Block -> the slot's chain and its target, y^(r),N, and alpha, beta of the model; whether beta is large enough."""
    plant, chain = problem.plant, one.chain
    ladder = problem.reference.ladder(chain.coordinate, chain.order)
    place = plant.input.elements.index(chain.input)
    smallest = smallest_gain * abs(one.start_gain)

    def step(s: Any) -> dict[str, Expression]:
        nominal = ladder(s.time)
        others = ca.vertcat(*(0 if k == place else s._command_before[k] for k in range(plant.input.size)))
        gain = chain.gain(s.state, others, s.parameters)
        good = ca.fabs(gain) >= smallest
        values = {
            "state": chain.states(s.state, s.parameters),
            "target": nominal[: chain.order] if chain.order > 1 else nominal[0],
            "nominal": nominal[chain.order],
            "free": chain.response(s.state, others, s.parameters, ca.DM.zeros(len(plant.names))),
            "good": good,
            # Not zero, so that no slot that is not chosen divides by it.
            "gain": ca.if_else(good, gain, math.copysign(smallest, one.start_gain)),
        }
        return {one.wire(name): value for name, value in values.items()}

    elements = one.plant.state.elements
    writes = [one.signal(n, elements) for n in ("state", "target")]
    writes += [one.signal(n) for n in ("nominal", "free", "good", "gain")]
    reads = Layout((scalar("time", "s"), plant.state, plant.parameter, like(plant.input, "_command_before")))
    return Block(f"slot_state_{one.number}", reads, Layout(tuple(writes)), step, opaque=problem.reference.opaque)


def _admissible_block(channels: Sequence[Channel]) -> Block:
    """Block that puts together which slots have gain enough."""
    writes = Signal("_admissible", tuple(c.slot.coordinate for c in channels))
    reads = Layout(tuple(c.signal("good") for c in channels))
    return Block("admissible", reads, Layout((writes,)), lambda s: {"_admissible": _column(s, channels, "good")})


def _column(s: Any, channels: Sequence[Channel], name: str) -> Expression:
    return ca.vertcat(*(getattr(s, c.wire(name)) for c in channels))


def _switch_block(channels: Sequence[Channel]) -> Block:
    """Block -> per slot whether it is active, and whether it was in the last cycle too; cycles since it began."""
    reads = Layout((scalar("slot"), scalar("_slot_before"), scalar("_age_before"), scalar("started")))

    def step(s: Any) -> dict[str, Expression]:
        goes_on = ca.logic_and(s.started > 0.5, s.slot == s._slot_before)
        found = {"_age": ca.if_else(goes_on, s._age_before + 1, 0)}
        for one in channels:
            active = s.slot == one.number
            found[one.wire("active")] = active
            found[one.wire("started")] = ca.logic_and(active, goes_on)
        return found

    writes = [c.signal(n) for c in channels for n in ("active", "started")]
    return Block("switch", reads, Layout((scalar("_age"), *writes)), step)


def _join_block(problem: Problem, channels: Sequence[Channel], one: Channel, blend: float, blank: int) -> Block:
    """Block that joins the slot's law to what the plant did before: the desired response, and the pair that came before."""
    decay = math.exp(-problem.period / blend) if blend > 0 else 0.0
    place = problem.plant.input.elements.index(one.chain.input)
    names = ("law", "free", "gain", "active", "started")

    def step(s: Any) -> dict[str, Expression]:
        law, free, gain, active, goes_on = (getattr(s, one.wire(name)) for name in names)
        running, realised = s.started > 0.5, s.realised[one.number]
        switched = ca.logic_and(ca.logic_and(active, running), ca.logic_not(goes_on))
        meant = free + gain * s._command_before[place]
        as_it_is = realised if one.slot.adapts else meant
        offset = ca.if_else(switched, as_it_is - law, decay * s._offset_before)
        desired = law + ca.if_else(active, offset, 0)
        blanked = ca.logic_and(ca.logic_and(active, running), s._age < blank - 0.5)
        values = {
            "offset": offset,
            "desired": desired,
            "kept": ca.if_else(switched, meant - desired, s._kept_before),
            "request_before": ca.if_else(switched, meant, s._deformed_before[one.number]),
            "realised": realised,
            "valid": ca.logic_and(ca.logic_and(active, running), ca.logic_not(blanked)),
            "blanked": blanked,
        }
        return {one.wire(name): value for name, value in values.items()}

    shared = [scalar(n) for n in ("started", "_age", "_offset_before", "_kept_before")]
    columns = [_by_slot(channels, n) for n in ("realised", "_deformed_before")]
    reads = [*(one.signal(n) for n in names), *shared, *columns, like(problem.plant.input, "_command_before")]
    results = ("offset", "desired", "kept", "request_before", "realised", "valid", "blanked")
    return Block(f"join_{one.number}", Layout(tuple(reads)), Layout(tuple(one.signal(n) for n in results)), step)


_OF_A_SLOT = ("active", "good", "nominal", "desired", "deformed_wanted", "blanked", "kept", "offset", "free", "gain")


def _command_block(problem: Problem, channels: Sequence[Channel]) -> Block:
    """Block that inverts the active slot's request, clips the command, and says what it means for every slot."""
    plant = problem.plant
    lower, upper = problem.limits.input_bounds(plant)
    places = [plant.input.elements.index(c.chain.input) for c in channels]

    def step(s: Any) -> dict[str, Expression]:
        per_slot = {name: _column(s, channels, name) for name in _OF_A_SLOT}
        active, free, gain = per_slot["active"], per_slot["free"], per_slot["gain"]
        wanted = ca.if_else(per_slot["blanked"], per_slot["desired"] + per_slot["kept"], per_slot["deformed_wanted"])
        requests = (wanted - free) / gain
        good = _pick(active, per_slot["good"]) > 0.5
        requested = [
            _pick(active * ca.DM([p == k for p in places]), requests, s._command_before[k])
            for k in range(plant.input.size)
        ]
        asked = ca.vertcat(*requested)
        finite = ca.mmin(ca.fabs(asked) <= FINITE)
        usable = ca.logic_and(finite, good)
        command = clip(ca.if_else(usable, asked, s._command_before), lower, upper)
        entries = ca.vertcat(*(command[p] for p in places))
        # Exactly the wanted response where nothing was clipped.
        moved = wanted + gain * (entries - requests)
        exact = ca.logic_and(active, usable)
        return {
            "command": command,
            "nominal": per_slot["nominal"],
            "desired": per_slot["desired"],
            "deformed": ca.if_else(exact, moved, free + gain * entries),
            "clipped": ca.mmax(command != asked),
            "slot_held": ca.logic_not(good),
            "_held": ca.logic_not(finite),
            "_offset": _pick(active, per_slot["offset"]),
            "_kept": _pick(active, per_slot["kept"]),
            "_running": 1,
        }

    reads = [c.signal(n) for c in channels for n in _OF_A_SLOT]
    responses = [_by_slot(channels, n) for n in ("nominal", "desired", "deformed")]
    scalars = [scalar(n) for n in ("clipped", "slot_held", "_held", "_offset", "_kept", "_running")]
    writes = (plant.input, *responses, *scalars)
    return Block("command", Layout((*reads, like(plant.input, "_command_before"))), Layout(writes), step)


def _pick(active: Expression, values: Expression, otherwise: Expression = 0) -> Expression:
    """The value of the active slot; no sum, in which a value that is not finite would spoil the others."""
    found = otherwise
    for k in range(values.numel()):
        found = ca.if_else(active[k] > 0.5, values[k], found)
    return found


def _judge_block() -> Block:
    def step(s: Any) -> dict[str, Expression]:
        return {"status": ca.fmax(s._held * int(Status.NON_FINITE), s.slot_held * int(Status.HELD))}

    return Block("judge", Layout((scalar("_held"), scalar("slot_held"))), Layout((scalar("status"),)), step)
