"""A controller as ONE step: from what is measured, or from raw measurements with sensing before it, to the command.

    raw measurements -> [estimator -> controller] -> command

A machine gives the step what its sensors show; a skipped cycle leaves the estimator's memory as it was, like every other one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fpirhc.controllers.base import fed, like
from fpirhc.controllers.built import Built
from fpirhc.controllers.path import ACTED, MEASURED_TIME, NOW, measured_output, measured_state
from fpirhc.controllers.seeing import seeing_blocks
from fpirhc.errors import InvalidProblem
from fpirhc.fields.kinds import described
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.motion import time_signal
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Composite, Delay, compose
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal

_LATEST: Latest[Composite] = Latest(4)


def compose_with_sensing(built: Built) -> Composite:
    """Return sensing and controller as one step: (memory, time, raw measurements, parameters) -> (memory, trace, command).

    Where nothing is estimated it is `compose_controller`. A loop and a stepper of the same values have the same one.
    """
    return _LATEST.of((built,), (), lambda: _composed(built))


def _composed(built: Built) -> Composite:
    if built.raw is None:
        return compose_controller(built)
    blocks, delays = _blocks_of(built)
    seeing, seen = seeing_blocks(built.problem)
    time, *others = _reads(built).signals
    reads = Layout((time, *built.states, built.raw, *others[1 + len(measured_signals(built.plant)) :]))
    return _informed(built, reads, [*seeing, *_at_once(built.plant, blocks)], [*delays, *seen])


def _reads(built: Built) -> Layout:
    """What a controller reads in every cycle: time, motion, realised response, parameters, and what a reference is given."""
    plant = built.plant
    measured = *measured_signals(plant), plant.response_signal("realised")
    return Layout((time_signal(plant), *measured, built.model.plant.parameter, *built.given))


def compose_controller(built: Built, *, ahead: bool = False) -> Composite:
    """Return the controller as one step: (memory, time, state, realised, parameters) -> (memory, trace, command).

    `ahead`: whether time and state are those at which the command will act. The step then also reads the measured state, its time,
    and the signals of the last cycle, where a block needs them.
    """
    blocks, delays = _blocks_of(built)
    if ahead:
        reads = _reads(built) + Layout(_measured_reads(built.plant, blocks))
        return _informed(built, reads, blocks, delays, ahead=True)
    return _informed(built, _reads(built), _at_once(built.plant, blocks), delays)


def dependencies_of_command(step: Composite) -> frozenset[str]:
    """Return the names of what the command of a composed controller depends on, in its cycle or by the memory in a later one."""
    function = step.function
    results = [function.index_out(name) for name in ("command", "memory_next")]
    reads = enumerate(function.name_in())
    return frozenset(name for k, name in reads if any(function.jac_sparsity(one, k).nnz() for one in results))


def _blocks_of(built: Built) -> tuple[list[Block], list[Delay]]:
    given: object = built.controller.blocks(built)
    pair = given if isinstance(given, tuple) and len(given) == 2 else None
    kinds = (Block, Delay)
    if pair is None or [part for part, kind in zip(pair, kinds, strict=True) if not _holds(part, kind)]:
        raise InvalidProblem(
            f"{type(built.controller).__name__}.blocks(built) must return two lists (blocks, delays), got {described(given)}"
        )
    return with_aim(built, pair[0]), list(pair[1])


def with_aim(built: Built, blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks of a controller after the reference's own block, where some of them read its signals."""
    names = {name for block in blocks for name in block.reads.names} if built.aim is not None else set()
    aim = [built.aim] if built.aim is not None and any(signal.name in names for signal in built.own) else []
    return [*aim, *blocks]


def _holds(part: object, kind: type) -> bool:
    return isinstance(part, list | tuple) and not [one for one in part if not isinstance(one, kind)]


def _informed(
    built: Built, reads: Layout, blocks: Sequence[Block], delays: Sequence[Delay], *, ahead: bool = False
) -> Composite:
    """Return blocks as one step to the command, behind a block of what the controller is told of signals from outside.

    `ahead`: whether the time is the one at which the command will act.
    """
    told = built.told
    compares = bool(told.places) and any(ACTED in block.reads for block in blocks)
    first = told.block(remembers=compares and not ahead)
    if first is None:
        return compose("controller", reads, blocks, delays, outputs=("command",))
    reads = reads + Layout(told.reads if compares and ahead else ())
    now = like(told.plant.parameter, NOW)
    return compose(
        "controller", reads, [first, *(fed(b, "parameters", now) for b in blocks)], delays, outputs=("command",)
    )


def embedded(name: str, composite: Composite, feeds: dict[str, Signal]) -> Block:
    """Return a composed step as one block.

    `feeds`: name of a signal that the step reads -> the signal that it is given instead.
    """
    reads = tuple(feeds.get(s.name, s) for s in composite.reads.signals)

    def step(s: Signals) -> dict[str, Expression]:
        memory = composite.memory.join({m: getattr(s, m) for m in composite.memory.names})
        next_memory, trace, *_ = composite.function(memory, *(getattr(s, r.name) for r in reads))
        remembered = {f"{m}_next": v for m, v in composite.memory.split(next_memory).items()}
        return {**composite.trace.split(trace), **remembered}

    inside = composite.trace, step, composite.memory, composite.opaque
    return Block(name, Layout(reads), *inside)


def _measured(plant: Plant) -> dict[str, tuple[Signal, Signal]]:
    """What is measured, by name, where a controller may act on predictions, and what is given in its place where none does."""
    now = replace(time_signal(plant), name=MEASURED_TIME)
    every = (measured_state(plant), plant.state), (measured_output(plant), plant.output), (now, time_signal(plant))
    return {one.name: (one, given) for one, given in every}


def _measured_reads(plant: Plant, blocks: Sequence[Block]) -> tuple[Signal, ...]:
    """The signals of the measured state and outputs and of their time, as far as some blocks read them."""
    read = {name for block in blocks for name in block.reads.names}
    return tuple(one for name, (one, _) in _measured(plant).items() if name in read)


def _at_once(plant: Plant, blocks: Sequence[Block]) -> list[Block]:
    """The blocks with the state, outputs and time that are given in place of the measured ones."""
    read = {name for block in blocks for name in block.reads.names}
    for name, (_, given) in _measured(plant).items():
        blocks = [fed(block, name, given) for block in blocks] if name in read else blocks
    return list(blocks)
