"""The model of the last plan, where a model changes between plans.

A plan's first response is that of the model with which it was made, r = f(x, u_0; p_plan), and the inverse takes the newest one.
So a new estimate changes the command at once, by what the model has learned since the plan,

    u = f^-1(x, r; p) = u_0 - (f(x, u_0; p) - f(x, u_0; p_plan)) / (df/du),

and not only in the next plan. With the newest model in both places it would cancel.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.controllers.base import fed
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, Value
from fpirhc.symbolic.layout import Layout, Signal, scalar
from fpirhc.task.problem import Problem

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
