"""A controller as ONE step: from what is measured, or from raw measurements with sensing before it, to the command.

    raw measurements -> [estimator -> controller] -> command

A machine gives the step what its sensors show; a skipped cycle leaves the estimator's memory as it was, like every other one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fpirhc.controllers.built import Built
from fpirhc.controllers.path import ACTED, MEASURED_TIME, NOW, measured_output, measured_state
from fpirhc.errors import InvalidProblem
from fpirhc.fields.kinds import described
from fpirhc.plant.chain import measured_signals
from fpirhc.plant.motion import time_signal
from fpirhc.symbolic.block import Block, Composite, Delay, compose, fed, rename
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, like

_LATEST: Latest[Composite] = Latest(4)


def compose_with_sensing(built: Built) -> Composite:
    """Return sensing and controller as one step: (memory, time, raw measurements, parameters) -> (memory, trace, command).

    Where nothing is estimated it is `compose_controller`. A loop and a stepper of the same values have the same one.
    """
    return _LATEST.of((built,), (), lambda: _composed(built))


def _composed(built: Built) -> Composite:
    (blocks, delays), (seeing, seen) = _blocks_of(built), built.seeing
    own = [*seeing, *_measuring(built, blocks), *blocks]
    return _informed(built, _reads(built, *built.sample), own, [*delays, *seen])


def _reads(built: Built, *seen: Signal) -> Layout:
    """What a controller reads in every cycle: time, what is seen, parameters, and what a reference is given."""
    return Layout((time_signal(built.plant), *seen, built.model.plant.parameter, *built.given))


def compose_controller(built: Built, *, ahead: bool = False) -> Composite:
    """Return the controller as one step: (memory, time, state, realised, parameters) -> (memory, trace, command).

    `ahead`: whether time and state are those at which the command will act. The step then also reads the measured state, its time,
    and the signals of the last cycle, where a block needs them.
    """
    blocks, delays = _blocks_of(built)
    reads = _reads(built, *measured_signals(built.plant), built.plant.response_signal("realised"))
    measuring = _measuring(built, blocks)
    if ahead:
        reads = reads + Layout(tuple(signal for block in measuring for signal in block.writes.signals))
        return _informed(built, reads, blocks, delays, ahead=True)
    return _informed(built, reads, [*measuring, *blocks], delays)


def _measuring(built: Built, blocks: Sequence[Block]) -> list[Block]:
    """Blocks that write what is measured, where some blocks read it: what is given, unless a controller acts on predictions."""
    plant, read = built.plant, _read_by(blocks)
    now = replace(time_signal(plant), name=MEASURED_TIME)
    pairs = (plant.state, measured_state(plant)), (plant.output, measured_output(plant)), (time_signal(plant), now)
    named = {one.name: (given, one) for given, one in pairs if one.name in read}
    return [rename(f"measured_{given.name}", given, one) for given, one in named.values()]


def _read_by(blocks: Sequence[Block]) -> set[str]:
    return {name for block in blocks for name in block.reads.names}


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
    own = {signal.name for signal in built.own}
    return [*([built.aim] if built.aim is not None and own & _read_by(blocks) else []), *blocks]


def _holds(part: object, kind: type) -> bool:
    return isinstance(part, list | tuple) and not [one for one in part if not isinstance(one, kind)]


def _informed(
    built: Built, reads: Layout, blocks: Sequence[Block], delays: Sequence[Delay], *, ahead: bool = False
) -> Composite:
    """Return blocks as one step to the command, behind a block of what the controller is told of signals from outside.

    `ahead`: whether the time is the one at which the command will act.
    """
    told = built.told
    compares = bool(told.places) and ACTED in _read_by(blocks)
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
