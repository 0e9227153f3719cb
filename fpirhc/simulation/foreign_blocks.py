"""The loop's two ends at a foreign reality: what it measures comes in, the inputs that it is sent go out."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from fpirhc.controllers.base import like
from fpirhc.sensing.base import response_names
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar, vector
from fpirhc.task.problem import Problem

SENT = "_acting"  # signal of the inputs that the reality is sent
_RAW, _HELD = "_foreign", "_foreign_held"


def foreign_signals(problem: Problem) -> tuple[Signal, ...]:
    """Return the signals that a loop reads from a foreign reality: its answer, and whether this is the last good one held."""
    if problem.foreign is None:
        return ()
    measures = problem.foreign.measures
    return vector(_RAW, tuple(measures), tuple(measures.values())), scalar(_HELD)


def shows_truth(problem: Problem) -> bool:
    """Whether a foreign reality measures everything that is judged: the model's whole state or outputs, and their responses."""
    if problem.foreign is None:
        return False
    plant = problem.plant
    return {*plant.output.elements, *response_names(plant.face)} <= set(problem.foreign.measures)


def foreign_block(problem: Problem, motion: Sequence[Signal], response: Signal) -> Block:
    """Block (answer) -> motion and response in the model's order, and the answer as it came; what is not measured is zero."""
    assert problem.foreign is not None
    names, answered = list(problem.foreign.measures), response_names(problem.plant.face)
    raw, held = foreign_signals(problem)
    wanted = {**{signal.name: signal.elements for signal in motion}, response.name: answered}

    def step(s: Signals) -> dict[str, Expression]:
        answer = s._foreign
        shown = {
            signal: ca.vertcat(*(answer[names.index(n)] if n in names else 0 for n in elements))
            for signal, elements in wanted.items()
        }
        return {**shown, "foreign": answer, "foreign_held": s._foreign_held}

    writes = (*motion, response, like(raw, "foreign"), scalar("foreign_held"))
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
