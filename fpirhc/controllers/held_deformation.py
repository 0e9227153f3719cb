"""The deformation in cycles without a sample, and after a gap that was too long to be bridged.

In a cycle without a sample the command is held, and with it the request: the queues of a map that pairs are given it once more.
After a long gap the response that an estimator shows is not that of this run's samples alone, as after the start. Then the last
deformation is held, request = desired + deformation, and a map learns nothing from the response.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Step
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.gap import SETTLING
from fpirhc.symbolic.layout import Expression, Layout

_REQUEST, _HELD = "_deformed_last", "deformation_held"


def with_held_deformation(plant: Plant, deformation: Deformation, block: Block, *, settles: bool) -> Block:
    """Return the block deform with what becomes of it where samples may be lost.

    Args:
        plant: whose responses are deformed.
        deformation: the map of the block.
        block: see `fpirhc.controllers.base.deform_block`.
        settles: whether responses are estimated.
    """
    block = replace(block, waits=_waiting(plant, deformation, block))
    return replace(block, bridged=lambda: _settling(plant, deformation, block)) if settles else block


def _waiting(plant: Plant, deformation: Deformation, block: Block) -> Block | None:
    """Block of a cycle without a sample; None where the map has no memory of the passing time."""
    names = deformation.memory(plant.controlled_names).names
    request = plant.response_signal(_REQUEST)

    def step(s: Signals) -> dict[str, Expression]:
        before = {m: getattr(s, m) for m in names}
        return {f"{m}_next": v for m, v in (before | deformation.held(getattr(s, _REQUEST), before)).items()}

    symbols = {m.name: ca.SX.sym(m.name, m.size) for m in block.memory.signals}
    changed = deformation.held(ca.SX.sym("r", request.size), symbols) if deformation.mirror is None else {}
    return Block("deform_waits", Layout((request,)), Layout(), step, block.memory) if changed else None


def _settling(plant: Plant, deformation: Deformation, block: Block) -> Block:
    """The block that holds the deformation while responses settle."""
    names, held = deformation.memory(plant.controlled_names).names, plant.response_signal(_HELD)

    def step(s: Signals) -> dict[str, Expression]:
        values = {name: expression(value) for name, value in block.step(s).items()}
        settling = s.settling > 0.5
        before = {m: getattr(s, m) for m in names}
        stays = before | (deformation.held(getattr(s, _REQUEST), before) if deformation.mirror is None else {})
        kept = {f"{m}_next": v for m, v in stays.items()}
        kept |= {"_deformed_unclipped": s.desired + getattr(s, _HELD), "_deformation": getattr(s, _HELD)}
        values |= {name: ca.if_else(settling, value, values[name]) for name, value in kept.items()}
        return {**values, f"{_HELD}_next": values["_deformation"]}

    own = block.memory + Layout((held,))
    waits = None if block.waits is None else replace(block.waits, memory=own, step=_keeping(block.waits, _HELD))
    return replace(block, reads=block.reads + Layout((SETTLING,)), memory=own, step=step, waits=waits, bridged=None)


def _keeping(block: Block, name: str) -> Step:
    """The step of a block, and a further signal that stays."""
    return lambda s: {**block.step(s), f"{name}_next": getattr(s, name)}
