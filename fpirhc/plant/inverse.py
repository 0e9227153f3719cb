"""The inverse response of a plant: the inputs for a wanted response of the controlled coordinates.

A user's own inverse comes first. A response that is affine in the inputs, r = f_0 + G u, is solved by u = G^-1 (r - f_0). Any other
one is solved by Newton's method, and an input that Newton's method does not find is NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import casadi as ca

from fpirhc.errors import Mistakes, NotInvertible
from fpirhc.fields.user_code import called, named_results, scalar_expression
from fpirhc.plant.motion import Motion, by_name
from fpirhc.symbolic.expression import expression, graph
from fpirhc.symbolic.functions import nan_where
from fpirhc.symbolic.layout import Expression, Named

INVERSE_TOLERANCE = 1e-8  # relative response error beyond which an input of Newton's method is NaN
NEWTON_ITERATIONS = 50  # CasADi's own largest number, said here because the worst case of an exported step counts it


def inverse_function(plant: Motion, response: ca.Function) -> ca.Function:
    """Return the Function (state, response of the controlled coordinates, parameters) -> input.

    Args:
        response: Function (state, input, parameters) -> response of the controlled coordinates or outputs.
    """
    if len(plant.controlled_names) != len(plant.inputs):
        raise NotInvertible(f"{len(plant.controlled_names)} controlled coordinates need as many inputs")
    if plant.inverse is not None:
        return inverse_by_user(plant, plant.inverse)
    return inverse_of_affine(plant, response) if affine(plant, response) else inverse_by_newton(plant, response)


def affine(plant: Motion, response: ca.Function) -> bool:
    """Whether the response is affine in the inputs, decided from the symbols."""
    x, u, p = plant.symbols()
    return bool(ca.is_linear(response(x, u, p), u))


def inverse_by_user(plant: Motion, inverse: Callable[..., Mapping[str, Expression]]) -> ca.Function:
    """Function (state, response, parameters) -> input, made of the user's `inverse`."""
    x, _, p = plant.symbols()
    r = ca.SX.sym("r", len(plant.controlled_names))
    wanted = Named(plant.controlled_names, r, "coordinate")
    *derivatives, parameters = by_name(plant, x, p)
    commands = named_results("inverse", called("inverse", inverse, *derivatives, wanted, parameters))
    mistakes = Mistakes("inverse")
    for name in plant.inputs:
        if name not in commands:
            mistakes.add(f"it does not give input '{name}'; return it too")
    mistakes.raise_if_any()
    entries = [
        scalar_expression(f"inverse: input '{i}'", commands[i], of=inverse, symbols=(x, r, p)) for i in plant.inputs
    ]
    column = ca.vertcat(*entries)
    return ca.Function("fpirhc_inverse", [x, r, p], [ca.densify(column)], ["x", "r", "p"], ["u"])


def inverse_of_affine(plant: Motion, response: ca.Function) -> ca.Function:
    """Function (state, response, parameters) -> input, for a response that is affine in the inputs."""
    x, u, p = plant.symbols()
    r = ca.SX.sym("r", len(plant.controlled_names))
    gain = ca.jacobian(response(x, u, p), u)
    free = response(x, ca.SX.zeros(len(plant.inputs)), p)
    column = ca.densify(ca.solve(gain, r - free))
    return ca.Function("fpirhc_inverse", [x, r, p], [column], ["x", "r", "p"], ["u"])


def inverse_by_newton(plant: Motion, response: ca.Function) -> ca.Function:
    """Function (state, response, parameters) -> input, found by Newton's method.

    It begins at zero inputs; where these have no effect, as with the square of a current, at one unit of every input.
    """
    x, u, p = plant.symbols()
    r = ca.SX.sym("r", len(plant.controlled_names))
    error = ca.Function("fpirhc_inversion", [u, x, r, p], [response(x, u, p) - r])
    options = {"error_on_fail": False, "max_iter": NEWTON_ITERATIONS}
    finder = ca.rootfinder("fpirhc_newton", "fast_newton", error, options)
    xm, rm, pm = (ca.MX.sym(n, s) for n, s in (("x", x.numel()), ("r", r.numel()), ("p", p.numel())))
    count = len(plant.inputs)
    gain_at_zero = ca.sparsify(ca.substitute(ca.jacobian(response(x, u, p), u), u, ca.SX.zeros(count)))
    blind = ca.sprank(gain_at_zero.sparsity()) < count
    root = finder(ca.DM.ones(count) if blind else ca.DM.zeros(count), xm, rm, pm)
    residual = ca.norm_inf(error(root, xm, rm, pm))
    # NaN is on neither side of a comparison, so arriving is asked for and not missing.
    lost = ca.logic_not(residual <= INVERSE_TOLERANCE * (1 + ca.norm_inf(rm)))
    return ca.Function(
        "fpirhc_inverse", [xm, rm, pm], [root + graph(nan_where(expression(lost)))], ["x", "r", "p"], ["u"]
    )
