"""Outputs of order 0, y = h(x, u, p): the command moves them at once, so no derivative has to be prescribed.

Their response is the output itself, and their nominal response the reference at the end of the cycle over which a command is held:
there the response is measured. Among the coordinates of the face such an output has the order one, so that it is measured, judged
and has a reference like any other.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import Matrix


def nominal_responses(
    plant: Plant, outputs: Matrix, responses: Matrix, later: Callable[[], Matrix] | None = None
) -> Matrix:
    """Return the nominal responses of the controlled quantities: highest derivatives, or the outputs of order 0 themselves.

    Args:
        plant: the plant.
        outputs: nominal outputs and their derivatives, in the order of `Plant.output`; without outputs the state.
        responses: nominal highest derivatives of the face.
        later: gives the outputs at the end of the cycle, where one is of order 0; None: `outputs`.
    """
    face, instant = plant.face, [name for name, order in plant.response_orders.items() if not order]
    if not instant:
        return responses[list(face.controlled_indices)]
    ahead = outputs if later is None else later()
    places = [plant.output.elements.index(name) if name in instant else -1 for name in plant.controlled_names]
    entries = (responses[k] if at < 0 else ahead[at] for k, at in zip(face.controlled_indices, places, strict=True))
    return ca.vertcat(*entries)
