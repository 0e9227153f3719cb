"""The CasADi Functions of a plant, and its inverse: the input for a wanted response."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca

from fpirhc.errors import InvalidProblem, Mistakes
from fpirhc.fields.user_code import called, named_results, scalar_expression
from fpirhc.plant.chain import Symbols, derivatives, output_order
from fpirhc.plant.motion import arguments_of, believed_in, by_name, sampling, words
from fpirhc.symbolic.expression import FINITE, Expression, Matrix, expression, graph, nan_where
from fpirhc.symbolic.layout import Named

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant


class Equations:
    """What a plant's equations say, each Function made when it is asked for; other exact parameters do not change them."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant

    @cached_property
    def response(self) -> ca.Function:
        """Function (state, input, parameters) -> highest derivative of every coordinate (n)."""
        x, u, p = self.plant.symbols()
        if self.plant.step is not None:
            responses = self.forced_rate(x, u, p, ca.SX.zeros(len(self.plant.names)))
        else:
            responses = self._of_user(1.0, x, u, p)
        return ca.Function("fpirhc_response", [x, u, p], [responses], ["x", "u", "p"], ["r"])

    @cached_property
    def forced_rate(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> dx/dt, or of a map its divided differences."""
        x, u, p, w = symbols = self._forced()
        if self.plant.step is not None:
            rates = (self.next(*symbols) - x) / sampling(self.plant)
        else:
            responses, elements = self.response(x, u, p) + w, self.plant.state.elements
            above = dict(zip(elements, ca.vertsplit(x), strict=True))
            for name, order, highest in zip(self.plant.names, self.plant.orders, ca.vertsplit(responses), strict=True):
                above[name + "'" * order] = highest
            rates = ca.vertcat(*(above[element + "'"] for element in elements))
        return ca.Function("fpirhc_derivative", [x, u, p, w], [rates], ["x", "u", "p", "w"], ["xdot"])

    @cached_property
    def rate(self) -> ca.Function:
        """Function (state, input, parameters) -> the same, undisturbed."""
        x, u, p = self.plant.symbols()
        rate = self.forced_rate(x, u, p, ca.SX.zeros(len(self.plant.names)))
        return ca.Function("fpirhc_free_derivative", [x, u, p], [rate], ["x", "u", "p"], ["xdot"])

    @cached_property
    def next(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state of a map one cycle later; a forcing adds to the differences."""
        assert self.plant.step is not None
        x, u, p, w = self._forced()
        one, after = ca.Function("fpirhc_step", [x, u, p], [self._of_user(self.plant.step, x, u, p)]), x
        for _ in range(self.plant.steps):
            after = one(after, u, p) + self.plant.step * w
        return ca.Function("fpirhc_next", [x, u, p, w], [after], ["x", "u", "p", "w"], ["x_next"])

    @cached_property
    def output_orders(self) -> dict[str, int]:
        """Relative order of every output, or coordinate: the derivative that the command moves at once; 0 for the output itself."""
        if not self.plant.outputs:
            return dict(zip(self.plant.names, self.plant.orders, strict=True))
        orders = {name: output_order(self.plant, name) for name in self.plant.outputs}
        return {name: 1 if order is None else order for name, order in orders.items()}

    @cached_property
    def output(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> y, y', ... of the outputs; without outputs the state."""
        x, u, p, w = symbols = self._forced()
        chains = derivatives(self.plant, {name: most - 1 for name, most in self.plant.chains.items()}, symbols)
        entries = [chains[e.rstrip("'")][e.count("'")] for e in self.plant.output.elements]
        column = ca.densify(ca.vertcat(*entries))
        return ca.Function("fpirhc_outputs", [x, u, p, w], [column], ["x", "u", "p", "w"], ["y"])

    @cached_property
    def known_by_outputs(self) -> tuple[int, ...]:
        """For every entry of the state its place among y, y', ...; -1 where it is none of these, and so has no reference."""
        x, u, p = self.plant.symbols()
        entries = ca.vertsplit(self.output(x, u, p, ca.SX.zeros(len(self.plant.names))))
        equal = [[k for k, e in enumerate(entries) if ca.is_equal(e, x[i], 1)] for i in range(x.numel())]
        return tuple(places[0] if places else -1 for places in equal)

    @cached_property
    def hidden(self) -> tuple[str, ...]:
        """Names of the states that are no output, and no derivative of one, so that they have no reference."""
        pairs = zip(self.plant.state.elements, self.known_by_outputs, strict=True)
        return tuple(e for e, place in pairs if place < 0)

    def state_of(self, outputs: Matrix, otherwise: Matrix) -> Matrix:
        """Return states, a column each, from columns of outputs and their derivatives; what these hide is that of `otherwise`."""
        places = enumerate(self.known_by_outputs)
        return ca.vertcat(*(outputs[place, :] if place >= 0 else otherwise[k, :] for k, place in places))

    @cached_property
    def follows_state(self) -> bool:
        """Whether what has a reference is the state itself, entry by entry."""
        return self.known_by_outputs == tuple(range(self.plant.state.size))

    @cached_property
    def controlled_response(self) -> ca.Function:
        """Function (state, input, parameters) -> highest derivatives of the controlled quantities; of order 0 these themselves."""
        x, u, p = self.plant.symbols()
        chains = derivatives(self.plant, self.plant.response_orders, (x, u, p, ca.SX.zeros(len(self.plant.names))))
        added = (believed_in(self.plant, n + "'" * k, p) if k else 0 for n, k in self.plant.response_orders.items())
        entries = (chain[-1] + more for chain, more in zip(chains.values(), added, strict=True))
        column = ca.densify(ca.vertcat(*entries))
        return ca.Function("fpirhc_controlled_response", [x, u, p], [column], ["x", "u", "p"], ["r"])

    @cached_property
    def input_gain(self) -> ca.Function:
        """Function (state, input, parameters) -> derivative of the controlled response with respect to the inputs."""
        x, u, p = self.plant.symbols()
        return ca.Function("fpirhc_input_gain", [x, u, p], [ca.jacobian(self.controlled_response(x, u, p), u)])

    @cached_property
    def affine(self) -> bool:
        """Whether the controlled response is affine in the inputs, decided from the symbols."""
        x, u, p = self.plant.symbols()
        return bool(ca.is_linear(self.controlled_response(x, u, p), u))

    @cached_property
    def inverse_opaque(self) -> bool:
        """Whether the inverse response needs a root finder, for which scalar expressions do not suffice."""
        return self.plant.inverse is None and not self.affine

    @cached_property
    def inverse(self) -> ca.Function:
        """Function (state, response of the controlled coordinates, parameters) -> input."""
        if len(self.plant.controlled_names) != len(self.plant.inputs):
            raise InvalidProblem(f"{len(self.plant.controlled_names)} controlled coordinates need as many inputs")
        if self.plant.inverse is not None:
            return inverse_by_user(self.plant, self.plant.inverse)
        x, u, p = self.plant.symbols()
        response, r = self.controlled_response, ca.SX.sym("r", u.numel())
        if not self.affine:
            return _by_newton(response, x, u, p, r)
        free = response(x, ca.SX.zeros(u.numel()), p)
        column = ca.densify(ca.solve(ca.jacobian(response(x, u, p), u), r - free))
        return ca.Function("fpirhc_inverse", [x, r, p], [column], ["x", "r", "p"], ["u"])

    def _forced(self) -> Symbols:
        return *self.plant.symbols(), ca.SX.sym("w", len(self.plant.names))

    def _of_user(self, share: float, x: ca.SX, u: ca.SX, p: ca.SX) -> Expression:
        """What the user's function gives for every coordinate, with so large a share of what is believed to add to it."""
        values = called(words(self.plant)[1], self.plant.response, *arguments_of(self.plant, x, u, p))
        entries = (ca.SX(values[name]) + share * believed_in(self.plant, name, p) for name in self.plant.names)
        return ca.densify(ca.vertcat(*entries))


def inverse_by_user(plant: Plant, inverse: Callable[..., Mapping[str, Expression]]) -> ca.Function:
    """Function (state, response, parameters) -> input, made of the user's `inverse`."""
    x, _, p = plant.symbols()
    r = ca.SX.sym("r", len(plant.controlled_names))
    entries = []
    for k, (name, order) in enumerate(plant.response_orders.items()):
        of = name + "'" * order
        entries.append(
            r[k] - believed_in(plant, of if of in plant.believed or name not in plant.coordinates else name, p)
        )
    wanted = Named(plant.controlled_names, ca.vertcat(*entries), "coordinate")
    *lower, parameters = by_name(plant, x, p)
    commands = named_results("inverse", called("inverse", inverse, *lower, wanted, parameters))
    mistakes = Mistakes("inverse")
    for name in plant.inputs:
        if name not in commands:
            mistakes.add(f"it does not give input '{name}'; return it too")
    mistakes.raise_if_any()
    entries = [
        scalar_expression(f"inverse: input '{i}'", commands[i], of=inverse, symbols=(x, r, p)) for i in plant.inputs
    ]
    return ca.Function("fpirhc_inverse", [x, r, p], [ca.densify(ca.vertcat(*entries))], ["x", "r", "p"], ["u"])


NEGLIGIBLE = 1e-3  # share of terms that cancel beside which a number counts as zero
INVERSE_TOLERANCE = 1e-8  # relative response error beyond which an input of Newton's method is NaN
INVERSE_ROUNDING = 1e-15  # relative response error at which it stops, unless a step of 1e-12 of an input does before
NEWTON_ITERATIONS = 50  # CasADi's own largest number, said here because the worst case of an exported step counts it


def _by_newton(response: ca.Function, x: ca.SX, u: ca.SX, p: ca.SX, r: ca.SX) -> ca.Function:
    """Function (state, response, parameters) -> input, found by Newton's method.

    It begins at zero inputs; where these have no effect, as with the square of a current, at one unit of every input: such an input
    is found where it is not much smaller than its unit.
    """
    given = ca.SX.sym("size", r.numel()), ca.SX.sym("unit", u.numel())
    error = ca.Function("fpirhc_inversion", [u, x, r, p, *given], [(response(x, u * given[1], p) - r) / given[0]])
    options = {"error_on_fail": False, "max_iter": NEWTON_ITERATIONS, "abstol": INVERSE_ROUNDING}
    finder = ca.rootfinder("fpirhc_newton", "fast_newton", error, options)
    xm, rm, pm = (ca.MX.sym(n, s) for n, s in (("x", x.numel()), ("r", r.numel()), ("p", p.numel())))
    none, one = ca.DM.zeros(u.numel()), ca.DM.ones(u.numel())
    gain_at_zero = ca.sparsify(ca.substitute(ca.jacobian(response(x, u, p), u), u, none))
    blind = ca.sprank(gain_at_zero.sparsity()) < u.numel()
    there, unit = response(x, none, p), ca.SX(one)
    # How large each response is: what is asked, what there is without inputs, and a share of the terms that cancel there.
    known = ca.vertcat(x, p)
    terms = ca.mtimes(ca.fabs(ca.jacobian(there, known)), ca.fabs(known))
    size = ca.fabs(r) + ca.fabs(there) + NEGLIGIBLE * _finite(terms, 0)
    if blind:  # as much as nearly no input does, whose effect is a square at least
        size += NEGLIGIBLE**2 * _finite(ca.fabs(response(x, one, p)), 0)
    else:  # of the first step, at most 1
        unit = ca.fmin(1, _finite(ca.fabs(ca.solve(gain_at_zero, r - there)), 1))
    # Where all is zero, or so small that its square is, zero inputs are the answer.
    sizes = ca.Function("fpirhc_sizes", [x, r, p], [ca.densify(v + (v**2 <= 0)) for v in (size, unit)])(xm, rm, pm)
    root = finder(one if blind else none, xm, rm, pm, *sizes)
    residual = ca.norm_inf(error(root, xm, rm, pm, *sizes))
    # NaN is on neither side of a comparison, so arriving is asked for and not missing.
    lost = ca.logic_not(residual <= INVERSE_TOLERANCE)
    column = sizes[1] * root + graph(nan_where(expression(lost)))
    return ca.Function("fpirhc_inverse", [xm, rm, pm], [column], ["x", "r", "p"], ["u"])


def _finite(values: Expression, other: float) -> Expression:
    """The values, and another one in place of what is not finite."""
    return ca.vertcat(*(ca.if_else(ca.fabs(v) < FINITE, v, other) for v in ca.vertsplit(ca.densify(values))))
