"""The optimal control problem of one horizon in standard form: build here, solve elsewhere.

    minimise  V(U) = sum_{i<N} l(s_i, u_i, theta_i) + T(s_N, theta_N)
    where     s_{i+1} = F(s_i, u_i, theta_i),  s_0 given,  bounds on u_i and on s_1 ... s_N.

theta_i is what stage i is given: its time, the reference, the feedforward and the model's parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidName, InvalidProblem, InvalidValue, Mistakes, NotSupported
from fpirhc.horizon.cost import Cost, Linearisation, View
from fpirhc.horizon.curvature import Along, expand_along, input_curvature
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
    Bounds are infinite where free; an optimiser may be given other input bounds from call to call. `curvature` (nu) is the second
    derivative of the cost rate along each input near the reference: it turns gradients into the units of the inputs. `nodes` are
    the states, inputs and data along the reference from t = 0, `along` the quadratic model of the cost there.
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
    curvature: np.ndarray
    nodes: tuple[np.ndarray, np.ndarray, np.ndarray]
    along: Along

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
    view = _view(plant, s, u, theta, cost)
    try:
        terms = _scalar_terms(cost.stage(view))
        advance = _advance(plant, horizon)
        given = cost.terminal(view, plant, lambda: _linearise(plant, reference, horizon, advance), horizon.step)
        final = _scalar_terms({"terminal": given})["terminal"]
    except InvalidName as error:
        raise InvalidProblem(f"cost: {error}") from None
    moved = advance(s[:nx], u, view.parameters.vector)
    following = ca.vertcat(moved, u) if state.size > nx else moved
    stacked: Any = ca.vertcat(*terms.values())
    column = horizon.step * stacked
    lower, upper = limits.state_bounds(plant)
    free = np.full(state.size - nx, np.inf)
    dynamics = ca.Function("fpirhc_dynamics", [s, u, theta], [ca.densify(following)])
    stage_cost = ca.Function("fpirhc_stage_cost", [s, u, theta], [ca.sum1(column), ca.densify(column)])
    terminal_cost = ca.Function("fpirhc_terminal_cost", [s, theta], [ca.densify(final)])
    nodes = _nodes(plant, reference, horizon, cost, state.size)
    _check_finite(tuple(terms), stage_cost, terminal_cost, nodes, cost)
    along = expand_along(dynamics, stage_cost, terminal_cost, nodes)
    return OptimalControl(
        stages=horizon.stages,
        step=horizon.step,
        state=state,
        input=plant.input,
        data=data_layout(plant),
        dynamics=dynamics,
        stage_cost=stage_cost,
        terminal_cost=terminal_cost,
        terms=tuple(terms),
        state_lower=np.append(lower, -free),
        state_upper=np.append(upper, free),
        input_lower=limits.input_bounds(plant)[0],
        input_upper=limits.input_bounds(plant)[1],
        curvature=input_curvature(along, horizon.step),
        nodes=nodes,
        along=along,
    )


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


def _view(plant: Plant, s: Expression, u: Expression, theta: Expression, cost: Cost) -> View:
    given = data_layout(plant).split(theta)
    nx, inputs = plant.state.size, plant.input.elements
    # What the cost does not ask for is NaN, so that using it anyway is found at once.
    before = s[nx:] if cost.uses_rate else ca.SX.nan(len(inputs))
    feedforward = given["feedforward"] if cost.uses_feedforward else ca.SX.nan(len(inputs))
    return View(
        state=Named(plant.state.elements, s[:nx], "state"),
        reference=Named(plant.state.elements, given["reference"], "state"),
        input=Named(inputs, u, "input"),
        input_before=Named(inputs, before, "input"),
        feedforward=Named(inputs, feedforward, "input"),
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


def _scalar_terms(given: Any) -> dict[str, Expression]:
    """Terms as scalar expressions, or all that is wrong with them."""
    mistakes = Mistakes("cost")
    if not isinstance(given, Mapping) or not given:
        mistakes.add(f"the terms must be {{name: expression}} with at least one entry, got {given!r}")
        mistakes.raise_if_any()
    terms = {str(name): ca.SX(value) for name, value in given.items()}
    for name, value in terms.items():
        if value.numel() != 1:
            mistakes.add(f"term '{name}' must be one scalar, got shape {value.shape}; sum its entries with ca.sum1")
    mistakes.raise_if_any()
    return terms


def _nodes(
    plant: Plant, reference: Reference, horizon: Horizon, cost: Cost, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (of this size), inputs and data along the reference from t = 0."""
    table: Any = stage_data(plant, reference, horizon, cost)(0.0, plant.approximate)
    data = np.asarray(table.full())
    given = {
        name: data[place] for name, place in ((n, data_layout(plant).slice(n)) for n in ("reference", "feedforward"))
    }
    states = np.vstack([given["reference"], given["feedforward"]])[:size]
    return states, given["feedforward"][:, : horizon.stages], data


def _check_finite(
    names: tuple[str, ...],
    stage_cost: ca.Function,
    terminal_cost: ca.Function,
    nodes: tuple[np.ndarray, np.ndarray, np.ndarray],
    cost: Cost,
) -> None:
    states, inputs, data = nodes
    values = stage_cost(states[:, 0], inputs[:, 0], data[:, 0])[1].full().ravel()
    final = float(terminal_cost(states[:, -1], data[:, -1]))
    told = [(name, value, "at t = 0") for name, value in zip(names, values, strict=True)]
    mistakes = Mistakes("cost")
    for name, value, where in [*told, ("terminal", final, "at the end of the horizon")]:
        if not np.isfinite(value):
            hint = "" if cost.uses_rate else "; say General(rate=True) if it uses input_before"
            hint += "" if cost.uses_feedforward else "; say General(feedforward=True) if it uses feedforward"
            mistakes.add(f"term '{name}' is {value} on the reference {where}{hint}")
    mistakes.raise_if_any()
