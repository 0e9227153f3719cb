"""The mirror: the model's response seen the way the plant's is, for a model-referenced deformation.

    commands -> believed dead time -> believed actuator lag -> model -> [sensors' quanta -> late samples -> estimator] -> modelled

Where the response itself is measured, the model's response is that of this instant, f^(x_k, u_{k-1}), with u_{k-1} the input that
acted according to the beliefs. Where the response is estimated from samples, a twin of the plant produces them (`twin`).
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from fpirhc.controllers.mirror_path import MEASURED, MEASURED_OUTPUT, NONE, Path, measured_output, measured_state
from fpirhc.controllers.twin import BEFORE, twin_block
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.queue import every
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout
from fpirhc.task.problem import Problem

__all__ = ["MEASURED", "MEASURED_OUTPUT", "measured_output", "measured_state", "mirror_blocks", "with_measured_state"]


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
    path = Path(problem, mirror, estimated or max(every(mirror.cycles)) + mirror.measurement > 0)
    if not estimated:
        return [_instant_block(path)], []
    return [twin_block(path)], [Delay(problem.plant.response_signal(BEFORE), "_deformation")]


def with_measured_state(plant: Plant, blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks, and before them one that writes the measured state, or the outputs, where a block reads it.

    Args:
        plant: the plant.
        blocks: of the controller.
    """
    first: list[Block] = []
    if any(MEASURED in block.reads for block in blocks):
        target = measured_state(plant)
        first = [Block("measured", Layout((plant.state,)), Layout((target,)), lambda s: {MEASURED: s.state})]
    if any(MEASURED_OUTPUT in block.reads for block in blocks):
        seen = Layout((plant.output,)), Layout((measured_output(plant),))
        first.append(Block("measured_output", *seen, lambda s: {MEASURED_OUTPUT: s.output}))
    return [*first, *blocks]


def _instant_block(path: Path) -> Block:
    """Block (measured state, last command, parameters) -> the model's response at this instant."""
    plant = path.problem.plant
    x, u, p = plant.symbols()
    response = ca.Function("fpirhc_modelled", [x, u, p], [plant.controlled_response_function(x, u, p)])

    def step(s: Signals) -> dict[str, Expression]:
        end, _, remembered = path.acted(s)
        parameters, signals = path.told.acted(s, path.late)
        return {"_modelled": response(getattr(s, MEASURED), end, parameters), **remembered, **signals}

    writes = Layout((plant.response_signal("_modelled"),))
    return Block("mirror", Layout(path.reads), writes, step, Layout(path.memory))
