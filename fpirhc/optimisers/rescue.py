"""Interior steps where the plain iteration without limits of states gives up.

The plain iteration is fast where it contracts. Where it does not, its plan is the first guess of the iteration with limits
(`fpirhc.optimisers.limited`) if a plan was remembered. Otherwise that iteration begins from its own first guess. The better plan of
both is returned.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.base import sane, shift
from fpirhc.optimisers.limited_memory import limited_memory
from fpirhc.optimisers.limited_settings import MU_WARM
from fpirhc.status import Status
from fpirhc.symbolic.layout import Layout


def rescue(ocp: OptimalControl, plain: ca.Function, layout: Layout, limited: ca.Function) -> ca.Function:
    """Function (arguments of `plain`, its results) -> the better results, with the memory of `plain`.

    Args:
        ocp: the problem.
        plain: the converging step of the plain iteration.
        layout: its memory.
        limited: the converging step of the iteration with limits.
    """
    arguments = [ca.MX.sym(plain.name_in(k), *plain.size_in(k)) for k in range(plain.n_in())]
    results = [ca.MX.sym(f"r{k}", *plain.size_out(k)) for k in range(3)]
    work = ca.Function("fpirhc_rescue", [*arguments, *results], _better(ocp, layout, limited, arguments, results))
    rest = ca.Function("fpirhc_no_rescue", [*arguments, *results], results)
    needed = ca.logic_and(results[1][4] != int(Status.OK), sane(*arguments[:4]))
    choice = ca.Function.if_else("fpirhc_rescue_if_needed", work, rest)
    return ca.Function("fpirhc_rescued", [*arguments, *results], list(choice(needed, *arguments, *results)))


def _better(
    ocp: OptimalControl, layout: Layout, limited: ca.Function, arguments: list[ca.MX], first: list[ca.MX]
) -> list[ca.MX]:
    """The results of both, the better one of them, in the plain iteration's memory."""
    n, ns = ocp.stages, ocp.state.size
    before, plan, plain_memory = layout.split(arguments[4]), limited_memory(ocp), layout.split(first[2])
    evaluated = first[1][4] < int(Status.INFEASIBLE)
    warm = ca.logic_and(before["plan_step"] > 0, evaluated)
    begin = {name: ca.MX.zeros(plan[name].size) for name in plan.names}
    begin["plan_inputs"] = ca.if_else(warm, plain_memory["plan_inputs"], before["plan_inputs"])
    states = ca.vec(shift(ca.reshape(plain_memory["plan_states"], ns, n)))
    begin |= {"plan_states": ca.if_else(warm, states, 0), "plan_gains": ca.if_else(warm, plain_memory["plan_gains"], 0)}
    begin["plan_barrier"] = ca.if_else(warm, MU_WARM, 0)
    second = limited(*arguments[:4], plan.join(begin))
    inputs, diagnostics, after = second
    interior_memory = plan.split(after)

    nodes = ca.reshape(interior_memory["plan_states"], ns, n)
    earlier = ca.horzcat(arguments[0], nodes[:, : n - 1])
    memory: dict[str, ca.MX] = {
        "plan_inputs": ca.vec(inputs),
        "plan_states": ca.vec(earlier),
        "plan_gains": interior_memory["plan_gains"],
        "plan_gamma": ca.MX(0),
        "plan_step": ca.MX(1),
    }
    usable = diagnostics[4] < int(Status.INFEASIBLE)
    closer = ca.logic_or(
        diagnostics[4] == int(Status.OK), ca.logic_or(ca.logic_not(evaluated), diagnostics[1] < first[1][1])
    )
    better = ca.logic_and(usable, closer)
    count = ca.vertcat(ca.MX.zeros(3), first[1][3], 0)
    results = [inputs, diagnostics + count, layout.join(memory)]
    return [ca.if_else(better, new, old) for new, old in zip(results, first, strict=True)]
