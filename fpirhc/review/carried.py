"""A point of a reality whose own states do not settle, because they move along: a motor that turns with its load.

The controlled quantities of the model have their reference values up to the response, and their further derivatives are zero with
the input held,

    y^(k) = y^N(k)  for k <= r,        y^(k) = 0  for r < k <= m,

with as many derivatives as the reality has states and inputs. So a motor behind a spring has the speed of its load.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.plant.chain import derivatives_function
from fpirhc.plant.plant import Plant
from fpirhc.task.reality import Reality

Carrying: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray] | None]
_STEPS = 30  # of Newton's method
_SMALL = 1e-10  # last step, relative
_LEFT = 1e-6  # of an equation, relative to the size of its terms


def carrying(reality: Reality, model: Plant) -> Carrying | None:
    """Return the function (first guess of state, of input, wanted y ... y^(r)) -> state and input, or None.

    Args:
        reality: the plant that moves.
        model: of the controllers; the wanted values are in the order of its state, then its controlled responses.

    Returns:
        None where the numbers of derivatives and of states do not match, or the model has coordinates that are not controlled.
    """
    plant, names = reality.plant, model.names
    count, rest = divmod(plant.state.size, len(names))
    if model.outputs or rest or len(model.controlled_names) != len(names) or len(plant.inputs) != len(names):
        return None
    if min(model.orders) != max(model.orders) or count < max(model.orders):
        return None
    x, u, p = plant.symbols()
    wanted = ca.SX.sym("wanted", model.state.size + len(names))
    places = [(reality.true_name(c), k) for k in range(count + 1) for c in names]
    chain = derivatives_function(plant, places)(x, u, p, ca.SX.zeros(len(plant.names)))
    left = chain - ca.vertcat(wanted, ca.SX.zeros(len(places) - wanted.numel()))
    slope = ca.densify(ca.jacobian(left, ca.vertcat(x, u)))
    newton = ca.Function("fpirhc_carried", [x, u, p, wanted], [left, slope])

    def solve(state: np.ndarray, command: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        at = np.concatenate([state, command]).astype(float)
        for _ in range(_STEPS):
            error, by = (np.asarray(m.full()) for m in newton(at[: state.size], at[state.size :], plant.exact, values))
            if not (np.isfinite(error).all() and np.isfinite(by).all()):
                return None
            sizes = np.abs(by).max(axis=1)  # rows differ by powers of the fastest rate
            sizes[sizes == 0] = 1.0
            step = np.linalg.lstsq(by / sizes[:, None], -error.ravel() / sizes, rcond=None)[0]
            at += step
            if np.abs(step).max() <= _SMALL * (1 + np.abs(at).max()):
                solved = np.abs(error.ravel() / sizes).max() <= _LEFT * (1 + np.abs(at).max())
                return (at[: state.size], at[state.size :]) if solved else None
        return None

    return solve
