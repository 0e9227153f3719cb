"""A driver of plans as a library of its own, which loops of the virtual machine call.

It has one argument more than a step of an optimiser, a number that its text reads as `LAST`: one library serves the calls of a
loop and those in open loop.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.problem import OptimalControl
from fpirhc.symbolic.driver import Driver, registered
from fpirhc.symbolic.native import Native, native

LAST = "(arg[5] ? *arg[5] : 0)"


def plan_library(ocp: OptimalControl, name: str, driver: Driver, memory: int) -> Native:
    """Return the compiled Function (s0, data, lower, upper, memory, last) -> (U, diagnostics, memory), or why there is none.

    Args:
        name: that the Function's name begins with.
    """
    results = [ca.MX.zeros(*size) for size in ((ocp.input.size, ocp.stages), (5, 1), (memory, 1))]
    return native(ca.Function(registered(name, driver), [*_arguments(ocp, memory), ca.MX.sym("last")], results))


def with_last(ocp: OptimalControl, library: ca.Function, last: int) -> ca.Function:
    """Return the library's Function without its last argument."""
    arguments = _arguments(ocp, library.size1_in(4))
    return ca.Function(
        "fpirhc_plan_library", arguments, library.call([*arguments, ca.MX(last)]), {"always_inline": True}
    )


def _arguments(ocp: OptimalControl, memory: int) -> list[ca.MX]:
    nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
    sizes = {"s0": (ns, 1), "data": (ocp.data.size, n + 1), "lower": (nu, 1), "upper": (nu, 1), "memory": (memory, 1)}
    return [ca.MX.sym(name, *size) for name, size in sizes.items()]
