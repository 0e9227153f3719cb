"""The mirror: the model's response seen the way the plant's is, for a model-referenced deformation.

    commands -> believed dead time -> believed actuator lag -> model -> [sensors' quanta -> late samples -> estimator] -> modelled

Where the response itself is measured, the model's response is that of this instant, f^(x_k, u_{k-1}), with u_{k-1} the input that
acted according to the beliefs. Where the response is estimated from samples, a twin of the plant produces them (`twin`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from fpirhc.controllers.mirror_path import (
    MEASURED,
    MEASURED_OUTPUT,
    MEASURED_TIME,
    NONE,
    Path,
    measured_output,
    measured_state,
)
from fpirhc.controllers.twin import BEFORE, twin_block, twin_of_outputs
from fpirhc.deformation.base import Deformation
from fpirhc.plant.motion import time_signal
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay, unseen
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.gap import GAP, straightened
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.symbolic.queue import every
from fpirhc.task.problem import Problem

_BEFORE, _ANSWERS = "mirror_state_before", "mirror_answers"


__all__ = ["MEASURED", "MEASURED_OUTPUT", "MEASURED_TIME", "measured_reads", "mirror_blocks", "with_measured_state"]


def mirror_blocks(problem: Problem, deformation: Deformation) -> tuple[list[Block], list[Delay]]:
    """Return the block that writes '_modelled', with what it remembers; none where the deformation is not model-referenced.

    Args:
        problem: the problem.
        deformation: of the controller.
    """
    mirror = deformation.mirror
    if mirror is None:
        return [], []
    estimated = not problem.sensing.estimator.shows_response or mirror.measurement % 1 > NONE
    late = max(every(mirror.cycles)) if mirror.longest is None else mirror.longest
    path = Path(problem, mirror, estimated or late + mirror.measurement > 0)
    if problem.plant.step is not None:
        return [map_mirror(path)], []
    if not estimated:
        return [_instant_block(path)], []
    if problem.plant.outputs:
        return [twin_of_outputs(path)], []
    return [twin_block(path)], [Delay(problem.plant.response_signal(BEFORE), "_deformation")]


def with_measured_state(plant: Plant, blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks, and before them one that writes the measured state or outputs, and their time, where a block reads them.

    Args:
        plant: the plant.
        blocks: of the controller.
    """
    writes = measured_reads(plant, blocks)
    if not writes:
        return list(blocks)
    sources = {MEASURED: plant.state, MEASURED_OUTPUT: plant.output, MEASURED_TIME: time_signal(plant)}
    reads = tuple(sources[w.name] for w in writes)
    first = Block(
        "measured", Layout(reads), Layout(writes), lambda s: {w.name: getattr(s, sources[w.name].name) for w in writes}
    )
    return [first, *blocks]


def measured_reads(plant: Plant, blocks: Sequence[Block]) -> tuple[Signal, ...]:
    """Return the signals of the measured state and outputs and of their time, as far as some blocks read them."""
    every = measured_state(plant), measured_output(plant), replace(time_signal(plant), name=MEASURED_TIME)
    read = {name for block in blocks for name in block.reads.names}
    return tuple([signal for signal in every if signal.name in read])


def map_mirror(path: Path, *, lost: bool = False) -> Block:
    """Return the block (measured state, last command, parameters) -> the model's response that is measured in this cycle.

    A response of relative order r is complete r cycles after its command. The model's response to the same command, from the same
    measured state, waits as long:  modelled_k = y^_r(x_{k-r}, u_{k-r}), u the input that acted then according to the beliefs. There
    is no twin that could drift, because a map has no motion between two measurements.

    Args:
        path: of the commands to the model.
        lost: whether samples may be lost; the state of the last cycle is then on the line over the gap.
    """
    plant = path.problem.plant
    orders = [plant.chains[name] for name in plant.controlled_names]
    start = tuple(map(float, path.problem.start_state))
    before = Signal(_BEFORE, plant.state.elements, plant.state.units, start)
    names = zip(plant.controlled_names, orders, strict=True)
    waiting = tuple(f"{name}@{i}" for name, order in names for i in range(1, order))
    queues = (Signal(_ANSWERS, waiting),) if waiting else ()

    def step(s: Signals) -> dict[str, Expression]:
        acting, _, remembered = path.acted(s)
        last = getattr(s, _BEFORE)
        last = straightened(last, getattr(s, MEASURED), s.gap) if lost else last
        parameters, signals = path.known.acted(s, path.late)
        answers = ca.vertsplit(plant.equations.controlled_response(last, acting, parameters))
        past = ca.vertsplit(getattr(s, _ANSWERS)) if waiting else []
        modelled, later, at = [], [], 0
        for answer, order in zip(answers, orders, strict=True):
            queue = [answer, *past[at : at + order - 1]]
            at += order - 1
            modelled.append(queue[-1])
            later += queue[:-1]
        remembered |= {f"{_BEFORE}_next": getattr(s, MEASURED), **signals}
        if later:
            remembered[f"{_ANSWERS}_next"] = ca.vertcat(*later)
        return {"_modelled": ca.vertcat(*modelled), **remembered}

    writes, memory = Layout((plant.response_signal("_modelled"),)), Layout((*path.memory, before, *queues))
    if not lost:
        return Block("mirror", Layout(path.reads), writes, step, memory, bridged=lambda: map_mirror(path, lost=True))
    waits = unseen(map_mirror(path), (MEASURED,))
    held = replace(waits, step=lambda s: {**waits.step(s), f"{_BEFORE}_next": getattr(s, _BEFORE)})
    return Block("mirror", Layout((*path.reads, GAP)), writes, step, memory, waits=held)


def _instant_block(path: Path) -> Block:
    """Block (measured state, last command, parameters) -> the model's response at this instant."""
    plant = path.problem.plant
    x, u, p = plant.symbols()
    response = ca.Function("fpirhc_modelled", [x, u, p], [plant.equations.controlled_response(x, u, p)])

    def step(s: Signals) -> dict[str, Expression]:
        end, _, remembered = path.acted(s)
        parameters, signals = path.known.acted(s, path.late)
        return {"_modelled": response(getattr(s, MEASURED), end, parameters), **remembered, **signals}

    writes = Layout((plant.response_signal("_modelled"),))
    block = Block("mirror", Layout(path.reads), writes, step, Layout(path.memory))
    return replace(block, waits=unseen(block, (MEASURED,))) if path.memory else block
