"""Signals from outside in the loop: the real values of every cycle for the plant, and a log of what the model is told."""

from __future__ import annotations

import casadi as ca

from fpirhc.controllers.base import like
from fpirhc.controllers.contract import Controller
from fpirhc.plant.motion import outside_names, time_signal
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.exogenous import model_values, real_values
from fpirhc.task.problem import Problem

_HELD, _NOW = "_exact", "_exact_now"


def real_name(problem: Problem) -> str:
    """Return the signal of the parameters with which the plant moves in this cycle."""
    return _HELD if problem.foreign is not None or real_values(problem.real_plant, problem.signals) is None else _NOW


def outside_blocks(problem: Problem, controller: Controller) -> list[Block]:
    """Return blocks that write the real parameters of this cycle, 'signals' and 'signals_told'; none without signals."""
    real, known = problem.real_plant, controller.plant_model(problem)
    model = known.plant
    blocks = []
    if real_name(problem) == _NOW:
        values = real_values(real, problem.signals)
        assert values is not None
        blocks.append(_block("outside", problem, real, values, "signals", (_HELD, _NOW)))
    if outside_names(model):
        believed = model_values(model, known.signals) or _unchanged(model)
        blocks.append(_block("told", problem, model, believed, "signals_told", ("parameters", "")))
    return blocks


def _block(name: str, problem: Problem, plant: Plant, values: ca.Function, shown: str, ends: tuple[str, str]) -> Block:
    """Block (time, parameters `ends[0]`) -> their signals `shown`, and the parameters `ends[1]` where these have a name."""
    places, half = [plant.parameter.elements.index(n) for n in outside_names(plant)], problem.period / 2
    source, target = ends
    units = tuple(plant.parameter.units[k] for k in places)
    writes = (Signal(shown, outside_names(plant), units), *([like(plant.parameter, target)] if target else []))

    def step(s: Signals) -> dict[str, Expression]:
        now = values(s.time + half, getattr(s, source))
        return {shown: now[places], **({target: now} if target else {})}

    reads = Layout((time_signal(plant), like(plant.parameter, source)))
    return Block(name, reads, Layout(writes), step, opaque=not values.is_a("SXFunction"))


def _unchanged(plant: Plant) -> ca.Function:
    t, p = ca.SX.sym("t"), ca.SX.sym("p", plant.parameter.size)
    return ca.Function("fpirhc_signals", [t, p], [p])
