"""The optimal control problem of one horizon in standard form: build here, solve elsewhere.

    minimise  V(U) = sum_{i<N} l(s_i, u_i, theta_i) + T(s_N, theta_N)
    where     s_{i+1} = F(s_i, u_i, theta_i),  s_0 given,  bounds on u_i and on s_1 ... s_N.

theta_i are the data of stage i: its time, the reference, the feedforward and the model's parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

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
from fpirhc.horizon.live_data import SCALE, STEEPEST, Withheld, live_signals, live_table, settings_in
from fpirhc.horizon.reference_expansion import ReferenceExpansion, expand_along, input_curvature, steepest_curvature
from fpirhc.plant.integrators import Integrator, RungeKutta4
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import kind
from fpirhc.symbolic.layout import Expression, Layout, Named, Signal, scalar
from fpirhc.symbolic.live import PREFIX, live_numbers, nominal, settled
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
        settings: paths of the live settings, whose numbers are among the data.
        live_bounds: paths of the live limits of inputs, which are arguments of a call.
        derive: function of the numbers of settings, by path, that returns the numbers that the cost computes from them.
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
    nominal(cost).check(plant)
    limits.check(plant)
    _check_names(plant, horizon, limits)
    stage = _stage_expressions(plant, reference, horizon, cost, limits)
    binding, free = stage.binding, stage.before.numel()
    dynamics, stage_cost, terminal_cost = _stage_functions(stage, horizon.step)
    nodes = _nodes(plant, reference, horizon, cost, (free, len(binding)))
    settings = tuple(s.name().removeprefix(PREFIX) for s in stage.settings)
    values = {path: number.value for path, number in live_numbers(cost, limits).items()}

    def derive(numbers: Mapping[str, float]) -> dict[str, float]:
        advance = _advance(plant, horizon)
        return settled(cost, numbers).derived(plant, lambda: _linearise(plant, reference, horizon, advance))

    values |= derive(values) if settings else {}
    if settings:
        # The scale and the largest eigenvalue follow from the expansion; until `at` they are ones.
        ones, numbers = np.ones(plant.input.size), np.array([values[path] for path in settings])
        nodes = (*nodes[:2], live_table(nodes[2], numbers, ones, 1.0))
    _check_finite(tuple(stage.terms), stage_cost, terminal_cost, nodes, cost)
    functions: dict[object, ca.Function] = {}
    along = expand_along(dynamics, stage_cost, terminal_cost, nodes, functions)
    lower, upper = hard_state_bounds(limits, plant, horizon.margins)
    state = _stage_state(plant, bool(free), binding)
    ocp = OptimalControl(
        stages=horizon.stages,
        step=horizon.step,
        state=state,
        input=plant.input,
        data=data_layout(plant, horizon) + live_signals(settings, plant.input),
        dynamics=dynamics,
        stage_cost=stage_cost,
        terminal_cost=terminal_cost,
        terms=tuple(stage.terms),
        start=_start(plant, free, len(binding)),
        state_lower=np.concatenate([lower, np.full(free, -np.inf), [w.lower for w in binding]]),
        state_upper=np.concatenate([upper, np.full(free, np.inf), [w.upper for w in binding]]),
        input_lower=nominal(limits).input_bounds(plant)[0],
        input_upper=nominal(limits).input_bounds(plant)[1],
        curvature=input_curvature(along, horizon.step),
        nodes=nodes,
        along=along,
        written=len(binding),
        state_price=state_prices(limits, state, plant, horizon.step),
        settings=settings,
        live_bounds=tuple(live_numbers(limits.inputs)),
        derive=derive,
        functions=functions,
    )
    return ocp.at(values)


def stage_data(plant: Plant, reference: Reference, horizon: Horizon, cost: Cost, live: int = 0) -> ca.Function:
    """Function (time, parameters) -> data of all stages, shape (ntheta, N + 1).

    With `live` rows of settings and what follows from them, (time, parameters, these rows) -> data that end with them.
    """
    matrix = kind(reference.opaque or plant.inverse_opaque)
    t, p = matrix.sym("t"), matrix.sym("p", plant.parameter.size)
    state, response = reference.function(plant)(t)
    if cost.uses_feedforward:
        needed = plant.inverse_function(state, response[list(plant.controlled_indices)], p)
    else:
        needed = matrix.zeros(plant.input.size)
    # The live rows come out of the same call where they follow these rows: joining tables would copy both.
    joined = bool(live) and not (horizon.blocks or horizon.terminal or horizon.margins)
    rows = [matrix.sym("live", live)] if joined else []
    one = ca.Function("fpirhc_stage_data", [t, p, *rows], [ca.densify(ca.vertcat(t, state, needed, p, *rows))])
    start, parameters = ca.MX.sym("t"), ca.MX.sym("p", plant.parameter.size)
    settings = [ca.MX.sym("live", live)] if live else []
    nodes = horizon.stages + 1
    times = start + ca.DM(np.arange(nodes) * horizon.step).T
    repeated = [ca.repmat(v, 1, nodes) for v in (parameters, *(settings if joined else ()))]
    table = one.map(nodes)(times, *repeated)
    if horizon.blocks:
        free = np.zeros((1, nodes))
        free[0, [0, *np.cumsum(horizon.blocks)]] = 1.0
        table = ca.vertcat(table, free)
    if horizon.margins:
        margins = np.array([[*horizon.margins[e], 0.0] for e in horizon.margins], dtype=float)
        table = ca.vertcat(table, margins)
    if horizon.terminal:
        last, after = np.zeros((1, nodes)), [*range(1, nodes), nodes - 1]
        last[0, nodes - 2] = 1.0
        targets = table[data_layout(plant, horizon).slice("reference"), :][:, after]
        table = ca.vertcat(table, last, targets)
    if live and not joined:
        table = ca.vertcat(table, ca.repmat(settings[0], 1, nodes))
    names = ["t", "p", *(["live"] if live else [])]
    return ca.Function("fpirhc_horizon_data", [start, parameters, *settings], [table], names, ["data"])


@dataclass(frozen=True, eq=False)
class _Stage:
    """Symbols x, before, u, theta of one stage, and its expressions; `before` is empty unless the input is part of the state.

    theta ends with the symbols of live `settings` and of what follows from them (see `live_data`).
    """

    x: Expression
    before: Expression
    u: Expression
    applied: Expression
    theta: Expression
    x_next: Expression
    terms: dict[str, Expression]
    final: Expression
    binding: list[ConstraintState]
    settings: list[ca.SX]


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
    binding = hard(written, soft_names(limits, plant))
    settings = settings_in([x_next, *terms.values(), final, *(w.expression for w in binding)], theta)
    if settings:
        live = live_signals(tuple(s.name() for s in settings), plant.input)
        theta = ca.vertcat(theta, *settings, ca.SX.sym("live", live.size - len(settings)))
    return _Stage(x, before, u, applied, theta, x_next, terms, final, binding, settings)


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
