"""The relative order of a coordinate, from the pattern of dependence in the plant's symbols."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.plant.motion import Motion


def structural_order(plant: Motion, coordinate: str) -> int | None:
    """Return the number of the first derivative of `coordinate` that depends on an input; None if there is none.

    Only the pattern of dependence counts, so an accidental cancellation has no effect. The search is a breadth-first walk from the
    coordinate through the states on which its derivatives depend.
    """
    x, u, p = plant.symbols()
    rate = plant.derivative_function(x, u, p)
    on_state = np.array(ca.DM(ca.jacobian_sparsity(rate, x), 1).full(), dtype=bool)
    on_input = np.array(ca.DM(ca.jacobian_sparsity(rate, u), 1).full(), dtype=bool).any(axis=1)
    reached: np.ndarray = np.zeros(plant.state.size, dtype=bool)
    reached[plant.state.elements.index(coordinate)] = True
    for order in range(1, plant.state.size + 1):
        if bool((reached & on_input).any()):
            return order
        reached = np.asarray(on_state[reached].any(axis=0))
    return None
