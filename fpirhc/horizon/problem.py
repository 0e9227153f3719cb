"""The optimal control problem of one horizon in standard form: build here, solve elsewhere.

    minimise  V(U) = sum_{i<N} l(s_i, u_i, theta_i) + T(s_N, theta_N)
    where     s_{i+1} = F(s_i, u_i, theta_i),  s_0 given,  bounds on u_i and on s_1 ... s_N.

theta_i are the data of stage i: its time, the reference, the feedforward and the model's parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

import casadi as ca
import numpy as np

from fpirhc.horizon.live_data import SCALE, STEEPEST, Withheld
from fpirhc.horizon.reference_expansion import ReferenceExpansion, expand_along, input_curvature, steepest_curvature
from fpirhc.symbolic.layout import Layout, Signal
from fpirhc.symbolic.live import LiveNumber, Number


@dataclass(frozen=True, eq=False)
class OptimalControl:
    """The standard form; sizes: ns = state.size, nu = input.size, ntheta = data.size. Bounds are infinite where free.

    Args:
        stages: number of stages N.
        step: length of one stage, s.
        state: signal of s_i.
        input: signal of u_i.
        data: layout of theta_i.
        dynamics: (s, u, theta) -> s_next.
        stage_cost: (s, u, theta) -> (l, terms).
        terminal_cost: (s, theta) -> T.
        terms: names of the stage cost's terms.
        start: (x, u before) -> s_0, from the plant's state and the input of the stage before.
        state_lower: bounds of s_1 ... s_N, shape (ns,).
        state_upper: bounds of s_1 ... s_N, shape (ns,).
        input_lower: bounds of u_i, shape (nu,); a call of an optimiser may have others.
        input_upper: bounds of u_i, shape (nu,); a call of an optimiser may have others.
        curvature: second derivative of the cost rate along each input near the reference, shape (nu,); it converts gradients to the
            units of the inputs.
        nodes: states, inputs and data along the reference from t = 0.
        along: quadratic model of the cost along the reference.
        written: number of the last entries of the state, which are limits of rates, paths and the end; they are zero in s_0.
        state_price: cost of a violation of a state's bounds per unit and node, shape (ns,); infinite where they are hard.
        settings: paths of the live settings, whose numbers are among the data.
        live_bounds: paths of the live limits of inputs, which are arguments of a call.
        derive: function of the numbers of settings, by path, that returns the numbers that the cost computes from them.
        inner: of a plant with outputs, for every state its place in the reference, or -1 and a value of its own; else empty.
        runaway: function that returns the factors by which the stages along the reference make a motion grow that decays in the
            plant, shape (N,).
        functions: Functions that were built for it; problems that differ in numbers of settings only share them.
    """

    stages: int
    step: float
    state: Signal
    input: Signal
    data: Layout
    dynamics: ca.Function
    stage_cost: ca.Function
    terminal_cost: ca.Function
    terms: tuple[str, ...]
    start: ca.Function
    state_lower: np.ndarray
    state_upper: np.ndarray
    input_lower: np.ndarray
    input_upper: np.ndarray
    curvature: np.ndarray
    nodes: tuple[np.ndarray, np.ndarray, np.ndarray]
    along: ReferenceExpansion
    written: int
    state_price: np.ndarray
    settings: tuple[str, ...] = ()
    live_bounds: tuple[str, ...] = ()
    derive: Callable[[Mapping[str, float]], dict[str, float]] | None = None
    inner: tuple[tuple[int, float], ...] = ()
    runaway: Callable[[], np.ndarray] = lambda: np.ones(1)
    functions: dict[object, ca.Function] = field(default_factory=dict, repr=False)

    @property
    def scale(self) -> np.ndarray:
        """D = 1 / (step c), shape (nu,): it turns a gradient into a move of the inputs."""
        return 1 / (self.step * self.curvature)

    @cached_property
    def steepest(self) -> float:
        """Largest eigenvalue of D V'' along the reference, with a margin."""
        return steepest_curvature(self.along, self.scale)

    def scale_in(self, data: ca.MX | None) -> ca.MX:
        """D as an optimiser's expressions use it: numbers, or entries of the stages' data where settings are live.

        Raises:
            NotSupported: live settings, and the optimiser has no data at this place.
        """
        if not self.settings:
            return cast(ca.MX, ca.DM(self.scale))
        if data is None:
            Withheld(self.settings).refuse()
        return data[self.data.slice(SCALE), 0]

    def place_of(self, number: LiveNumber) -> int:
        """Return the place of a live setting in the data of every stage."""
        return self.data.slice("settings").start + self.settings.index(number.paths[0])

    def number_in(self, number: Number, data: ca.MX) -> ca.MX | float:
        """Return a number of an optimiser as its expressions use it: itself, or an entry of the stages' data where it is live."""
        return data[self.place_of(number), 0] if isinstance(number, LiveNumber) else float(number)

    @property
    def setting_numbers(self) -> dict[str, float]:
        """Numbers of the live settings by path, as they stand in the data along the reference."""
        if not self.settings:
            return {}
        return dict(zip(self.settings, map(float, self.nodes[2][self.data.slice("settings"), 0]), strict=True))

    def opened(self) -> OptimalControl:
        """Return the problem from which code is built: what follows from live settings or live limits has no number there."""
        paths = (*self.settings, *self.live_bounds)
        if not paths:
            return self
        nothing = cast(np.ndarray, Withheld(paths))
        changed = replace(self, input_lower=nothing, input_upper=nothing) if self.live_bounds else self
        if not self.settings:
            return changed
        nodes = cast(tuple[np.ndarray, np.ndarray, np.ndarray], nothing)
        return replace(changed, curvature=nothing, nodes=nodes, along=cast(ReferenceExpansion, nothing))

    def at(self, values: Mapping[str, float]) -> OptimalControl:
        """Return the same problem for other numbers of its settings, by path: the expansion along the reference follows them.

        The bounds of inputs stay as they are: a call of an optimiser has its own.
        """
        if not self.settings:
            return self
        if self.derive is not None:
            values = {**values, **self.derive(values)}
        states, inputs, table = self.nodes
        numbers = np.array([values[path] for path in self.settings])
        table = table.copy()
        table[self.data.slice("settings")] = numbers[:, None]
        nodes = states, inputs, table
        along = expand_along(self.dynamics, self.stage_cost, self.terminal_cost, nodes, self.functions)
        changed = replace(self, nodes=nodes, along=along, curvature=input_curvature(along, self.step))
        table[self.data.slice(SCALE)], table[self.data.slice(STEEPEST)] = changed.scale[:, None], changed.steepest
        return changed

    @property
    def hard(self) -> np.ndarray:
        """Which states have bounds without a price (ns,)."""
        return np.isinf(self.state_price)

    @property
    def time_unit(self) -> str:
        """Unit of time."""
        return self.data["time"].entry_units[0]

    @property
    def bounds_states(self) -> bool:
        """Whether some state is bounded."""
        return bool(np.isfinite(self.state_lower).any() or np.isfinite(self.state_upper).any())
