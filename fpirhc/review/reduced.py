"""The motion of a reality of which all settles but what its model has too: x' = A x with the rest at its equilibrium."""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.linalg import null_space

from fpirhc.plant.plant import Plant
from fpirhc.task.reality import Reality


def outer_slopes(reality: Reality, model: Plant, state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Return the slopes of the model's states by the reality's, shape (count, nx of the reality).

    Where the reality lacks a state of the model, or the model has outputs, they are those of its coordinates of the same names.

    Args:
        reality: the plant that moves.
        model: of the controllers.
        state: of the reality, shape (nx,).
        command: shape (nu,).
    """
    plant, known = reality.plant, sorted(reality.shared(model).values())
    if model.outputs or len(known) == model.state.size or len(reality.shown(model)) < model.state.size:
        return np.eye(plant.state.size)[known]
    x, u, p = plant.symbols()
    shown = reality.function(reality.shown(model))(x, u, p, ca.SX.zeros(len(plant.names)))
    slopes = ca.Function("fpirhc_outer", [x, u, p], [ca.densify(ca.jacobian(shown, x))])
    return np.asarray(slopes(state, command, plant.exact).full())


def reduced(a: np.ndarray, outer: np.ndarray) -> np.ndarray:
    """Return the matrix of the motion of `outer` x, shape (count, count), where all else settles.

    Args:
        a: of the motion, shape (nx, nx).
        outer: independent rows, shape (count, nx).
    """
    if not len(outer):
        return np.zeros((0, 0))
    count, change = len(outer), np.vstack([outer, null_space(outer).T])
    straight = change @ a @ np.linalg.inv(change)
    settle = np.linalg.pinv(straight[count:, count:])
    return np.asarray(straight[:count, :count] - straight[:count, count:] @ settle @ straight[count:, :count])
