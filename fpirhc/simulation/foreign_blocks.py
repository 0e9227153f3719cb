"""The loop's two ends at a foreign reality: what it measures comes in, the inputs that it is sent go out."""

from __future__ import annotations

import casadi as ca

from fpirhc.controllers.base import like
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar, vector
from fpirhc.task.foreign import quantities
from fpirhc.task.problem import Problem

SENT = "_acting"  # signal of the inputs that the reality is sent
_RAW, _HELD = "_foreign", "_foreign_held"


def foreign_signals(problem: Problem) -> tuple[Signal, ...]:
    """Return the signals that a loop reads from a foreign reality: its answer, and whether this is the last good one held."""
    if problem.foreign is None:
        return ()
    measures = problem.foreign.measures
    return vector(_RAW, tuple(measures), tuple(measures.values())), scalar(_HELD)


def measures_all(problem: Problem) -> bool:
    """Whether a foreign reality measures the model's whole state and the controlled responses."""
    return problem.foreign is not None and set(quantities(problem.plant)) <= set(problem.foreign.measures)


def foreign_block(problem: Problem, state: Signal, response: Signal) -> Block:
    """Block (answer) -> state and response in the model's order, and the answer as it came; what is not measured is zero."""
    assert problem.foreign is not None
    names = list(problem.foreign.measures)
    every, size = list(quantities(problem.plant)), problem.plant.state.size
    raw, held = foreign_signals(problem)

    def step(s: Signals) -> dict[str, Expression]:
        answer = s._foreign
        column = ca.vertcat(*(answer[names.index(n)] if n in names else 0 for n in every))
        shown = {state.name: column[:size], response.name: column[size:]}
        return {**shown, "foreign": answer, "foreign_held": s._foreign_held}

    writes = (state, response, like(raw, "foreign"), scalar("foreign_held"))
    return Block("sense", Layout((raw, held)), Layout(writes), step)


def sending_block(problem: Problem, disturbed: tuple[Signal, ...], arriving: Signal) -> Block:
    """Block (arriving command, disturbances of inputs) -> the inputs that the reality is sent."""
    plant = problem.plant

    def step(s: Signals) -> dict[str, Expression]:
        u = getattr(s, arriving.name)
        if disturbed:
            added = dict(zip(problem.disturbances, ca.vertsplit(s.disturbance), strict=True))
            u = u + ca.vertcat(*(added.get(name, 0) for name in plant.inputs))
        return {SENT: u}

    return Block("send", Layout((arriving, *disturbed)), Layout((like(plant.input, SENT),)), step)
