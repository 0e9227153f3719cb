"""The CasADi Functions of a plant: those of its motion, its outputs with their derivatives, and the inverse."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca

from fpirhc.plant.inverse import affine, inverse_function
from fpirhc.plant.lie_derivatives import believed_disturbance, lie_derivatives, output_expression, output_order
from fpirhc.plant.motion import MotionEquations, controlled_places

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant


class Equations(MotionEquations):
    """What a plant's equations say, each Function made when it is asked for."""

    motion: Plant

    @cached_property
    def output_orders(self) -> dict[str, int]:
        """Relative order of every output, or coordinate: the derivative that the command moves at once; 0 for the output itself.

        An output that no input reaches has the order one.
        """
        if not self.motion.outputs:
            return dict(zip(self.motion.names, self.motion.orders, strict=True))
        found = {name: output_order(self.motion, name) for name in self.motion.outputs}
        return {name: 1 if order is None else order for name, order in found.items()}

    @cached_property
    def output(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> y, y', ... of the outputs; without outputs the state."""
        x, u, p = self.motion.symbols()
        w = ca.SX.sym("w", len(self.motion.names))
        chains = {
            name: lie_derivatives(self.motion, output_expression(self.motion, name, x, u, p), order, (x, u, p, w))
            for name, order in self.motion.chains.items()
            if self.motion.outputs
        }
        entries = (
            [chains[e.rstrip("'")][e.count("'")] for e in self.motion.output.elements] if self.motion.outputs else [x]
        )
        return ca.Function(
            "fpirhc_outputs", [x, u, p, w], [ca.densify(ca.vertcat(*entries))], ["x", "u", "p", "w"], ["y"]
        )

    @cached_property
    def known_by_outputs(self) -> tuple[int, ...]:
        """For every entry of the state its place among y, y', ...; -1 where it is none of these, and so has no reference."""
        x, u, p = self.motion.symbols()
        if not self.motion.outputs:
            return tuple(range(self.motion.state.size))
        entries = ca.vertsplit(self.output(x, u, p, ca.SX.zeros(len(self.motion.names))))
        equal = [[k for k, e in enumerate(entries) if ca.is_equal(e, x[i], 1)] for i in range(x.numel())]
        return tuple(places[0] if places else -1 for places in equal)

    @cached_property
    def controlled_response(self) -> ca.Function:
        """Function (state, input, parameters) -> highest derivative of the controlled coordinates or outputs.

        The response of an output of order 0 is the output.
        """
        x, u, p = self.motion.symbols()
        if self.motion.outputs:
            calm = ca.SX.zeros(len(self.motion.names))
            chains = {
                name: lie_derivatives(
                    self.motion, output_expression(self.motion, name, x, u, p), order, (x, u, p, calm)
                )
                for name, order in self.motion.response_orders.items()
            }
            entries = (chain[-1] + believed_disturbance(self.motion, name, p) for name, chain in chains.items())
            responses = ca.densify(ca.vertcat(*entries))
        else:
            responses = self.response(x, u, p)[controlled_places(self.motion)]
        return ca.Function("fpirhc_controlled_response", [x, u, p], [responses], ["x", "u", "p"], ["r"])

    @cached_property
    def affine(self) -> bool:
        """Whether the controlled response is affine in the inputs, decided from the symbols."""
        return affine(self.motion, self.controlled_response)

    @property
    def inverse_opaque(self) -> bool:
        """Whether the inverse response needs a root finder, for which scalar expressions do not suffice."""
        return self.motion.inverse is None and not self.affine

    @cached_property
    def inverse(self) -> ca.Function:
        """Function (state, response of the controlled coordinates, parameters) -> input.

        An input that Newton's method does not find is NaN.

        Raises:
            NotInvertible: the inputs and the controlled coordinates differ in number.
        """
        return inverse_function(self.motion, self.controlled_response)
