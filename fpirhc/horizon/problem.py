"""The optimal control problem of one horizon in standard form: build here, solve elsewhere.

    minimise  V(U) = sum_{i<N} l(s_i, u_i, theta_i) + T(s_N, theta_N)
    where     s_{i+1} = F(s_i, u_i, theta_i),  s_0 given,  bounds on u_i and on s_1 ... s_N.

theta_i is what stage i is given: its time, the reference, the feedforward and the model's parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidName, InvalidProblem, InvalidValue, NotSupported
from fpirhc.horizon.cost import Cost, Linearisation, View
from fpirhc.integrate import Integrator, RungeKutta4
from fpirhc.limits import Limits
from fpirhc.plant import Plant
from fpirhc.reference import Reference
from fpirhc.symbolic.layout import Expression, Layout, Named, Signal, scalar


@dataclass(frozen=True)
class Horizon:
    """How far and in which steps a controller looks ahead.

    Parameters:
        stages: number of stages N. step: length of one stage, s, with the input held.
        discretisation: how the model moves over one stage (RungeKutta4(), Euler()).

    Raises:
        InvalidValue: fewer than one stage, or a step that is not positive.
    """

    stages: int
    step: float
    discretisation: Integrator = field(default_factory=RungeKutta4)

    def __post_init__(self) -> None:
        if not isinstance(self.stages, int) or self.stages < 1:
            raise InvalidValue(f"a horizon needs at least 1 stage, got {self.stages!r}")
        if not (math.isfinite(self.step) and self.step > 0):
            raise InvalidValue(f"the horizon step must be a positive number of seconds, got {self.step!r}")
        if self.discretisation.opaque:
            raise NotSupported("a horizon needs an integrator of plain expressions: RungeKutta4() or Euler()")


@dataclass(frozen=True, eq=False)
class OptimalControl:
    """The standard form; sizes: ns = state.size, nu = input.size, ntheta = data.size.

    dynamics: (s, u, theta) -> s_next. stage_cost: (s, u, theta) -> (l, terms). terminal_cost: (s, theta) -> T.
    Bounds are infinite where free; an optimiser may be given other input bounds from call to call.
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
    state_lower: np.ndarray
    state_upper: np.ndarray
    input_lower: np.ndarray
    input_upper: np.ndarray

    @property
    def bounds_states(self) -> bool:
        """Whether some state is bounded."""
        return bool(np.isfinite(self.state_lower).any() or np.isfinite(self.state_upper).any())


def data_layout(plant: Plant) -> Layout:
    """What one stage is given."""
    return Layout(
        (
            scalar("time", "s"),
            Signal("reference", plant.state.elements, plant.state.units),
            Signal("feedforward", plant.input.elements, plant.input.units),
            plant.parameter,
        )
    )


def transcribe(plant: Plant, reference: Reference, horizon: Horizon, cost: Cost, limits: Limits) -> OptimalControl:
    """Return the standard form of one horizon.

    Raises:
        InvalidProblem: mistakes in the cost, or a cost that is not finite at the reference (the term is named).
    """
    cost.check(plant)
    limits.check(plant)
    nx = plant.state.size
    state = _stage_state(plant, cost)
    s, u = ca.SX.sym("s", state.size), ca.SX.sym("u", plant.input.size)
    theta = ca.SX.sym("theta", data_layout(plant).size)
    view = _view(plant, s, u, theta)
    try:
        terms = {name: ca.SX(value) for name, value in cost.stage(view).items()}
        advance = _advance(plant, horizon)
        final = ca.SX(cost.terminal(view, plant, lambda: _linearise(plant, reference, horizon, advance), horizon.step))
    except InvalidName as error:
        raise InvalidProblem(f"cost: {error}") from None
    moved = advance(s[:nx], u, view.parameters.vector)
    following = ca.vertcat(moved, u) if state.size > nx else moved
    column = horizon.step * ca.vertcat(*terms.values())
    lower, upper = limits.state_bounds(plant)
    free = np.full(state.size - nx, np.inf)
    ocp = OptimalControl(
        stages=horizon.stages,
        step=horizon.step,
        state=state,
        input=plant.input,
        data=data_layout(plant),
        dynamics=ca.Function("fpirhc_dynamics", [s, u, theta], [ca.densify(following)]),
        stage_cost=ca.Function("fpirhc_stage_cost", [s, u, theta], [ca.sum1(column), ca.densify(column)]),
        terminal_cost=ca.Function("fpirhc_terminal_cost", [s, theta], [ca.densify(final)]),
        terms=tuple(terms),
        state_lower=np.append(lower, -free),
        state_upper=np.append(upper, free),
        input_lower=limits.input_bounds(plant)[0],
        input_upper=limits.input_bounds(plant)[1],
    )
    _check_finite(ocp, plant, reference, horizon, cost)
    return ocp


def stage_data(plant: Plant, reference: Reference, horizon: Horizon, cost: Cost) -> ca.Function:
    """Function (time, parameters) -> data of all stages, shape (ntheta, N + 1)."""
    kind: Any = ca.MX if reference.opaque or plant.inverse_opaque else ca.SX
    t, p = kind.sym("t"), kind.sym("p", plant.parameter.size)
    state, response = reference.function(plant)(t)
    if cost.uses_feedforward:
        needed = plant.inverse_function(state, response[list(plant.controlled_indices)], p)
    else:
        needed = kind.zeros(plant.input.size)
    one = ca.Function("fpirhc_stage_data", [t, p], [ca.densify(ca.vertcat(t, state, needed, p))])
    start, parameters = ca.MX.sym("t"), ca.MX.sym("p", plant.parameter.size)
    nodes = horizon.stages + 1
    times = start + ca.DM(np.arange(nodes) * horizon.step).T
    table = one.map(nodes)(times, ca.repmat(parameters, 1, nodes))
    return ca.Function("fpirhc_horizon_data", [start, parameters], [table], ["t", "p"], ["data"])


def _stage_state(plant: Plant, cost: Cost) -> Signal:
    if not cost.uses_rate:
        return plant.state
    before = tuple(f"{i} before" for i in plant.input.elements)
    return Signal("state", plant.state.elements + before, plant.state.units + plant.input.units)


def _view(plant: Plant, s: Expression, u: Expression, theta: Expression) -> View:
    given = data_layout(plant).split(theta)
    nx, inputs = plant.state.size, plant.input.elements
    before = s[nx:] if s.numel() > nx else ca.SX.nan(len(inputs))
    return View(
        state=Named(plant.state.elements, s[:nx], "state"),
        reference=Named(plant.state.elements, given["reference"], "state"),
        input=Named(inputs, u, "input"),
        input_before=Named(inputs, before, "input"),
        feedforward=Named(inputs, given["feedforward"], "input"),
        parameters=Named(plant.parameter.elements, given["parameters"], "parameter"),
        time=given["time"],
    )


def _advance(plant: Plant, horizon: Horizon) -> ca.Function:
    """Function (x, u, p) -> x after one stage by the undisturbed model."""
    step = horizon.discretisation.step(plant, horizon.step)
    x, u, p = plant._symbols()
    return ca.Function("fpirhc_advance", [x, u, p], [step(x, u, p, ca.SX.zeros(len(plant.names)))])


def _linearise(plant: Plant, reference: Reference, horizon: Horizon, advance: ca.Function) -> Linearisation:
    x, u, p = plant._symbols()
    following = advance(x, u, p)
    jacobians = ca.Function("fpirhc_linear", [x, u, p], [ca.jacobian(following, x), ca.jacobian(following, u)])
    state, response = reference.function(plant)(0.0)
    needed = plant.inverse_function(state, response[list(plant.controlled_indices)], plant.approximate)
    a, b = jacobians(state, needed, plant.approximate)
    return Linearisation(np.asarray(a.full()), np.asarray(b.full()), horizon.step)


def _check_finite(ocp: OptimalControl, plant: Plant, reference: Reference, horizon: Horizon, cost: Cost) -> None:
    table: Any = stage_data(plant, reference, horizon, cost)(0.0, plant.approximate)
    data = table[:, 0]
    given = ocp.data.split(data)
    both: Any = ca.vertcat(given["reference"], given["feedforward"])
    first = both[: ocp.state.size]
    _, terms = ocp.stage_cost(first, given["feedforward"], data)
    for name, value in zip(ocp.terms, terms.full().ravel(), strict=True):
        if not np.isfinite(value):
            hint = "; say General(rate=True) if it uses input_before" if ocp.state.size == plant.state.size else ""
            raise InvalidProblem(f"cost: term '{name}' is {value} on the reference at t = 0{hint}")
