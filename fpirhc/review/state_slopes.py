"""Slopes of a plant at a point: x' = A x + B u, and the responses y^(r) = C x + D u with all derivatives below them, Y x."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from fpirhc.plant.plant import Plant


class StateSlopes(NamedTuple):
    """A (nx, nx), B (nx, nu), C (n, nx), D (n, nu), Y (sum of relative orders, nx), of the controlled coordinates or outputs."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    y: np.ndarray


def state_slopes(plant: Plant, state: np.ndarray, command: np.ndarray, parameters: np.ndarray) -> StateSlopes:
    """Return the slopes at a point; those of a map are of its divided differences."""
    return StateSlopes(*(np.asarray(m.full()) for m in _function(plant)(state, command, parameters)))


def below_responses(plant: Plant) -> list[int]:
    """Return the places in `output` of controlled quantities and of their derivatives below the response; none of order 0."""
    orders = plant.response_orders
    return [k for k, e in enumerate(plant.output.elements) if orders.get(e.rstrip("'"), 0)]


@lru_cache(maxsize=8)  # several questions of a review need it
def _function(plant: Plant) -> ca.Function:
    x, u, p = plant.symbols()
    rates, responses = plant.equations.rate(x, u, p), plant.equations.controlled_response(x, u, p)
    shown = plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names)))
    chain = ca.vertcat(ca.SX(0, 1), *(shown[k] for k in below_responses(plant)))
    pairs = ((rates, x), (rates, u), (responses, x), (responses, u), (chain, x))
    return ca.Function("fpirhc_state_slopes", [x, u, p], [ca.densify(ca.jacobian(one, by)) for one, by in pairs])
