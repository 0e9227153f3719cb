"""The mirror of a map: the model's response to the command that the measured response belongs to.

A response of relative order r is complete r cycles after its command. The model's response to the same command, from the same
measured state, waits as long:

    modelled_k = y^_r(x_{k-r}, u_{k-r}),        u the input that acted then according to the beliefs.

There is no twin that could drift, because a map has no motion between two measurements.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from fpirhc.controllers.mirror_path import MEASURED, Path
from fpirhc.symbolic.block import Block, unseen
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.gap import GAP, straightened
from fpirhc.symbolic.layout import Expression, Layout, Signal

_BEFORE, _ANSWERS = "mirror_state_before", "mirror_answers"


def map_mirror(path: Path, *, lost: bool = False) -> Block:
    """Return the block (measured state, last command, parameters) -> the model's response that is measured in this cycle.

    Args:
        path: of the commands to the model.
        lost: whether samples may be lost; the state of the last cycle is then on the line over the gap.
    """
    plant, face = path.problem.plant, path.problem.plant.face
    orders = [face.orders[k] for k in face.controlled_indices]
    start = tuple(map(float, path.problem.start_state))
    before = Signal(_BEFORE, plant.state.elements, plant.state.units, start)
    names = zip(plant.controlled_names, orders, strict=True)
    waiting = tuple(f"{name}@{i}" for name, order in names for i in range(1, order))
    queues = (Signal(_ANSWERS, waiting),) if waiting else ()

    def step(s: Signals) -> dict[str, Expression]:
        acting, _, remembered = path.acted(s)
        last = getattr(s, _BEFORE)
        last = straightened(last, getattr(s, MEASURED), s.gap) if lost else last
        parameters, signals = path.told.acted(s, path.late)
        answers = ca.vertsplit(plant.controlled_response_function(last, acting, parameters))
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
