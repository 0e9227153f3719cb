"""Time slots: one input serves several coordinates in turn. Theory: docs/theory.md.

A slot is a computed torque whose plant has one controlled output, the slot's coordinate. All slots run side by side, and a switch
sends the command of the one whose turn it is.

    law -> handover -> deform -> invert -> limit   of every slot,   then   command = that of the active one
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import NamedTuple

import casadi as ca

from fpirhc.controllers.base import Controller, judge_block, reference_block, warm_up_block
from fpirhc.controllers.believed import measured
from fpirhc.controllers.built import Built, checked, made, with_aim
from fpirhc.deformation.base import Deformation, Form, Identity
from fpirhc.deformation.model_referenced import settled
from fpirhc.errors import Mistakes, NotSupported
from fpirhc.fields.kinds import NotNegative, Positive
from fpirhc.members import Example
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay, under_names
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals, Value, expression, is_finite, left_after
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Slotted(Controller):
    """One coordinate at a time, in turn, again and again.

        desired = law + o,    o = (realised - law) at the start of a turn, and then o e^(-T / blend) in every cycle of T

    A turn begins with the last command: its response is what is desired first. Memories of a slot stay at their start until its
    turn, so an integral begins anew.

    Args:
        slots: coordinate -> what controls it, ComputedTorque(tracking, deformation). Its relative order is found from the symbols.
        durations: coordinate -> how long its turn lasts, in the order of the turns.
        blend: time constant with which the offset of a switch decays, s; 0: the law is joined at once, and the command jumps
            one cycle after the switch.

    References:
        J. K. Tar, J. F. Bito, I. J. Rudas, Contradiction resolution in the adaptive control of underactuated mechanical systems
        evading the framework of optimal controllers, Acta Polytechnica Hungarica 13(1), 2016, for the idea; the switching is
        our own.
    """

    slots: Mapping[str, Controller]
    durations: Mapping[str, Positive]
    blend: NotNegative

    @property
    def deformation(self) -> Deformation:
        """The deformation of the first slot that adapts; Identity() where no slot does."""
        return next((s.deformation for s in self.slots.values() if s.deformation.adapts), Identity())

    deforms = "turns"

    def inner_problem(self, problem: Problem, name: str = "") -> Problem:
        self._check_names(problem)
        return slot_problem(problem, name)

    def check(self, problem: Problem) -> None:
        """Raise if the slots or their durations do not fit the problem."""
        self._check_names(problem)
        mistakes = Mistakes("Slotted")
        for name, slot in self.slots.items():
            with mistakes.caught(f"slot '{name}': "):
                checked(slot_problem(problem, name), slot)
            for reason in _against(problem, slot.deformation):
                mistakes.add(f"slot '{name}': {reason}")
        mistakes.unknown("durations: slot", self.durations, list(self.slots))
        for name in (n for n in self.slots if n not in self.durations):
            mistakes.add(f"slot '{name}' is never active; give it time, or leave the slot out")
        period, unit = problem.period, problem.time_unit
        for name, value in self.durations.items():
            if value < period * (1 - 1e-9):
                mistakes.add(f"duration of '{name}' is {value:g} {unit}, below the control cycle of {period:g} {unit}")
        mistakes.raise_if_any()

    def _check_names(self, problem: Problem) -> None:
        """Raise where slots do not fit the plant."""
        plant, mistakes = problem.plant, Mistakes("Slotted")
        if not self.slots:
            mistakes.add("there are no slots; give at least one: {coordinate: ComputedTorque(tracking)}")
        if len(plant.inputs) > 1:
            mistakes.add(f"slots take turns on one input; the plant has {', '.join(plant.inputs)}; use RecedingHorizon")
        mistakes.unknown("slot", self.slots, plant.followed)
        mistakes.raise_if_any()
        for name in self.slots:
            if name not in problem.judged_names:
                every = ", ".join(repr(n) for n in [*problem.judged_names, name])
                mistakes.add(f"slot '{name}' is not among what is judged; write Problem(..., judged=({every}))")
            with mistakes.caught(f"slot '{name}': "):
                slot_problem(problem, name)
        mistakes.raise_if_any()

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        turns = [self._turn(built, k, name) for k, name in enumerate(self.slots)]
        blocks = [reference_block(built), *_seeing_blocks(built, turns)]
        blocks += [self._schedule_block(built), _switch_block(turns)]
        delays = [Delay(scalar("warm_up"), "_warm_up_now"), Delay(scalar("_slot_before"), "slot")]
        for one in turns:
            own, remembered = _own_cycle(one, left_after(built.period, self.blend))
            blocks, delays = [*blocks, *own], [*delays, *remembered]
        counted = warm_up_block(max(one.built.warm_up for one in turns))
        blocks += [_command_block(built, turns), judge_block(), counted]
        return blocks, [*delays, Delay(built.before, "command")]

    def _schedule_block(self, built: Built) -> Block:
        """Block time -> slot, its place among the slots."""
        period, order = built.period, [list(self.slots).index(name) for name in self.durations]
        *starts, whole = accumulate((round(value / period) for value in self.durations.values()), initial=0)

        def step(s: Signals) -> dict[str, Expression]:
            phase, slot = ca.fmod(ca.floor(s.time / period + 0.5), whole), ca.SX(order[0])
            for before, number, start in zip(order, order[1:], starts[1:], strict=False):
                slot += (number - before) * (phase > start - 0.5)
            return {"slot": slot}

        return Block("schedule", Layout((built.plant.time,)), Layout((scalar("slot"),)), step)

    def _turn(self, built: Built, number: int, name: str) -> Turn:
        one = made(slot_problem(built.problem, name), self.slots[name])
        same = built.plant.response_orders.get(name) == one.plant.response_orders[name]
        place = built.plant.controlled_names.index(name) if same else None
        return Turn(number, name, self.slots[name], replace(one, warm_up=built.warm_up + (place is None)), place)


class Turn(NamedTuple):
    """A slot on its plant."""

    number: int  # place among the slots
    name: str  # of its coordinate
    slot: Controller
    built: Built  # the slot alone
    place: int | None  # of its response in what is measured; None: it is the difference of the derivative below

    def own(self, name: str) -> str:
        """Return the name of this slot's own copy of a signal, which no table shows."""
        return f"_{self.number}_{name}"


_PROBLEMS: Latest[Problem] = Latest(16)


def slot_problem(problem: Problem, name: str) -> Problem:
    """Return the problem of a slot alone: every coordinate is an output, and the slot's is controlled."""
    alone = lambda: replace(problem, plant=problem.plant.controlling(name), judged=(name,), cost=None)  # noqa: E731
    return _PROBLEMS.of((problem,), (name,), alone)


def _by_slot(plants: Sequence[Plant], name: str) -> Signal:
    """A signal that holds a response of every slot."""
    parts = [plant.response_signal(name) for plant in plants]
    return Signal(name, tuple(e for s in parts for e in s.elements), tuple(u for s in parts for u in s.units))


def _against(problem: Problem, deformation: Deformation) -> Iterator[str]:
    if deformation.form.modelled and problem.sensing.spreads(problem.plant):
        yield (
            f"ModelReferenced in a slot compares with the model's response of one cycle, and {problem.sensing.estimator} gives a "
            "mean over several; use the map inside"
        )
    if deformation.form.pairs and not deformation.form.modelled:
        yield (
            f"{type(deformation).__name__} keeps pairs of earlier cycles, which belong to another slot after a switch, where the "
            "command would jump back to them; use the map itself, or behind a dead time ModelReferenced(map, cycles=...)"
        )


_OUTPUT = "_slot_outputs"  # the outputs of every slot's plant


def _seeing_blocks(built: Built, turns: Sequence[Turn]) -> list[Block]:
    """Blocks from what is measured to the outputs and the response of every slot."""
    plant, model, motion = built.plant, turns[0].built.plant, measured(built.plant.output)
    same = plant.output.elements == model.output.elements
    every = _by_slot([one.built.plant for one in turns], "realised_of_slots")
    still, calm = ca.DM.zeros(plant.input.size), ca.DM.zeros(len(plant.names))
    memory = Layout(tuple(scalar(one.own("below")) for one in turns if one.place is None))

    def shown(seen: Expression, parameters: Expression) -> Expression:
        return seen if same else model.equations.output(seen, still, parameters, calm)

    def step(s: Signals) -> dict[str, Expression]:
        outputs = shown(getattr(s, motion.name), s.parameters)
        values = {one.own("realised"): s.realised[one.place] for one in turns if one.place is not None}
        for one in turns:
            if one.place is None:
                below = outputs[model.output.elements.index(one.name + "'" * (model.chains[one.name] - 1))]
                values[one.own("realised")] = (below - getattr(s, one.own("below"))) / built.period
                values[f"{one.own('below')}_next"] = below
        return {**values, every.name: ca.vertcat(*(values[one.own("realised")] for one in turns))}

    reads = (plant.response_signal("realised"), motion, plant.parameter)
    writes = Layout((every, *(scalar(one.own("realised")) for one in turns)))
    responses = Block("slot_responses", Layout(reads), writes, step, memory)
    given, output = Layout((plant.output, plant.parameter)), Layout((replace(model.output, name=_OUTPUT),))
    now = plant.output.name
    outputs = Block("slot_outputs", given, output, lambda s: {_OUTPUT: shown(getattr(s, now), s.parameters)})
    return [outputs, responses]


def _switch_block(turns: Sequence[Turn]) -> Block:
    """Block -> whether a slot goes on from the last cycle, and the count of cycles while it is active, else zero."""

    def step(s: Signals) -> dict[str, Expression]:
        goes_on, flags = ca.logic_and(s.warm_up > 0.5, s.slot == s._slot_before), dict[str, Expression]()
        for one in turns:
            active = s.slot == one.number
            flags |= {one.own("_goes_on"): ca.logic_and(active, goes_on), one.own("warm_up"): active * s.warm_up}
        return flags

    writes = Layout(tuple(scalar(one.own(n)) for one in turns for n in ("_goes_on", "warm_up")))
    return Block("switch", Layout((scalar("slot"), scalar("_slot_before"), scalar("warm_up"))), writes, step)


_OF_ALL = {"_command_before", "warm_up"}  # remembered once for all slots
_OF_TURN = "_law", "_offset", "_request", "_goes_on"  # what the handover adds


def _own_cycle(one: Turn, decay: float) -> tuple[list[Block], list[Delay]]:
    """The slot's own blocks, under names of its own, and what they remember. Its law begins a run with every turn."""
    given, delays = one.slot.blocks(one.built)
    blocks = [b for b in with_aim(one.built, given) if not {"status", "_warm_up_now"} & {*b.writes.names}]
    if not any("_deformation" in b.writes.names for b in blocks):
        raise NotSupported(f"slot '{one.name}': {one.slot} has no law whose response a map deforms; use ComputedTorque")
    delays = [d for d in delays if d.now.name not in _OF_ALL]
    told = {n for b in blocks for n in (*b.writes.names, *b.memory.names)} | {d.now.name for d in delays}
    names = {n: one.own(n) for n in (*told, *_OF_TURN, "realised", "warm_up")} | {"output": _OUTPUT}
    begins, asked = names | {"warm_up": names["_goes_on"]}, names | {Form().request: names["_request"]}
    cycle: list[Block] = []
    for block in blocks:
        if "_deformation" in block.writes.names:
            handover = under_names(_handover_block(one.built, one.slot.deformation, decay), names)
            cycle += [handover, under_names(_begun_anew(one.slot.deformation, block), asked)]
        else:
            law = {"desired": names["_law"]} if "desired" in block.writes.names else {}
            cycle.append(under_names(block, begins | law))
    numbered = [replace(block, name=f"{block.name}_{one.number}") for block in cycle]
    return numbered, [Delay(replace(d.now, name=names[d.now.name]), names[d.source]) for d in delays]


def _begun_anew(deformation: Deformation, block: Block) -> Block:
    """The deform block, whose memory stays at its start until a turn, which begins with the pair of the last command."""

    def step(s: Signals) -> Mapping[str, Value]:
        pair = settled(deformation, getattr(s, deformation.form.request), s.realised)
        begins = {m.name: expression(ca.DM(m.start_vector())) for m in block.memory.signals}
        begins |= {name: ca.if_else(s.warm_up > 0.5, value, begins[name]) for name, value in pair.items()}
        fresh = {name: ca.if_else(s._goes_on > 0.5, getattr(s, name), value) for name, value in begins.items()}
        return block.step(Signals({**vars(s), **fresh}))

    return replace(block, reads=block.reads + Layout((scalar("_goes_on"),)), step=step) if block.memory.names else block


def _handover_block(built: Built, deformation: Deformation, decay: float) -> Block:
    """Block that joins the slot's law to the last motion: what is desired, and the request that caused the last response.

    A turn begins with the last command: a plain map desires what it has just realised, a model-referenced one adds model - plant.
    """
    plant, response, modelled = built.plant, built.plant.equations.controlled_response, deformation.form.modelled

    def step(s: Signals) -> dict[str, Value]:
        begins = ca.logic_and(s.warm_up > 0.5, ca.logic_not(s._goes_on))
        last = shown = response(s.state, s._command_before, s.parameters)
        if deformation.adapts:
            shown = s.realised + (last - getattr(s, deformation.form.request) if modelled else 0)
            shown = ca.if_else(s.warm_up > built.warm_up - 0.5, shown, last)
        offset = ca.if_else(begins, shown - s._law, decay * s._offset)
        # What is not finite would be remembered for the rest of the turn.
        kept = ca.if_else(is_finite(offset), offset, 0)
        request = {} if modelled else {"_request": ca.if_else(begins, last, getattr(s, Form().request))}
        return {"desired": s._law + kept, "_offset_next": kept, **request}

    reads = map(plant.response_signal, ("_law", "realised", deformation.form.request))
    flags, before = (scalar("_goes_on"), scalar("warm_up")), like(plant.input, "_command_before")
    writes = map(plant.response_signal, ("desired",) if modelled else ("desired", "_request"))
    layout = Layout((*reads, *flags, plant.state, plant.parameter, before))
    return Block("handover", layout, Layout(tuple(writes)), step, Layout((scalar("_offset"),)))


_RESPONSES = "nominal", "desired", "deformed"
_PICKED = "command", "clipped", "_held"


def _command_block(built: Built, turns: Sequence[Turn]) -> Block:
    """Block -> the command of the active slot and what its limits did, and the responses of all."""
    plants = [one.built.plant for one in turns]

    def step(s: Signals) -> dict[str, Value]:
        values: dict[str, Value] = {n: ca.vertcat(*(getattr(s, one.own(n)) for one in turns)) for n in _RESPONSES}
        for name in _PICKED:
            chosen = getattr(s, turns[0].own(name))
            for one in turns[1:]:  # no sum, which one value that is not finite would spoil
                chosen = ca.if_else(s.slot == one.number, getattr(s, one.own(name)), chosen)
            values[name] = chosen
        return values

    own = [one.own(name) for one in turns for name in (*_RESPONSES, *_PICKED)]
    writes = (built.plant.input, *(_by_slot(plants, n) for n in _RESPONSES), scalar("clipped"), scalar("_held"))
    return Block("command", Layout((*map(scalar, own), scalar("slot"))), Layout(writes), step)


EXAMPLES = (Example(problem="mass_spring_slots", controller="slots"),)
