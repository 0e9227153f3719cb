"""A first plan from a horizon's data: the reference and the feedforward."""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.problem import OptimalControl


def guess(ocp: OptimalControl) -> ca.Function:
    """Function theta -> (reference as a stage's state (ns), feedforward (nu)).

    States without a reference are those of the nodes.
    """
    theta = ca.SX.sym("theta", ocp.data.size)
    reference, forward = (theta[ocp.data.slice(name)] for name in ("reference", "feedforward"))
    if ocp.inner:
        reference = ca.vertcat(*(reference[k] if k >= 0 else value for k, value in ocp.inner))
    rest = ocp.state.size - reference.numel() - ocp.written
    state = ca.vertcat(reference, *([forward] if rest else []), ca.SX.zeros(ocp.written))
    return ca.Function("fpirhc_guess", [theta], [ca.densify(state), ca.densify(forward)])


def guesses(ocp: OptimalControl) -> ca.Function:
    """Function data (ntheta, N + 1) -> (ns, N + 1), (nu, N + 1)."""
    return guess(ocp).map(ocp.stages + 1)
