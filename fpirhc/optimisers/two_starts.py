"""A plan from two starts: the remembered one, and the first guess of a call that remembers nothing; the cheaper one is taken."""

from __future__ import annotations

import casadi as ca

from fpirhc.status import Status
from fpirhc.symbolic.layout import Layout


def of_two_starts(one: ca.Function, memory: Layout) -> ca.Function:
    """Function like a step of an optimiser: the result of `one`, or of `one` from the start of its memory where that is cheaper.

    A plan that is not solved is taken only if neither is. The iterations are those of both.

    Args:
        one: Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory).
        memory: its layout.
    """
    arguments = [ca.MX.sym(one.name_in(k), *one.size_in(k)) for k in range(one.n_in())]
    warm = one(*arguments)
    cold = one(*arguments[:4], ca.MX(ca.DM(memory.start())))
    solved = [result[1][4] == int(Status.OK) for result in (warm, cold)]
    cheaper = ca.logic_or(ca.logic_not(solved[0]), cold[1][0] < warm[1][0])
    better = ca.logic_and(solved[1], cheaper)
    count = ca.vertcat(ca.MX.zeros(3), 1, 0)
    chosen = [ca.if_else(better, new, old) for new, old in zip(cold, warm, strict=True)]
    other = ca.if_else(better, warm[1][3], cold[1][3])
    chosen[1] = chosen[1] + count * other
    return ca.Function(f"{one.name()}_twice", arguments, chosen)
