"""The blocks of a control cycle in time slots, in the order in which they run.

    reference   the reference state, and the error of every judged coordinate
    state       per slot: its chain and target, alpha and beta of the model, and whether beta is large enough
    admissible  which slots have a gain that is large enough, for the schedule
    switch      which slot is active, and whether it was active in the last cycle too
    join        per slot: the desired response, joined to the plant's last motion, and the pair of the last cycle
    command     the active slot's request inverted and clipped, and what the command means for every slot
    judge       one status for the cycle

Each slot has signals of its own (`Channel.signal`). All are computed in every cycle; those of the active slot are used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca

from fpirhc.controllers.base import clip, error_signal, like
from fpirhc.controllers.online_reference import motion_of, own_signals, own_values, stages_of
from fpirhc.controllers.slots.slot import Channel, First
from fpirhc.deformation.model_referenced import settled
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.motion import time_signal
from fpirhc.status import Status
from fpirhc.symbolic import live
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, Value, expression, is_finite
from fpirhc.symbolic.functions import exp, signed
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.problem import Problem


def by_slot(channels: Sequence[Channel], name: str) -> Signal:
    """A signal that holds a y^(r) of every slot."""
    return Signal(name, tuple(c.slot.coordinate for c in channels), tuple(c.chain.response_unit for c in channels))


def reference_block(problem: Problem) -> Block:
    """Block (time, outputs) -> (reference of the outputs, error of the judged ones)."""
    plant, seen, function = problem.plant, problem.plant.output, motion_of(problem)
    places = [seen.elements.index(c) for c in problem.judged_names]

    def step(s: Signals) -> dict[str, Expression]:
        reference = function(s.time, *own_values(problem, s))[0]
        return {"reference": reference, "error": reference[places] - getattr(s, seen.name)[places]}

    writes = Layout((like(seen, "reference"), error_signal(problem, "error")))
    reads = Layout((time_signal(plant), seen, *own_signals(problem)))
    return Block("reference", reads, writes, step, opaque=problem.reference.opaque)


def state_block(problem: Problem, one: Channel, smallest_gain: float) -> Block:
    """Block -> the slot's chain, its target, y^(r),N, alpha and beta of the model, and whether beta is large enough.

    What is measured of the chain is the measured value; the rest is the model's.
    """
    plant, chain, seen = problem.plant, one.chain, problem.plant.output
    elements = one.plant.state.elements
    derivatives = problem.reference.chain(plant, stages_of(problem), chain.coordinate, chain.order)
    place = plant.input.elements.index(chain.input)
    smallest = smallest_gain * abs(one.start_gain)

    def step(s: Signals) -> dict[str, Expression]:
        nominal = derivatives(s.time, *own_values(problem, s))
        others = ca.vertcat(*(0 if k == place else s._command_before[k] for k in range(plant.input.size)))
        gain = chain.gain(s.state, others, s.parameters)
        measured = dict(zip(seen.elements, ca.vertsplit(getattr(s, seen.name)), strict=True))
        modelled = ca.vertsplit(chain.states(s.state, s.parameters))
        good = ca.fabs(gain) >= live.expressed(smallest, gain)
        values = {
            "state": ca.vertcat(*(measured.get(e, own) for e, own in zip(elements, modelled, strict=True))),
            "target": nominal[: chain.order] if chain.order > 1 else nominal[0],
            "nominal": nominal[chain.order],
            "free": chain.response(s.state, others, s.parameters, ca.DM.zeros(len(plant.names))),
            "gain": gain,
            "good": good,
            # Not zero, so that no slot that is not chosen divides by it.
            "divisor": ca.if_else(good, gain, signed(smallest, one.start_gain)),
        }
        return {one.wire(name): value for name, value in values.items()}

    writes = [one.signal(n, elements) for n in ("state", "target")]
    writes += [one.signal(n) for n in ("nominal", "free", "gain", "good", "divisor")]
    motion, before = measured_signals(plant), like(plant.input, "_command_before")
    reads = (time_signal(plant), *motion, plant.parameter, before, *own_signals(problem))
    return Block(
        f"slot_state_{one.number}", Layout(reads), Layout(tuple(writes)), step, opaque=problem.reference.opaque
    )


def admissible_block(channels: Sequence[Channel]) -> Block:
    """Block that gathers, for the schedule, which slots have a gain that is large enough."""
    writes = Signal("_admissible", tuple(c.slot.coordinate for c in channels))
    reads = Layout(tuple(c.signal("good") for c in channels))
    return Block("admissible", reads, Layout((writes,)), lambda s: {"_admissible": _column(s, channels, "good")})


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


def join_block(problem: Problem, channels: Sequence[Channel], one: Channel, blend: float, blank: int) -> Block:
    """Block that joins the slot's law to the plant's last motion: the desired response and the pair of the last cycle."""
    decay = exp(-problem.period / blend) if live.nominal(blend) > 0 else 0.0
    place = problem.plant.input.elements.index(one.chain.input)
    names = ("law", "free", "gain", "active", "warm_up")
    request_before = _request_before(one)

    def step(s: Signals) -> dict[str, Expression]:
        law, free, gain, active, goes_on = (getattr(s, one.wire(name)) for name in names)
        running, realised = s.warm_up > 0.5, s.realised[one.number]
        switched = ca.logic_and(ca.logic_and(active, running), ca.logic_not(goes_on))
        last_request = free + gain * s._command_before[place]
        response = realised if one.slot.adapts else last_request
        offset = ca.if_else(switched, response - law, decay * s._offset_before)
        desired = law + ca.if_else(active, offset, 0)
        blanked = ca.logic_and(ca.logic_and(active, running), s._age < blank - 0.5)
        if request_before == "deformed_last":
            own_request = ca.if_else(switched, last_request, s._deformed_before[one.number])
        else:
            own_request = last_request
        values = {
            "offset": offset,
            "desired": desired,
            "distance": ca.if_else(switched, last_request - desired, s._distance_before),
            request_before: own_request,
            "realised": realised,
            "valid": ca.logic_and(ca.logic_and(active, running), ca.logic_not(blanked)),
            "blanked": blanked,
        }
        return {one.wire(name): value for name, value in values.items()}

    shared = [scalar(n) for n in ("warm_up", "_age", "_offset_before", "_distance_before")]
    columns = [by_slot(channels, n) for n in ("realised", "_deformed_before")]
    reads = [*(one.signal(n) for n in names), *shared, *columns, like(problem.plant.input, "_command_before")]
    results = ("offset", "desired", "distance", request_before, "realised", "valid", "blanked")
    return Block(f"join_{one.number}", Layout(tuple(reads)), Layout(tuple(one.signal(n) for n in results)), step)


def _request_before(one: Channel) -> str:
    """Name of the request that the slot's map is given: the response of the model in a model-referenced form, else its last one."""
    return "deformed_last" if one.slot.deformation.mirror is None else "modelled"


def settled_in(one: Channel) -> First:
    """Return what the slot's deformation remembers when it begins: the pair of the last command, just realised."""
    request = one.wire(_request_before(one))

    def first(s: Signals) -> Mapping[str, Expression]:
        return settled(one.slot.deformation, getattr(s, request), getattr(s, one.wire("realised")))

    return first


_FLAGS = ("active", "good", "blanked")
_VALUES = ("nominal", "desired", "deformed_unclipped", "distance", "offset", "free", "gain", "divisor")
_PER_SLOT = (*_FLAGS, *_VALUES)


def command_block(problem: Problem, channels: Sequence[Channel]) -> Block:
    """Block that inverts the active slot's request, clips the command, and writes what the command means for every slot."""
    plant = problem.plant
    lower, upper = problem.limits.input_ends(plant)
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
        return {
            "command": command,
            "nominal": slot["nominal"],
            "desired": slot["desired"],
            "deformed": ca.if_else(exact, clipped_requests, slot["free"] + slot["gain"] * entries),
            "clipped": ca.mmax(command != unclipped),
            "slot_held": ca.logic_not(good),
            "_held": ca.logic_not(finite),
            "_offset": _finite(_pick(slot["active"], slot["offset"])),
            "_distance": _finite(_pick(slot["active"], slot["distance"])),
            "_warm_up_now": 1,
        }

    reads = [c.signal(n) for c in channels for n in _PER_SLOT]
    responses = [by_slot(channels, n) for n in ("nominal", "desired", "deformed")]
    scalars = [scalar(n) for n in ("clipped", "slot_held", "_held", "_offset", "_distance", "_warm_up_now")]
    writes = (plant.input, *responses, *scalars)
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
