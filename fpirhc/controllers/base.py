"""The part of a control cycle that all controllers share; the contract itself is in `contract`.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import reduce

import casadi as ca

from fpirhc.controllers.believed import model_block
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import Controller as Controller
from fpirhc.deformation.base import Deformation, Form
from fpirhc.plant.chain import nominal_responses
from fpirhc.plant.plant import Plant
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Delay, rename
from fpirhc.symbolic.expression import Signals, is_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.tracking.base import Tracking, bounded

_REQUEST = Form().request
_ABSURD = 1e4  # times the largest response that limits allow; a loop that diverges stays far below


def reference_block(built: Built) -> Block:
    """Block (time, state or outputs) -> (their reference, response of the controlled ones, error of the judged ones)."""
    plant, seen, places = built.plant, built.plant.output, list(built.judged)

    def step(s: Signals) -> dict[str, Expression]:
        own = built.own_values(s)
        outputs, response = built.motion(s.time, *own)
        wanted = nominal_responses(plant, outputs, response, lambda: built.later(s.time, *own)[0])
        error = outputs[places] - getattr(s, seen.name)[places]
        return {"reference": outputs, "_reference_response": wanted, "error": error}

    reads = Layout((plant.time, seen, *built.own))
    writes = Layout((like(seen, "reference"), plant.response_signal("_reference_response"), built.error))
    return Block("reference", reads, writes, step)


def closing_blocks(
    built: Built, deformation: Deformation | None = None, judged: Sequence[Signal] = ()
) -> tuple[list[Block], list[Delay]]:
    """Return the blocks deform, invert, limit, judge and running with what they remember; `judged` are solver statuses.

    A controller writes 'desired'. Without a deformation there is neither deform nor invert, and it also writes 'command_unclipped'
    and '_deformed_unclipped': the response that its model expects of this command.
    """
    delays = [Delay(scalar("warm_up"), "_warm_up_now"), Delay(built.before, "command")]
    closing = [_limit_block(built), judge_block(judged), warm_up_block(built.warm_up)]
    if deformation is None:
        return closing, delays
    deform = deform_block(built.plant, deformation, built.warm_up, built.largest)
    last = built.plant.response_signal(_REQUEST)
    paired = last.name in deform.reads
    before, remembered = ([], [Delay(last, "deformed")]) if paired else ([model_block(built.path(deformation))], [])
    return [*before, deform, invert_block(built.plant), *closing], [*delays, *remembered]


def warm_up_block(warm_up_cycles: float) -> Block:
    """Return the block that counts the cycles of a run up to `warm_up_cycles`, after which the response may be used."""

    def step(s: Signals) -> dict[str, Expression]:
        return {"_warm_up_now": ca.fmin(s.warm_up + 1, warm_up_cycles)}

    return Block("running", Layout((scalar("warm_up"),)), Layout((scalar("_warm_up_now"),)), step)


def deform_block(
    plant: Plant, deformation: Deformation, warm_up_cycles: float = 1, largest: Sequence[float] = ()
) -> Block:
    """Block (request before, realised, desired) -> deformed request; without a valid pair it passes the desired response.

    A model-referenced deformation is given the model's response, '_modelled', in place of the request before.

    A response error beyond 10 000 times the largest response that limits allow is a fault of the sample. A map that remembers
    remembers nothing of it, and the request stays as it was; the others come back by themselves.

    Args:
        warm_up_cycles: number of cycles, counted by 'warm_up', after which a pair is valid: one, or more where the response is
            estimated from more samples.
        largest: response of every controlled coordinate that the limits of the inputs allow; empty: any.
    """
    memory = deformation.memory(plant.controlled_names)
    request_before = deformation.form.request
    responses = [plant.response_signal(name) for name in (request_before, "realised", "desired")]
    reads = (*responses, scalar("warm_up"))

    def step(s: Signals) -> dict[str, Expression]:
        remembered = {m: getattr(s, m) for m in memory.names}
        deformed, next_memory = deformation.step(getattr(s, request_before), s.realised, s.desired, remembered)
        valid = s.warm_up > warm_up_cycles - 0.5
        errors = zip(ca.vertsplit(s.realised - s.desired), largest, strict=True) if largest and memory.names else ()
        # NaN is not absurd, because it has to show.
        absurd = [ca.fabs(one) > _ABSURD * size for one, size in errors if math.isfinite(size)]
        sane = ca.logic_not(reduce(ca.logic_or, absurd)) if absurd else None
        learns = valid if sane is None else ca.logic_and(valid, sane)
        next_values = {f"{m}_next": ca.if_else(learns, next_memory[m], remembered[m]) for m in memory.names}
        if sane is not None and request_before == _REQUEST:
            deformed = ca.if_else(sane, deformed, getattr(s, _REQUEST))
            learns = valid
        next_request = ca.if_else(learns, deformed, s.desired)
        return {"_deformed_unclipped": next_request, "_deformation": next_request - s.desired, **next_values}

    written = [plant.response_signal(name) for name in ("_deformed_unclipped", "_deformation")]
    return Block("deform", Layout(reads), Layout(tuple(written)), step, memory)


def invert_block(plant: Plant) -> Block:
    """Block (state, _deformed_unclipped, parameters) -> the command that the model needs for it."""
    reads = Layout((plant.state, plant.response_signal("_deformed_unclipped"), plant.parameter))
    inverse = plant.equations.inverse

    def step(s: Signals) -> dict[str, Expression]:
        return {"command_unclipped": inverse(s.state, s._deformed_unclipped, s.parameters)}

    return Block(
        "invert", reads, Layout((like(plant.input, "command_unclipped"),)), step, opaque=plant.equations.inverse_opaque
    )


def _limit_block(built: Built) -> Block:
    plant = built.plant
    lower, upper = built.ends
    meaning = _meaning(plant)
    reads = (
        like(plant.input, "command_unclipped"),
        plant.response_signal("_deformed_unclipped"),
        plant.response_signal("desired"),
        plant.state,
        plant.parameter,
        like(plant.input, "_command_before"),
    )
    responses = map(plant.response_signal, ("deformed", "_cut_off"))
    writes = (plant.input, *responses, scalar("clipped"), scalar("_held"))

    def step(s: Signals) -> dict[str, Expression]:
        # Finiteness is checked before the clamp: fmin and fmax turn NaN into a full-scale command.
        finite = is_finite(s.command_unclipped)
        safe = ca.if_else(finite, s.command_unclipped, s._command_before)
        command = clip(_within_rates(built, safe, s._command_before), lower, upper)
        clipped_request = meaning(s.state, command, safe, s._deformed_unclipped, s.parameters)
        return {
            "command": command,
            "deformed": ca.if_else(finite, clipped_request, s.desired),
            "_cut_off": s._deformed_unclipped - clipped_request,
            "clipped": ca.mmax(command != s.command_unclipped),
            "_held": 1 - finite,
        }

    return Block("limit", Layout(reads), Layout(writes), step)


def _within_rates(built: Built, command: Expression, before: Expression) -> Expression:
    """The command as far as hard limits of rates let it go in a cycle."""
    entries = []
    for k, ends in enumerate(zip(*built.rates, strict=True)):
        low, high = (before[k] + built.period * end if math.isfinite(end) else None for end in ends)
        entry = command[k] if low is None else ca.fmax(command[k], low)
        entries.append(entry if high is None else ca.fmin(entry, high))
    return ca.vertcat(*entries)


def _meaning(plant: Plant) -> ca.Function:
    """Function (state, command, unclipped command, request, parameters) -> the request that the clipped command stands for.

    For a response affine in the inputs this is request + B (command - unclipped command): exactly the request where nothing was
    clipped, without a second evaluation of the model.
    """
    x, u, p = plant.symbols()
    unclipped, r = ca.SX.sym("unclipped", u.numel()), ca.SX.sym("r", len(plant.controlled_names))
    response = plant.equations.controlled_response(x, u, p)
    shifted = r + ca.mtimes(ca.jacobian(response, u), u - unclipped)
    meaning = shifted if plant.equations.affine else ca.if_else(ca.mmax(u != unclipped), response, r)
    return ca.Function("fpirhc_meaning", [x, u, unclipped, r, p], [ca.densify(meaning)])


def clip(u: Expression, lower: Iterable[float], upper: Iterable[float]) -> Expression:
    """Return u clipped entry by entry; a side without a finite limit adds no operation, and an open one is finite."""
    entries = []
    for k, (low, high) in enumerate(zip(lower, upper, strict=True)):
        entry = u[k] if math.isinf(low) else ca.fmax(u[k], low)
        entries.append(entry if math.isinf(high) else ca.fmin(entry, high))
    return ca.vertcat(*entries)


def judge_block(judged: Sequence[Signal] = ()) -> Block:
    """Block (whether the command was held, statuses of solvers) -> the worst status."""
    reads = Layout((scalar("_held"), *judged))

    def step(s: Signals) -> dict[str, Expression]:
        worst: Expression = s._held * int(Status.NON_FINITE)
        for signal in judged:
            worst = ca.fmax(worst, getattr(s, signal.name))
        return {"status": worst}

    return Block("judge", reads, Layout((scalar("status"),)), step)


def nominal_blocks(built: Built) -> list[Block]:
    """Return the blocks of the reference and of 'nominal', which is its response."""
    plant = built.plant
    follows = rename("nominal", plant.response_signal("_reference_response"), plant.response_signal("nominal"))
    return [reference_block(built), follows]


def tracked_blocks(
    built: Built, tracking: Tracking, *law: Block, deformation: Deformation | None = None
) -> tuple[list[Block], list[Delay]]:
    """Return the blocks of a tracking law, those of another law on what it desires, the closing ones, and the law's update."""
    plant, (closing, delays), tracks = built.plant, closing_blocks(built, deformation), bounded(tracking, built.largest)
    target = rename("target", like(plant.output, "reference"), like(plant.output, "_target"))
    blocks = [*nominal_blocks(built), target, tracks.law(plant, built.period), *law, *closing]
    return [*blocks, tracks.update(plant, built.period)], [*delays, *tracks.delays(plant)]
