"""What a plan needs beside its solver: a start, the model that it was made with, and what the solver remembers before a run.

A plan on outputs starts at the state at which the model has the measured ones; the inverse stays at the measured state, where the
gain from request to response is the plant's. A first response is that of the model of the plan, and the inverse takes the newest
one, so that a new estimate changes the command at once, u = u_0 - (f(x, u_0; p) - f(x, u_0; p_plan)) / (df/du).
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from fpirhc.controllers.base import fed, like
from fpirhc.horizon.consistent_state import consistent_state
from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.base import Optimiser
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, Value
from fpirhc.symbolic.latest import Latest
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.problem import Problem

_STATE = "_consistent_state"


def consistent_start(plant: Plant) -> Block:
    """Return the block (state, measured outputs, parameters) -> the state at which the model has these outputs."""
    function = consistent_state(plant)
    reads, writes = Layout((plant.state, plant.output, plant.parameter)), Layout((like(plant.state, _STATE),))

    def step(s: Signals) -> dict[str, Expression]:
        return {_STATE: function(s.state, s.output, s.parameters)}

    return Block("consistent_start", reads, writes, step, opaque=True)


def at_consistent_start(plant: Plant, blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks with that state in place of the measured one."""
    return [fed(block, plant.state.name, like(plant.state, _STATE)) for block in blocks]


_PLANNED, _BEFORE = "_planned_with", "_planned_with_before"


def held_model(problem: Problem) -> tuple[Block, Delay]:
    """Return the block (whether a plan is due, parameters) -> parameters of the last plan, and what is remembered."""
    parameters = problem.plant.parameter
    before = Signal(_BEFORE, parameters.elements, parameters.units)

    def step(s: Signals) -> dict[str, Value]:
        return {_PLANNED: ca.if_else(s._due > 0.5, s.parameters, getattr(s, _BEFORE))}

    reads = Layout((scalar("_due"), parameters, before))
    return Block("planned_model", reads, Layout((_planned(problem),)), step), Delay(before, _PLANNED)


def as_planned(block: Block, problem: Problem) -> Block:
    """Return the block with the parameters of the last plan in place of the newest ones."""
    return fed(block, problem.plant.parameter.name, _planned(problem))


def _planned(problem: Problem) -> Signal:
    parameters = problem.plant.parameter
    return Signal(_PLANNED, parameters.elements, parameters.units)


_LATEST: Latest[np.ndarray] = Latest(8)


def built_first_memory(problem: Problem, optimiser: Optimiser, ocp: OptimalControl, data_of: ca.Function) -> np.ndarray:
    """Return `first_memory` with the numbers of the build; the data are those of this horizon at this start."""
    start = problem.start_state.tobytes(), np.asarray(problem.inputs_before, dtype=float).tobytes()
    memory = _LATEST.of((ocp, optimiser), start, lambda: first_memory(problem, optimiser, ocp, data_of))
    return memory.copy()


def first_memory(problem: Problem, optimiser: Optimiser, ocp: OptimalControl, data_of: ca.Function) -> np.ndarray:
    """Return the optimiser's memory before the run.

    Args:
        problem: with numbers for its live settings.
        optimiser: of the plans.
        ocp: the horizon.
        data_of: Function (time, parameters, live numbers) -> data of the horizon.
    """
    first = np.asarray(ocp.start(problem.start_state, problem.inputs_before).full()).ravel()
    live = ocp.nodes[2][ocp.data.slice("settings").start :, 0] if ocp.settings else None
    arguments = (0.0, problem.plant.approximate)
    table = data_of(*arguments) if live is None else data_of(*arguments, live)
    return optimiser.first_memory(ocp, first, np.asarray(table.full()))
