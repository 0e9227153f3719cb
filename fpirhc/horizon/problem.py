"""The optimal control problem of one horizon in standard form: build here, solve elsewhere.

    minimise  V(U) = sum_{i<N} l(s_i, u_i, theta_i) + T(s_N, theta_N)
    where     s_{i+1} = F(s_i, u_i, theta_i),  s_0 given,  bounds on u_i and on s_1 ... s_N.

theta_i are the data of stage i: its time, the reference, the feedforward and the model's parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidName, InvalidProblem, InvalidValue, Mistakes, NotSupported
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Count, Duration
from fpirhc.fields.user_code import scalar_expression
from fpirhc.horizon.constraint_states import (
    ConstraintState,
    ends,
    hard,
    hard_state_bounds,
    narrowed,
    paths,
    rates,
    soft_names,
    softened,
    state_prices,
)
from fpirhc.horizon.cost import Cost, Linearisation, View
from fpirhc.horizon.reference_expansion import ReferenceExpansion, expand_along, input_curvature
from fpirhc.plant.integrators import Integrator, RungeKutta4
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import kind
from fpirhc.symbolic.layout import Expression, Layout, Named, Signal, scalar
from fpirhc.task.limits import Limits
from fpirhc.task.reference import Reference


@dataclass(frozen=True)
class Horizon(Checked):
    """Length and stages of a controller's prediction.

    Args:
        stages: number of stages N.
        step: length of one stage, s, over which the input is constant.
        discretisation: integrator of the model over one stage: RungeKutta4(), Euler(), ImplicitMidpoint(), RadauIIA().
        terminal: names of states that must meet the reference at the end of the horizon.
        blocks: lengths of blocks of stages over which the inputs are held (move blocking); they add up to the stages. Empty: every
            stage has inputs of its own.
        margins: by name of a state, the distances by which a plan stays inside the state's limits after stages 1 ... N, in the
            state's unit: room for what the model does not predict (`tightened` computes them). The problem's limits stay as they
            are for the run and its metrics.

    Raises:
        InvalidValue: fewer than one stage, a step that is not positive, blocks that do not add up, or margins that are not one
            finite number of at least 0 for every stage.
        NotSupported: an integrator that is not made of plain expressions.
    """

    stages: Count
    step: Duration
    discretisation: Integrator = field(default_factory=RungeKutta4)
    terminal: tuple[str, ...] = ()
    blocks: tuple[int, ...] = ()
    margins: Mapping[str, Sequence[float]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if self.blocks and (sum(self.blocks) != self.stages or min(self.blocks) < 1):
            raise InvalidValue(
                f"horizon: blocks {self.blocks} add up to {sum(self.blocks)}, expected {self.stages} stages"
            )
        for name, margin in self.margins.items():
            if len(margin) != self.stages or not all(0 <= m < math.inf for m in margin):
                raise InvalidValue(
                    f"horizon: margins of '{name}' must be {self.stages} finite numbers of at least 0, one for every stage, got "
                    f"{margin!r}"
                )
        if self.discretisation.opaque:
            raise NotSupported(
                "a horizon needs an integrator of plain expressions, such as RungeKutta4() or RadauIIA()"
            )


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


def data_layout(plant: Plant, horizon: Horizon) -> Layout:
    """Layout of one stage's data.

    A terminal equality adds whether the stage is the last, and the reference after it; blocks add whether the inputs are free.
    """
    free = (scalar("free"),) if horizon.blocks else ()
    units = dict(zip(plant.state.elements, plant.state.units, strict=True))
    names = tuple(horizon.margins)
    margin = (Signal("margin", names, tuple(units[e] for e in names)),) if names else ()
    signals = (
        plant.time,
        Signal("reference", plant.state.elements, plant.state.units),
        Signal("feedforward", plant.input.elements, plant.input.units),
        plant.parameter,
        *free,
        *margin,
    )
    if not horizon.terminal:
        return Layout(signals)
    return Layout((*signals, scalar("last"), Signal("target", plant.state.elements, plant.state.units)))


def transcribe(plant: Plant, reference: Reference, horizon: Horizon, cost: Cost, limits: Limits) -> OptimalControl:
    """Return the standard form of one horizon.

    Raises:
        InvalidProblem: mistakes in the cost or the limits, or a cost that is not finite at the reference (the term is named).
    """
    cost.check(plant)
    limits.check(plant)
    _check_names(plant, horizon, limits)
    stage = _stage_expressions(plant, reference, horizon, cost, limits)
    binding, free = stage.binding, stage.before.numel()
    dynamics, stage_cost, terminal_cost = _stage_functions(stage, horizon.step)
    nodes = _nodes(plant, reference, horizon, cost, (free, len(binding)))
    _check_finite(tuple(stage.terms), stage_cost, terminal_cost, nodes, cost)
    along = expand_along(dynamics, stage_cost, terminal_cost, nodes)
    lower, upper = hard_state_bounds(limits, plant, horizon.margins)
    state = _stage_state(plant, bool(free), binding)
    return OptimalControl(
        stages=horizon.stages,
        step=horizon.step,
        state=state,
        input=plant.input,
        data=data_layout(plant, horizon),
        dynamics=dynamics,
        stage_cost=stage_cost,
        terminal_cost=terminal_cost,
        terms=tuple(stage.terms),
        start=_start(plant, free, len(binding)),
        state_lower=np.concatenate([lower, np.full(free, -np.inf), [w.lower for w in binding]]),
        state_upper=np.concatenate([upper, np.full(free, np.inf), [w.upper for w in binding]]),
        input_lower=limits.input_bounds(plant)[0],
        input_upper=limits.input_bounds(plant)[1],
        curvature=input_curvature(along, horizon.step),
        nodes=nodes,
        along=along,
        written=len(binding),
        state_price=state_prices(limits, state, plant, horizon.step),
    )


def stage_data(plant: Plant, reference: Reference, horizon: Horizon, cost: Cost) -> ca.Function:
    """Function (time, parameters) -> data of all stages, shape (ntheta, N + 1)."""
    matrix = kind(reference.opaque or plant.inverse_opaque)
    t, p = matrix.sym("t"), matrix.sym("p", plant.parameter.size)
    state, response = reference.function(plant)(t)
    if cost.uses_feedforward:
        needed = plant.inverse_function(state, response[list(plant.controlled_indices)], p)
    else:
        needed = matrix.zeros(plant.input.size)
    one = ca.Function("fpirhc_stage_data", [t, p], [ca.densify(ca.vertcat(t, state, needed, p))])
    start, parameters = ca.MX.sym("t"), ca.MX.sym("p", plant.parameter.size)
    nodes = horizon.stages + 1
    times = start + ca.DM(np.arange(nodes) * horizon.step).T
    table = one.map(nodes)(times, ca.repmat(parameters, 1, nodes))
    if horizon.blocks:
        free = np.zeros((1, nodes))
        free[0, [0, *np.cumsum(horizon.blocks)]] = 1.0
        table = ca.vertcat(table, free)
    if horizon.margins:
        rows = np.array([[*horizon.margins[e], 0.0] for e in horizon.margins], dtype=float)
        table = ca.vertcat(table, rows)
    if horizon.terminal:
        last, after = np.zeros((1, nodes)), [*range(1, nodes), nodes - 1]
        last[0, nodes - 2] = 1.0
        targets = table[data_layout(plant, horizon).slice("reference"), :][:, after]
        table = ca.vertcat(table, last, targets)
    return ca.Function("fpirhc_horizon_data", [start, parameters], [table], ["t", "p"], ["data"])


@dataclass(frozen=True, eq=False)
class _Stage:
    """Symbols x, before, u, theta of one stage, and its expressions; `before` is empty unless the input is part of the state."""

    x: Expression
    before: Expression
    u: Expression
    applied: Expression
    theta: Expression
    x_next: Expression
    terms: dict[str, Expression]
    final: Expression
    binding: list[ConstraintState]


def _stage_expressions(plant: Plant, reference: Reference, horizon: Horizon, cost: Cost, limits: Limits) -> _Stage:
    layout = data_layout(plant, horizon)
    keeps_input = cost.uses_rate or bool(limits.rates) or bool(horizon.blocks)
    x, before = ca.SX.sym("x", plant.state.size), ca.SX.sym("before", plant.input.size * keeps_input)
    u, theta = ca.SX.sym("u", plant.input.size), ca.SX.sym("theta", layout.size)
    data = layout.split(theta)
    applied = data["free"] * u + (1 - data["free"]) * before if horizon.blocks else u
    view = _view(plant, ca.vertcat(x, before), applied, data, cost, keeps_input)
    try:
        advance = _advance(plant, horizon)
        x_next = advance(x, applied, view.parameters.vector)
        written = _written(plant, horizon, limits, view, x_next, data)
        soft = softened(written, limits, plant, x)
        terms = {**_scalar_terms(cost.stage(view)), **soft}
        if horizon.blocks:
            # Inputs that have no effect are drawn to those that are held, so that a plan states what is applied.
            terms["held"] = (1 - data["free"]) * ca.sumsqr((u - before) / _reach(limits, plant))
        terminal = cost.terminal_cost(view, plant, lambda: _linearise(plant, reference, horizon, advance), horizon.step)
        end = sum((soft[f"soft {e}"] for e in limits.soft if e in limits.states), start=ca.SX(0))
        final = _scalar_terms({"terminal": terminal})["terminal"] + horizon.step * end
    except InvalidName as error:
        raise InvalidProblem(f"cost: {error}") from None
    return _Stage(x, before, u, applied, theta, x_next, terms, final, hard(written, soft_names(limits, plant)))


def _stage_functions(stage: _Stage, step: float) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Functions of the dynamics, the stage cost and the terminal cost."""
    u, theta, binding = stage.u, stage.theta, stage.binding
    s = ca.vertcat(stage.x, stage.before, ca.SX.sym("z", len(binding)))
    s_next = ca.vertcat(
        stage.x_next, *([stage.applied] if stage.before.numel() else []), *(w.expression for w in binding)
    )
    costs = step * ca.vertcat(*stage.terms.values())
    return (
        ca.Function("fpirhc_dynamics", [s, u, theta], [ca.densify(s_next)]),
        ca.Function("fpirhc_stage_cost", [s, u, theta], [ca.sum1(costs), ca.densify(costs)]),
        ca.Function("fpirhc_terminal_cost", [s, theta], [ca.densify(stage.final)]),
    )


def _reach(limits: Limits, plant: Plant) -> ca.DM:
    """Half the range of every input, 1 where it is free."""
    lower, upper = limits.input_bounds(plant)
    half = 0.5 * (upper - lower)
    return ca.DM(np.where(np.isfinite(half) & (half > 0), half, 1.0))


def _check_names(plant: Plant, horizon: Horizon, limits: Limits) -> None:
    mistakes = Mistakes("horizon")
    mistakes.unknown("terminal: state", horizon.terminal, plant.state.elements)
    mistakes.unknown("margins: limit of state", horizon.margins, list(limits.states))
    for name in horizon.margins.keys() & limits.states.keys():
        lower, upper = limits.states[name]
        if 2 * max(horizon.margins[name]) >= upper - lower:
            mistakes.add(
                f"margins of '{name}' reach {max(horizon.margins[name]):.6g}, which leaves nothing between its limits "
                f"{lower:g} and {upper:g}; widen the limits, or adapt faster"
            )
    mistakes.raise_if_any()


def _stage_state(plant: Plant, keeps_input: bool, binding: list[ConstraintState]) -> Signal:
    before = tuple(f"{i} before" for i in plant.input.elements) if keeps_input else ()
    units = plant.input.units if keeps_input else ()
    return Signal(
        "state",
        plant.state.elements + before + tuple(w.name for w in binding),
        plant.state.units + units + tuple(w.unit for w in binding),
    )


def _start(plant: Plant, free: int, written: int) -> ca.Function:
    x, u = ca.SX.sym("x", plant.state.size), ca.SX.sym("u", plant.input.size)
    first = ca.vertcat(x, *([u] if free else []), ca.SX.zeros(written))
    return ca.Function("fpirhc_stage_start", [x, u], [ca.densify(first)], ["x", "u"], ["s0"])


def _written(
    plant: Plant, horizon: Horizon, limits: Limits, view: View, x_next: Expression, data: Mapping[str, Expression]
) -> list[ConstraintState]:
    entries = [*rates(limits, plant, view, horizon.step), *paths(limits, view)]
    for entry in entries:
        if ca.SX(entry.expression).numel() != 1:
            raise InvalidProblem(f"limits: path '{entry.name}' must be one scalar, got {entry.expression.shape}")
    if horizon.margins:
        margin = dict(zip(horizon.margins, ca.vertsplit(data["margin"]), strict=True))
        entries += narrowed(limits, plant, x_next, margin)
    if horizon.terminal:
        entries += ends(horizon.terminal, plant, x_next, data["target"], data["last"])
    return entries


def _view(
    plant: Plant, s: Expression, u: Expression, data: Mapping[str, Expression], cost: Cost, keeps_input: bool
) -> View:
    nx, inputs = plant.state.size, plant.input.elements
    # What the cost does not declare is NaN, so that an undeclared use shows at once.
    before = s[nx:] if keeps_input else ca.SX.nan(len(inputs))
    feedforward = data["feedforward"] if cost.uses_feedforward else ca.SX.nan(len(inputs))
    return View(
        state=Named(plant.state.elements, s[:nx], "state"),
        reference=Named(plant.state.elements, data["reference"], "state"),
        input=Named(inputs, u, "input"),
        input_before=Named(inputs, before, "input"),
        feedforward=Named(inputs, feedforward, "input"),
        parameters=Named(plant.parameter.elements, data["parameters"], "parameter"),
        time=data["time"],
    )


def _advance(plant: Plant, horizon: Horizon) -> ca.Function:
    """Function (x, u, p) -> x after one stage by the undisturbed model."""
    step = horizon.discretisation.step(plant, horizon.step)
    x, u, p = plant.symbols()
    return ca.Function("fpirhc_advance", [x, u, p], [step(x, u, p, ca.SX.zeros(len(plant.names)))])


def _linearise(plant: Plant, reference: Reference, horizon: Horizon, advance: ca.Function) -> Linearisation:
    x, u, p = plant.symbols()
    x_next = advance(x, u, p)
    jacobians = ca.Function("fpirhc_linear", [x, u, p], [ca.jacobian(x_next, x), ca.jacobian(x_next, u)])
    state, response = reference.function(plant)(0.0)
    needed = plant.inverse_function(state, response[list(plant.controlled_indices)], plant.approximate)
    a, b = jacobians(state, needed, plant.approximate)
    return Linearisation(np.asarray(a.full()), np.asarray(b.full()), horizon.step)


def _scalar_terms(expressions: Mapping[str, Expression]) -> dict[str, Expression]:
    """Terms as scalar expressions.

    Raises:
        InvalidProblem: all mistakes together.
    """
    mistakes = Mistakes("cost")
    if not isinstance(expressions, Mapping) or not expressions:
        mistakes.add(f"the terms must be {{name: expression}} with at least one entry, got {expressions!r}")
        mistakes.raise_if_any()
    terms = {}
    for name, value in expressions.items():
        try:
            terms[str(name)] = scalar_expression(f"term '{name}'", value, finite=False)
        except InvalidProblem as error:
            mistakes.add(f"{error}{'; sum its entries with ca.sum1' if 'shape' in str(error) else ''}")
    mistakes.raise_if_any()
    return terms


def _nodes(
    plant: Plant, reference: Reference, horizon: Horizon, cost: Cost, extra: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (the plant's, `extra` input and written entries), inputs and data along the reference from t = 0."""
    table = stage_data(plant, reference, horizon, cost)(0.0, plant.approximate)
    data = np.asarray(table.full())
    layout = data_layout(plant, horizon)
    along = {name: data[layout.slice(name)] for name in ("reference", "feedforward")}
    states = np.vstack([along["reference"], along["feedforward"][: extra[0]], np.zeros((extra[1], data.shape[1]))])
    return states, along["feedforward"][:, : horizon.stages], data


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
    terms = [(name, value, "at t = 0") for name, value in zip(names, values, strict=True)]
    mistakes = Mistakes("cost")
    for name, value, where in [*terms, ("terminal", final, "at the end of the horizon")]:
        if not np.isfinite(value):
            hint = "" if cost.uses_rate else "; say CustomCost(rate=True) if it uses input_before"
            hint += "" if cost.uses_feedforward else "; say CustomCost(feedforward=True) if it uses feedforward"
            mistakes.add(f"term '{name}' is {value} on the reference {where}{hint}")
    mistakes.raise_if_any()
