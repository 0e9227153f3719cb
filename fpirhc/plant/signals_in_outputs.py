"""Outputs and signals from outside: which signals have derivatives of their own in those of the outputs.

With y' = dh/dx x' + dh/dw w' an output that depends on a signal w needs w' in its derivative, which nobody states. It is zero where
the signal is held between jumps. A signal that first appears in the last derivative, as an input does, needs none; nor do outputs
of order 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant


def differentiated_signals(plant: Plant) -> tuple[str, ...]:
    """Return the signals on which an output of the plant, or a derivative below its relative order, depends."""
    if not plant.outputs:
        return ()
    x, u, p = plant.symbols()
    motion = plant.output_function(x, u, p, ca.SX.zeros(len(plant.names)))
    differentiated = [motion[k] for k, e in enumerate(plant.output.elements) if plant.output_orders.get(e, 1)]
    places = {name: plant.parameter.elements.index(name) for name in plant.signal_names}
    return tuple(name for name, place in places.items() if ca.depends_on(ca.vertcat(*differentiated), p[place]))
