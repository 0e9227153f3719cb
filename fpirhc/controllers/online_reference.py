"""A reference with signals of its own inside a controller's step: its block, and its motion in every cycle.

It is one of the outputs of a plant that has some, else of its coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from fpirhc.errors import NotSupported
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Signal
from fpirhc.task.problem import Problem


def stages_of(problem: Problem) -> int:
    """Number of stages of the problem's horizon; 0 without one."""
    return problem.horizon.stages if problem.horizon is not None else 0


def given_signals(problem: Problem) -> tuple[Signal, ...]:
    """Return what a controller reads from outside for the reference."""
    return problem.reference.given(problem.plant, stages_of(problem))


def own_signals(problem: Problem) -> tuple[Signal, ...]:
    """Return the reference's own signals, which its block writes."""
    return problem.reference.own(problem.plant, stages_of(problem))


def own_values(problem: Problem, s: Signals) -> list[Expression]:
    """Return the own signals inside a step."""
    return [getattr(s, signal.name) for signal in own_signals(problem)]


def motion_of(problem: Problem, ahead: float = 0.0) -> ca.Function:
    """Function (t, own signals) -> (state, response) of the reference, now or after some time."""
    return problem.reference.motion_now(problem.plant, stages_of(problem), ahead)


def preview_of(problem: Problem) -> ca.Function | None:
    """Function (own signals) -> (states, responses) at the nodes of the horizon; None without own signals."""
    if problem.horizon is None:
        return None
    preview = problem.reference.preview(problem.plant, problem.horizon.stages, problem.horizon.step)
    if preview is not None and problem.horizon.lengths:
        raise NotSupported(
            "Horizon(lengths=...) needs a reference that is known ahead; leave lengths out with set-points"
        )
    return preview


def with_reference(problem: Problem, blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks of a controller after the reference's own block, where some of them read its signals."""
    names = {signal.name for signal in own_signals(problem)}
    read = {signal.name for block in blocks for signal in block.reads.signals}
    own = problem.reference.block(problem.plant, stages_of(problem), problem.period) if names & read else None
    return [*([own] if own is not None else []), *blocks]
