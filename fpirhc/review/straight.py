"""A plant with outputs in the coordinates of its outputs, near its nominal run, so that reviews linearise it as any other plant.

The coordinates are z = (y, y', ..., y^(r-1), eta): the controlled outputs with their derivatives, and as many of the states as are
missing, those that the outputs show least. With the change of coordinates T = dz/dx at a point,

    y^(r) = dy_r/dx T^-1 dz + dy_r/du du,        eta' = deta'/dx T^-1 dz + deta'/du du.

T is that of the plant that moves: the outputs are measured on it, and a model's slopes by x are written in the same z.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np
from scipy.linalg import null_space, qr

from fpirhc.plant.outputs import light_plant
from fpirhc.plant.plant import Plant
from fpirhc.review.plan_feedback import PlanGain
from fpirhc.task.problem import Problem

Slopes: TypeAlias = ca.Function | Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[ca.DM, ca.DM]]


@dataclass(frozen=True, eq=False)
class Straight:
    """A plant as coordinates with relative orders.

    Args:
        plant: its coordinates, orders and inputs; without outputs the plant itself. Of a plant with outputs it has no equations.
        slopes: Function (state, input, parameters) -> slopes of its responses by the state x and the input.
        change: Function (state, parameters) -> T (nx, nx); None without outputs.
        shown: Function (state, parameters) -> slopes C (ny, nx) of all outputs y, y', ...; None without outputs.
    """

    plant: Plant
    slopes: ca.Function
    change: ca.Function | None = None
    shown: ca.Function | None = None

    def feedback_on(
        self, gain: PlanGain, state: np.ndarray, command: np.ndarray, exact: np.ndarray, believed: np.ndarray
    ) -> PlanGain:
        """Return a plan's feedback in the coordinates of the plant that moves; without outputs the gain itself.

        Args:
            gain: in the states x, and of d = (C - C^) x.
            state: of the point, shape (nx,).
            command: there, shape (nu,).
            exact: parameters of the plant that moves, shape (np,).
            believed: those of the model.
        """
        if self.change is None or gain.outputs is None:
            return gain
        assert self.shown is not None
        start = gain.start
        at = state if start is None else start.state
        real, model = np.asarray(self.shown(state, exact).full()), np.asarray(self.shown(at, believed).full())
        moved = np.eye(len(state)) if start is None else start.by_state + start.by_outputs @ real
        change = np.asarray(self.change(state, exact).full())
        planned = np.linalg.solve(change.T, (gain.state @ moved + gain.outputs @ (real - model @ moved)).T).T
        if start is None:
            return PlanGain(planned, gain.before)
        here, by_input = (np.asarray(m.full())[: len(command)] for m in self.slopes(state, command, believed))
        besides = np.linalg.solve(change.T, (start.response @ moved - here).T).T
        return replace(gain, state=planned, response=besides, response_by_input=start.response_by_input - by_input)

    def slopes_on(self, state: np.ndarray, exact: np.ndarray) -> Slopes:
        """Return the function (state, input, parameters) -> A (n, nx), B (n, nu) in the coordinates of the plant that moves.

        Args:
            state: of the point, shape (nx,).
            exact: parameters of the plant that moves, shape (np,).
        """
        if self.change is None:
            return self.slopes
        change = np.asarray(self.change(state, exact).full())

        def slopes(x: np.ndarray, u: np.ndarray, p: np.ndarray) -> tuple[ca.DM, ca.DM]:
            a, b = self.slopes(x, u, p)
            return ca.DM(np.linalg.solve(change.T, np.asarray(a.full()).T).T), b

        return slopes


def straightened(problem: Problem) -> Straight:
    """Return the problem's plant as coordinates with relative orders."""
    return _straightened(problem.plant, tuple(map(float, problem.start_state)))


@lru_cache(maxsize=8)  # several questions of a review need it
def _straightened(plant: Plant, start: tuple[float, ...]) -> Straight:
    x, u, p = plant.symbols()
    if not plant.outputs:
        response = plant.response_function(x, u, p)
        return Straight(
            plant, ca.Function("fpirhc_slopes", [x, u, p], [ca.densify(ca.jacobian(response, v)) for v in (x, u)])
        )
    face, calm = plant.face, ca.SX.zeros(len(plant.names))
    chain = dict(zip(plant.output.elements, ca.vertsplit(plant.output_function(x, u, p, calm)), strict=True))
    orders = {name: face.orders[face.names.index(name)] for name in plant.controlled_names}
    shown = ca.vertcat(*(chain[name + "'" * k] for name, order in orders.items() for k in range(order)))
    slope = ca.Function("fpirhc_shown", [x, p], [ca.densify(ca.jacobian(shown, x))])
    hidden = null_space(np.asarray(slope(np.array(start), plant.exact).full()))
    inner = sorted(int(k) for k in qr(hidden.T, pivoting=True)[2][: hidden.shape[1]])
    names = [plant.state.elements[k] for k in inner]
    light = light_plant(
        plant,
        {
            **{n: plant.outputs[n].unit for n in orders},
            **{plant.state.elements[k]: plant.state.units[k] for k in inner},
        },
        {**orders, **dict.fromkeys(names, 1)},
        plant.controlled_names,
    )
    known = {**chain, **{name: x[k] for name, k in zip(names, inner, strict=True)}}
    z = ca.vertcat(*(known[e] for e in light.state.elements))
    rates = plant.derivative_function(x, u, p)[inner]
    responses = ca.vertcat(plant.controlled_response_function(x, u, p), rates)
    slopes = [ca.densify(ca.jacobian(responses, v)) for v in (x, u)]
    change = ca.Function("fpirhc_change", [x, p], [ca.densify(ca.jacobian(z, x))])
    everything = ca.vertcat(*chain.values())
    seen = ca.Function("fpirhc_all_shown", [x, p], [ca.densify(ca.jacobian(everything, x))])
    return Straight(light, ca.Function("fpirhc_slopes", [x, u, p], slopes), change, seen)
