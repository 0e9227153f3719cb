"""The deformation in cycles without a sample, and after a gap.

In a cycle without a sample the command is held, and with it the request: the queues of a map that pairs are given it once more.
The next response answers the held request. A map without memory then takes the steps of all cycles at once, as r+ = r - a (f - d)
does where the response changes by as much as the request.
After a long gap the response that an estimator shows is not that of this run's samples alone, as after the start. Then the last
deformation is held, request = desired + deformation, and a map learns nothing from the response.
"""

from __future__ import annotations

import math
from dataclasses import replace

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Step
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.functions import numbers
from fpirhc.symbolic.gap import GAP, SETTLING, is_long
from fpirhc.symbolic.layout import Expression, Layout

_REQUEST, _HELD, _LAST = "_deformed_last", "deformation_held", "step_of_last_sample"
_SMALL = 1e-6  # effective gain below which the formulas lose their digits


def with_held_deformation(
    plant: Plant, deformation: Deformation, block: Block, *, settles: bool, answered: float
) -> Block:
    """Return the block deform with what becomes of it where samples may be lost.

    Args:
        plant: whose responses are deformed.
        deformation: the map of the block.
        block: see `fpirhc.controllers.base.deform_block`.
        settles: whether responses are estimated.
        answered: number of cycles after which a response answers the last request; infinite where something is late.
    """
    block = replace(block, waits=_waiting(plant, deformation, block))
    repeats = math.isfinite(answered) and deformation.adapts and deformation.mirror is None and not block.memory.names
    lossy = _repeated(plant, deformation, block, answered) if repeats else block
    if settles:
        return replace(block, bridged=lambda: _settling(plant, deformation, lossy))
    return replace(block, bridged=lambda: lossy) if repeats else block


def _repeated(plant: Plant, deformation: Deformation, block: Block, answered: float) -> Block:
    """The block of a map without memory that takes the steps of missing cycles at once; after a long gap it takes one.

    With q = 1 - a, the step h of now and h_0 of the last sample, after which q h_0 was left, the errors in between are on a line:

        r+ = r + [S h - M (h - q h_0) / (g + 1)] / a,      S = 1 - q^(g + 1),      M = a sum_{m <= g} m q^m.
    """
    last, gain = plant.response_signal(_LAST), deformation.effective_gain()

    def step(s: Signals) -> dict[str, Expression]:
        values = {name: expression(value) for name, value in block.step(s).items()}
        request, before = values["_deformed_unclipped"], getattr(s, _REQUEST)
        pairs, now = s.warm_up > answered - 0.5, request - before
        several = ca.logic_and(pairs, ca.logic_and(s.gap > 0.5, ca.logic_not(is_long(s.gap))))
        step, left = numbers([gain]), 1 - numbers([gain])
        gap = ca.if_else(several, s.gap, 1)
        share = 1 - ca.power(left, gap + 1)
        moment = left * (1 - (gap + 1) * ca.power(left, gap) + gap * ca.power(left, gap + 1)) / step
        all_at_once = (share * now - moment / (gap + 1) * (now - left * getattr(s, _LAST))) / step
        repeats = ca.logic_and(several, ca.logic_and(step > _SMALL, left > -1))
        request = ca.if_else(repeats, before + all_at_once, request)
        return {
            **values,
            "_deformed_unclipped": request,
            "_deformation": request - s.desired,
            f"{_LAST}_next": ca.if_else(pairs, now, 0),
        }

    return replace(block, reads=block.reads + Layout((GAP,)), memory=Layout((last,)), step=step)


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
