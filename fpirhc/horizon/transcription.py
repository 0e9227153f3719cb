"""From plant, reference, horizon, cost and limits to the optimal control problem in standard form.

Each limit of a rate or of a path adds an entry z to the stage's state, z_{i+1} = c(s_i, u_i, theta_i), with bounds. So every
optimiser that keeps bounds of states keeps these limits too, and they are verified and named like states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidName, InvalidProblem, Mistakes
from fpirhc.fields.user_code import place_of, scalar_expression
from fpirhc.horizon.cost import Cost, Horizon, Linearisation, View, outputs_of, reads_feedforward, view_of
from fpirhc.horizon.nominal import data_layout, hastened, nominal_motion, reference_state, stage_data
from fpirhc.horizon.problem import OptimalControl, expand_along, input_curvature
from fpirhc.plant.chain import nominal_responses
from fpirhc.plant.integrators import spurious_growth
from fpirhc.plant.maps import by_single_steps, steps_in
from fpirhc.plant.motion import sampling
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.symbolic.open import numbers, open_in
from fpirhc.task.limits import Limits, PathConstraint
from fpirhc.task.reference import Reference

# a comparison goes through its controllers, and asks for the first one again
_LATEST: Latest[OptimalControl] = Latest(16)


def transcribe(
    plant: Plant,
    reference: Reference,
    horizon: Horizon,
    cost: Cost,
    limits: Limits,
    signals: ca.Function | None = None,
    start: np.ndarray | None = None,
) -> OptimalControl:
    """Return the standard form of one horizon, one for the same objects; from `start` states without a reference are simulated."""
    same = plant.equations, reference, cost, limits, signals  # the approximate parameters are those of the equations
    first = None if start is None else np.asarray(start, dtype=float).tobytes()
    arguments = plant, reference, horizon, cost, limits, signals, start
    return _LATEST.of(same, (first, horizon), lambda: _transcribed(*arguments))


def _transcribed(
    plant: Plant,
    reference: Reference,
    horizon: Horizon,
    cost: Cost,
    limits: Limits,
    signals: ca.Function | None,
    start: np.ndarray | None,
) -> OptimalControl:
    check_names(horizon, limits)
    whole = limits
    if horizon.margins:
        inside_by = {
            name: (limits.states[name][0] + m, limits.states[name][1] - m) for name, m in horizon.margins.items()
        }
        limits = replace(limits, states={**limits.states, **inside_by})
    same = plant.equations, reference, cost, whole
    stage = _STAGES.of(same, (horizon,), lambda: _stage(plant, reference, horizon, cost, limits))
    binding, free = stage.binding, stage.before
    rows = (Signal("settings", tuple(one.name() for one in stage.settings)),) if stage.settings else ()

    def data_of(*, previewed: bool = False) -> Callable[..., Any]:
        function = stage_data(plant, reference, horizon, cost, signals, previewed=previewed)
        return _with_rows(function, stage.settings) if rows else function

    table = np.asarray(data_of()(0.0, plant.approximate).full())
    nodes = _nodes(plant, reference, horizon, table, (free, len(binding)), limits, start)
    bounds, (low, high) = limits.input_bounds(plant), limits.input_ends(plant)
    _check_finite_limits(stage, nodes)
    _check_finite(plant, stage, nodes)
    functions: dict[object, ca.Function] = {}
    along = expand_along(stage.dynamics, stage.cost, stage.terminal_cost, nodes, functions)
    lower, upper = limits.state_bounds(plant)
    elsewhere = [e in horizon.measured for e in plant.state.elements]  # in entries of their own
    lower, upper = np.where(elsewhere, -np.inf, lower), np.where(elsewhere, np.inf, upper)
    state = _stage_state(plant, bool(free), binding)
    return OptimalControl(
        stages=horizon.stages,
        step=horizon.step,
        state=state,
        input=plant.input,
        data=data_layout(plant, horizon) + Layout(rows),
        data_of=data_of,
        dynamics=stage.dynamics,
        stage_cost=stage.cost,
        terminal_cost=stage.terminal_cost,
        terms=stage.terms,
        start=_start(plant, free, len(binding)),
        state_lower=np.concatenate([lower, np.full(free, -np.inf), [w.lower for w in binding]]),
        state_upper=np.concatenate([upper, np.full(free, np.inf), [w.upper for w in binding]]),
        input_lower=bounds[0],
        input_upper=bounds[1],
        ends=lambda below, above: (numbers(low, below) - below, numbers(high, above) - above),
        curvature=input_curvature(along, horizon.step),
        nodes=nodes,
        along=along,
        written=len(binding),
        state_price=state_prices(limits, state, plant, horizon.step),
        state_of=lambda outputs: plant.equations.state_of(outputs, ca.SX(nodes[0][:, -1])),
        runaway=lambda: spurious_growth(
            plant,
            horizon.discretisation,
            horizon.longest,
            nodes[0][: plant.state.size, :-1],
            nodes[1],
            plant.approximate,
        ),
        node_times=horizon.nodes,
        shares=horizon.share / horizon.relative_lengths,
        functions=functions,
    )


def _with_rows(function: ca.Function, settings: tuple[ca.SX, ...]) -> Callable[..., Any]:
    """Function of the same arguments -> data that end with rows of the open numbers; of numbers those of the build."""

    def data(*arguments: Any) -> Any:
        table = function(*arguments)
        return ca.vertcat(table, ca.repmat(numbers(settings, table), 1, table.size2()))

    return data


@dataclass(frozen=True, eq=False)
class _Stage:
    dynamics: ca.Function
    cost: ca.Function
    terminal_cost: ca.Function
    terms: tuple[str, ...]
    binding: list[ConstraintState]
    settings: tuple[ca.SX, ...]  # open numbers
    before: int  # entries of the input before in the state; 0 unless it is a part of it


_STAGES: Latest[_Stage] = Latest(8)  # whatever signals they meet


def _stage(plant: Plant, reference: Reference, horizon: Horizon, cost: Cost, limits: Limits) -> _Stage:
    layout = data_layout(plant, horizon)
    x, before = ca.SX.sym("x", plant.state.size), ca.SX.sym("before", plant.input.size)
    u, theta = ca.SX.sym("u", plant.input.size), ca.SX.sym("theta", layout.size)
    data = layout.split(theta)
    applied = data["free"] * u + (1 - data["free"]) * before if horizon.blocks else u
    view = limited_view = view_of(
        plant,
        x,
        applied,
        data["parameters"],
        data["time"],
        before=before,
        reference=data["reference"],
        feedforward=data["feedforward"] if reads_feedforward(plant, cost) else None,
    )
    length = data["length"] if horizon.lengths else 1.0
    if hastened(horizon):
        # A rate is limited as such; its square costs for as long as the change takes, which leaves the root of the haste.
        limited_view, view = (_hastened(view, factor) for factor in (data["haste"], ca.sqrt(data["haste"] / length)))
    try:
        advance = _advance(plant, horizon)
        if horizon.lengths:
            stretched = horizon.discretisation.stretched(plant, horizon.step, max(horizon.lengths))
            x_next = stretched(x, applied, view.parameters.vector, length)
        else:
            x_next = advance(x, applied, view.parameters.vector)
        written = _written(plant, horizon, limits, limited_view, x_next, data, before)
        terms = {name: ca.SX(value) for name, value in cost.stage(view).items()}
        if horizon.blocks:
            if "held" in terms:
                raise InvalidProblem(
                    "cost: term 'held' has the name of the term of the inputs that Horizon(blocks=...) holds; choose another"
                )
            # Inputs that have no effect are drawn to those that are held, so that a plan states what is applied.
            terms["held"] = (1 - data["free"]) * ca.sumsqr((u - before) / _reach(limits, plant))
        used = ca.vertcat(*terms.values(), *(w.expression for w in written))
        keeps_input = bool(horizon.blocks) or ca.depends_on(used, before)
        before = before if keeps_input else ca.SX(0, 1)
        none = ca.SX.nan(plant.input.size)  # the end has no input; the one before is that of the last stage
        output = view.output.of(outputs_of(plant, x, none, view.parameters.vector))
        end = replace(view, output=output, input=view.input.of(none))
        end = replace(end, input_before=view.input.of(before if keeps_input else none))
        linearise = lambda: _linearise(plant, reference, horizon, advance)  # noqa: E731
        terminal = cost.terminal_cost(end, plant, linearise, horizon.last)
    except InvalidName as error:
        raise InvalidProblem(f"cost: {error}") from None
    final = scalar_expression("cost: term 'terminal'", terminal, finite=False)
    _check_entries(plant, keeps_input, written)
    settings = open_in(x_next, *terms.values(), final, *(w.expression for w in written))
    theta, s = ca.vertcat(theta, *settings), ca.vertcat(x, before, ca.SX.sym("z", len(written)))
    s_next = ca.vertcat(x_next, *([applied] if keeps_input else []), *(w.expression for w in written))
    costs = horizon.step * length * ca.vertcat(*terms.values())
    return _Stage(
        ca.Function("fpirhc_dynamics", [s, u, theta], [ca.densify(s_next)]),
        ca.Function("fpirhc_stage_cost", [s, u, theta], [ca.sum1(costs), ca.densify(costs)]),
        ca.Function("fpirhc_terminal_cost", [s, theta], [ca.densify(final)]),
        tuple(terms),
        written,
        tuple(settings),
        before.numel(),
    )


def _reach(limits: Limits, plant: Plant) -> ca.DM:
    """Half the range of every input, 1 where it is free."""
    lower, upper = limits.input_bounds(plant)
    half = 0.5 * (upper - lower)
    return ca.DM(np.where(np.isfinite(half) & (half > 0), half, 1.0))


def _check_entries(plant: Plant, keeps_input: bool, written: list[ConstraintState]) -> None:
    """Raise where a path has the name of another entry of the stage's state, which is then found under it."""
    mistakes, names = Mistakes("limits"), list(_stage_state(plant, keeps_input, written).elements)
    for name in sorted({name for name in names if names.count(name) > 1}):
        mistakes.add(f"paths: '{name}' is already the name of an entry of the plan; choose another")
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
    plant: Plant,
    horizon: Horizon,
    limits: Limits,
    view: View,
    x_next: Expression,
    data: Mapping[str, Expression],
    before: ca.SX,
) -> list[ConstraintState]:
    boxes, written = limits.boxes(plant), limits.written(plant, horizon.step)
    entries = entries_of(written, view)
    for k, earlier in enumerate(_steps_inside(plant, horizon, limits, view, data), 1):
        seen = replace(earlier, state=view.state.of(_seen(plant, horizon, earlier.state.vector, data)))
        paths = (w for w in entries_of(limits.paths, earlier) if not ca.depends_on(w.expression, before))
        hard = (w for w in (*entries_of(boxes, seen), *paths) if w.name not in limits.prices)
        entries += [replace(w, name=f"{w.name}, step {k}") for w in hard]
    seen = replace(view, state=view.state.of(_seen(plant, horizon, x_next, data)))
    own = entries_of({name: boxes[name] for name in horizon.measured}, seen)
    return [*entries, *(replace(w, name=as_measured(w.name)) for w in own)]


def _steps_inside(
    plant: Plant, horizon: Horizon, limits: Limits, view: View, data: Mapping[str, Expression]
) -> list[View]:
    """The stage after each step of a map but the last, whose state is the next node's, so that a shorter stage stays at its end."""
    if not (limits.states or limits.paths):
        return []
    one, per_stage = by_single_steps(plant), steps_in(plant, horizon.step)
    u, p, x, views = view.input.vector, data["parameters"], view.state.vector, []
    for k in range(1, steps_in(plant, horizon.longest)):
        later = one.equations.next(x, u, p, ca.SX.zeros(len(plant.names)))
        x = later if k < per_stage else ca.if_else(k < per_stage * data["length"], later, x)
        output = view.output.of(outputs_of(plant, x, u, p))
        views.append(replace(view, state=view.state.of(x), output=output, time=view.time + k * sampling(one)))
    return views


def _seen(plant: Plant, horizon: Horizon, x: Expression, data: Mapping[str, Expression]) -> Expression:
    """The state as it will be measured: that of the plan, plus the distance of the measured state from the plan's start."""
    offset = dict(zip(horizon.measured, ca.vertsplit(data["offset"]), strict=True)) if horizon.measured else {}
    return ca.vertcat(*(x[k] + offset[e] if e in offset else x[k] for k, e in enumerate(plant.state.elements)))


def _hastened(view: View, factor: Expression) -> View:
    """The view with so many times the change of the input."""
    u, before = view.input.vector, view.input_before.vector
    return replace(view, input_before=view.input.of(u - factor * (u - before)))


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
    wanted, state = nominal_responses(plant, state, response), reference_state(plant, state)
    a, b = jacobians(state, plant.equations.inverse(state, wanted, plant.approximate), plant.approximate)
    return Linearisation(np.asarray(a.full()), np.asarray(b.full()), horizon.step)


def _nodes(
    plant: Plant,
    reference: Reference,
    horizon: Horizon,
    data: np.ndarray,
    extra: tuple[int, int],
    limits: Limits,
    start: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (the plant's, `extra` input and written ones), inputs and data along the reference; what has none is simulated."""
    layout = data_layout(plant, horizon)
    along = {name: data[layout.slice(name)] for name in ("reference", "feedforward")}
    states, inputs = along["reference"], along["feedforward"]
    if plant.equations.hidden:
        first = np.zeros(plant.state.size) if start is None else start
        bounds = limits.input_bounds(plant)
        states, inputs = nominal_motion(plant, reference, _advance(plant, horizon), first, bounds, data[0])
    else:
        states = np.asarray(ca.DM(reference_state(plant, ca.DM(states))).full())
    states = np.vstack([states, inputs[: extra[0]], np.zeros((extra[1], data.shape[1]))])
    return states, inputs[:, : horizon.stages], data


def _check_finite_limits(stage: _Stage, nodes: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    """Raise where a limited expression is no number along the reference, about which plans are made."""
    (states, inputs, data), binding = nodes, stage.binding
    if not binding or not np.isfinite(states).all():
        return  # `_check_finite` says that the states grow without bound
    count = inputs.shape[1]
    values = np.asarray(stage.dynamics.map(count)(states[:, :count], inputs, data[:, :count]).full())[-len(binding) :]
    mistakes = Mistakes("limits")
    for entry, row in zip(binding, values, strict=True):
        bad = np.flatnonzero(~np.isfinite(row))
        if bad.size:
            mistakes.add(
                f"'{entry.name}' is {row[bad[0]]} on the reference at stage {bad[0]}, expected a finite number; limit the "
                "argument of a root or a logarithm in its place, and feedforward only where the cost reads it (deviation)"
            )
    mistakes.raise_if_any()


def _check_finite(plant: Plant, stage: _Stage, nodes: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    states, inputs, data = nodes
    values = stage.cost(states[:, 0], inputs[:, 0], data[:, 0])[1].full().ravel()
    final = float(stage.terminal_cost(states[:, -1], data[:, -1]))
    terms = [(name, value, "at t = 0") for name, value in zip(stage.terms, values, strict=True)]
    mistakes = Mistakes("cost")
    for name, value, where in [*terms, ("terminal", final, "at the end of the horizon")]:
        if not np.isfinite(value):
            hint = ""
            if name == "terminal" and np.isnan(value):
                hint = "; the end has no input, and input_before and feedforward only where a term of the stages reads them"
            if not np.isfinite(states[: plant.state.size]).all():
                hint = ": the states that would keep the outputs there grow without bound"
            elif not np.isfinite(data[:, 0]).all():
                at = ", ".join(map("{} = {:g}".format, plant.state.elements, states[:, 0]))
                hint = f", {at}: no command gives the response that is needed; look at signs, roots and divisions in "
                hint += place_of(plant.response)
            mistakes.add(f"term '{name}' is {value} on the reference {where}{hint}")
    mistakes.raise_if_any()


@dataclass(frozen=True, eq=False)
class ConstraintState:
    """One further entry of the stage's state."""

    name: str
    unit: str
    expression: ca.SX
    lower: float  # bound; infinite where free
    upper: float  # bound; infinite where free


def entries_of(limits: Mapping[str, PathConstraint], view: View) -> list[ConstraintState]:
    """Limited expressions of a stage as entries."""
    entries = []
    for name, one in limits.items():
        value = ca.SX(cast(Any, one.expression)(view))
        if value.numel() != 1:
            raise InvalidProblem(f"limits: path '{name}' must be one scalar, got {value.shape}")
        entries.append(ConstraintState(name, one.unit, value, one.lower, one.upper))
    return entries


def check_names(horizon: Horizon, limits: Limits) -> None:
    """Raise where a margin is that of no limited state, or leaves nothing between two limits."""
    mistakes = Mistakes("horizon")
    mistakes.unknown("margins: limit of state", horizon.margins, list(limits.states))
    for name in sorted(horizon.margins.keys() & limits.prices.keys()):
        mistakes.add(f"margins of '{name}': its limit has a price, and a margin makes it hard; leave one of them out")
    for name in horizon.margins.keys() & limits.states.keys():
        lower, upper = limits.states[name]
        if 2 * horizon.margins[name] >= upper - lower:
            mistakes.add(
                f"margins of '{name}' is {horizon.margins[name]:.6g}, which leaves nothing between its limits "
                f"{lower:g} and {upper:g}; widen the limits, or adapt faster"
            )
    mistakes.raise_if_any()


def state_prices(limits: Limits, state: Signal, plant: Plant, step: float) -> np.ndarray:
    """Price of a violation of every entry's limits at one node (ns,), in cost per unit; infinite where limits are hard."""
    prices = {f"{name} rate" if name in plant.inputs else name: step * price for name, price in limits.prices.items()}
    prices |= {as_measured(entry): price for entry, price in prices.items()}
    return np.array([prices.get(e, math.inf) for e in state.elements])


def as_measured(name: str) -> str:
    """Return the name of a state's entry whose limits hold for the measured state."""
    return f"{name} as measured"
