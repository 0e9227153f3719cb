"""The contract of optimisers, each a step that improves a plan, and how every plan is judged. Theory: docs/theory.md."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeAlias, cast

import casadi as ca
import numpy as np

from fpirhc.describe import Same
from fpirhc.errors import CompileError, NotInstalled, require
from fpirhc.fields.checked import Checked
from fpirhc.horizon.problem import OptimalControl, answered_curvature, reduced_gradient, rollout, sizes_along
from fpirhc.status import Status
from fpirhc.symbolic.driver import Driver, plans_are_compiled, registered
from fpirhc.symbolic.expression import FINITE, Matrix, is_finite
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.native import find_compiler, native, why_no_compiler

FEASIBLE = 1e-4  # largest violation of a state bound, as a share of its unit, that still counts as kept
KEPT = 1e-6  # the same for an optimiser that keeps limits more closely
Columns: TypeAlias = Sequence[np.ndarray]
_FIRST_CALLS = 5  # of `improve`, before a run
UNKNOWN_ITERATIONS = -1.0  # a solver that is called inside a graph does not report its iterations
_PATIENCE = 4  # calls in a row that may leave the violation as it is
_AT_LIMIT = 1e-9  # of the range of an input, within which it stands at a limit
_SHRINKING = 0.9  # a violation counts as shrinking below this share of the last one


class Optimiser(Checked, ABC):
    """Contract: one improvement of a warm-started plan as a Function, with a fixed amount of work where possible."""

    improve: ClassVar[Callable[..., Columns] | None] = None
    """Function (optimiser, horizon, arguments of a step) -> results of a call that may work longer than a step does, for the first
    plan of a run and for open-loop solves; None: it has no such, and a run begins with the memory's start."""

    @property
    def unbounded(self) -> str:
        """Why a call may take any time, with a remedy; empty where its work is bounded."""
        return ""

    def check(self, ocp: OptimalControl) -> None:
        """Raise if the optimiser cannot serve the problem, as with what `refuse_limits` finds.

        Raises:
            NotSupported: the problem has something that this optimiser cannot keep.
        """

    @abstractmethod
    def memory(self, ocp: OptimalControl) -> Layout:
        """Return the layout of what is remembered for the next call: at least the plan, in `plan_inputs`."""

    @abstractmethod
    def shifted(self, ocp: OptimalControl, memory: ca.MX) -> ca.MX:
        """Return the memory for the next horizon, which starts one stage later, or a share `ocp.shares` of every stage.

        Args:
            memory: a column in the layout of `memory`.
        """

    @abstractmethod
    def step(self, ocp: OptimalControl) -> ca.Function:
        """Function (s0, data, lower, upper, memory) -> (U (nu, N), diagnostics, memory for the next call).

        The diagnostics are cost, stationarity, feasibility, iterations and status. A plan that is not finite is never returned;
        the remembered plan is returned in its place, with the status NON_FINITE.
        """


_REMEDIES = {
    "inputs": "serves problems without limits only (it is a baseline); for limits use FixedPointSolver()",
    "states": "keeps input limits only; for state limits use FixedPointSolver(), Ipopt() or Fatrop(), or remove "
    "them from Problem(limits=...)",
    "prices": "keeps limits, but takes no prices ({}); use FixedPointSolver()",
}


def refuse_limits(optimiser: Optimiser, ocp: OptimalControl, kind: Literal["inputs", "states", "prices"]) -> None:
    """Raise where there are limits of a kind that an optimiser cannot keep: of "inputs", of "states", of states with "prices"."""
    priced = [e for e, hard in zip(ocp.state.elements, ocp.hard, strict=True) if not hard]
    inputs = np.isfinite([ocp.input_lower, ocp.input_upper]).any()
    limited = {"inputs": inputs or ocp.bounds_states, "states": ocp.bounds_states, "prices": priced}
    require(not limited[kind], f"{type(optimiser).__name__} {_REMEDIES[kind].format(', '.join(priced))}")


def built(optimiser: Optimiser, ocp: OptimalControl, make: Callable[[OptimalControl], ca.Function]) -> ca.Function:
    """Return a Function of an optimiser, built once: horizons that differ in numbers of settings only share it."""
    key = make.__name__, plans_are_compiled(), Same(optimiser)
    if key not in ocp.functions:
        ocp.functions[key] = make(ocp)
    return ocp.functions[key]


def shift(columns: ca.MX, ocp: OptimalControl, node: int = 0) -> ca.MX:
    """Return one column per stage for the next horizon: the warm start of the next call.

    A share of a stage later they are the means (1 - share) c_i + share c_{i+1} of what the plan foresees there. `node` is that
    of the first column: 1 for s_1 ... s_N.
    """
    shares = np.append(ocp.shares, ocp.shares[-1])[None, node : node + columns.shape[1]]
    later = ca.horzcat(columns[:, 1:], columns[:, -1])  # the last one twice
    return _moved(columns, later, shares)


def shift_gains(gains: ca.MX, size: int, ocp: OptimalControl) -> ca.MX:
    """Return a column of feedback for the next horizon, `size` entries a stage; the last stage, which is repeated, has none."""
    later = ca.vertcat(gains[size:, 0], ca.MX.zeros(size))  # [size:] alone is a row where there is one entry
    return _moved(gains, later, np.repeat(ocp.shares, size)[:, None])


def _moved(now: ca.MX, later: ca.MX, shares: np.ndarray) -> ca.MX:
    if (shares == 1).all():
        return later
    return now + ca.repmat(ca.DM(shares), now.shape[0] // shares.shape[0], 1) * (later - now)


def clip(columns: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
    """Return every stage's input clipped to its box."""
    stages = columns.shape[1]
    return ca.fmin(ca.fmax(columns, ca.repmat(lower, 1, stages)), ca.repmat(upper, 1, stages))


def _largest(value: ca.MX) -> ca.MX:
    """Return the largest absolute entry."""
    return ca.norm_inf(ca.vec(value))


def stationarity(ocp: OptimalControl, inputs: ca.MX, gradient: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
    """Return the projected residual of a plan (docs/theory.md)."""
    scale = cast(ca.MX, ca.repmat(ca.DM(ocp.scale), 1, ocp.stages))
    return _largest(inputs - clip(inputs - scale * gradient, lower, upper))


def state_violation(ocp: OptimalControl, states: ca.MX, units: np.ndarray) -> ca.MX:
    """Return the largest violation of a hard state bound by s_1 ... s_N in these units (ns,); zero without bounds."""
    worst: ca.MX = ca.MX(0)
    for k in np.flatnonzero(ocp.hard).tolist():
        row = states[k, 1:]
        if ocp.state_lower[k] > -FINITE:
            worst = ca.fmax(worst, ca.mmax(ocp.state_lower[k] - row) / units[k])
        if ocp.state_upper[k] < FINITE:
            worst = ca.fmax(worst, ca.mmax(row - ocp.state_upper[k]) / units[k])
    return worst


def feasible_to(ocp: OptimalControl) -> np.ndarray:
    """Return the violation of every state's limits that counts as kept (ns,): whatever its unit, the same share of it."""
    return FEASIBLE * state_units(ocp)


def state_units(ocp: OptimalControl) -> np.ndarray:
    """Return the units of the states (ns,): half the range of their limits; without both, their size along the reference."""
    half = ocp.half_ranges
    sizes = sizes_along(ocp.nodes[0], ocp.along.moved_by(0.5 * (ocp.input_upper - ocp.input_lower)))
    return np.where(np.isfinite(half), half, sizes)


def paid(ocp: OptimalControl) -> ca.Function:
    """Function (s0, U, data) -> what violations of priced limits cost, which is no part of the cost; zero without prices."""
    s0, inputs = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("U", ocp.input.size, ocp.stages)
    data, total = ca.MX.sym("data", ocp.data.size, ocp.stages + 1), ca.MX(0)
    states = rollout(ocp)(s0, inputs, data)[0]  # no part of the Function where nothing reads them
    for k in np.flatnonzero(~ocp.hard).tolist():
        row = states[k, 1:]
        for limit, beyond in (
            (ocp.state_lower[k], ocp.state_lower[k] - row),
            (ocp.state_upper[k], row - ocp.state_upper[k]),
        ):
            total += ocp.state_price[k] * ca.sum2(ca.fmax(beyond, 0)) if abs(limit) < FINITE else 0
    return ca.Function("fpirhc_paid", [s0, inputs, data], [total])


def judge(ocp: OptimalControl) -> ca.Function:
    """Function (U, s0, data, lower, upper, M) -> (cost, stationarity, feasibility), by one rollout and one adjoint sweep.

    M (ns, N) are the multipliers of the state bounds; zero without them.
    """
    inputs, data = ca.MX.sym("U", ocp.input.size, ocp.stages), ca.MX.sym("data", ocp.data.size, ocp.stages + 1)
    s0, lower, upper = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("l", ocp.input.size), ca.MX.sym("u", ocp.input.size)
    multipliers = ca.MX.sym("M", ocp.state.size, ocp.stages)
    valid = multipliers
    if ocp.bounds_states:
        valid = _valid_multipliers(ocp, rollout(ocp)(s0, inputs, data)[0], multipliers)
    value, slope, states, _ = reduced_gradient(ocp)(s0, inputs, data, valid)
    results = [
        value,
        stationarity(ocp, inputs, slope, lower, upper),
        state_violation(ocp, states, np.ones(ocp.state.size)),
    ]
    return ca.Function("fpirhc_judge", [inputs, s0, data, lower, upper, multipliers], results)


def _valid_multipliers(ocp: OptimalControl, states: ca.MX, multipliers: ca.MX) -> ca.MX:
    """The part that can be a multiplier: positive at the upper bound, negative at the lower one, zero elsewhere."""
    rows, none = [], ca.MX.zeros(1, ocp.stages)
    for k, near in enumerate(feasible_to(ocp).tolist()):
        row, values = states[k, 1:], multipliers[k, :]
        at_upper = row >= ocp.state_upper[k] - near if ocp.state_upper[k] < FINITE else none
        at_lower = row <= ocp.state_lower[k] + near if ocp.state_lower[k] > -FINITE else none
        valid = ca.if_else(at_upper, ca.fmax(values, 0), 0) + ca.if_else(at_lower, ca.fmin(values, 0), 0)
        # fmax and fmin would hide NaN.
        rows.append(valid + ca.if_else(ca.fabs(values) <= FINITE, 0, values))
    return ca.vertcat(*rows)


def sane(s0: ca.MX, data: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
    """Return 1 where the first state and the data are finite and the box is not empty, else 0."""
    ordered = ca.logic_and(ca.mmin(lower <= upper), ca.logic_and(ca.mmin(lower <= FINITE), ca.mmin(upper >= -FINITE)))
    return ca.logic_and(is_finite(ca.vertcat(s0, ca.vec(data))), ordered)


def remembered_plan(column: ca.MX, size: int, lower: ca.MX, upper: ca.MX) -> ca.MX:
    """Return the remembered plan (size, N) inside its box; in place of a plan that is not finite, zero inputs inside it."""
    usable = ca.if_else(is_finite(column), column, 0)
    return clip(ca.reshape(usable, size, column.numel() // size), lower, upper)


def status_of(finite: Matrix, residual: Matrix, violation: Matrix | float, tolerance: Matrix | float) -> Matrix:
    """Return the status number of a plan.

    Args:
        finite: whether the plan and its numbers are finite.
        violation: the largest violation of a state bound, in the units of the states.
    """
    converged = ca.if_else(residual <= tolerance, int(Status.OK), int(Status.NOT_CONVERGED))
    feasible = ca.if_else(violation <= FEASIBLE, converged, int(Status.INFEASIBLE))
    return ca.if_else(finite, feasible, int(Status.NON_FINITE))


def judged_plan(
    ocp: OptimalControl,
    arguments: Sequence[ca.MX],
    plan: ca.MX,
    settings: tuple[int, float],
    beside: ca.MX | None = None,
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Return whether a plan after (iterations, tolerance) is finite, with `beside`; whether the call is posed; its diagnostics."""
    s0, data, lower, upper, _ = arguments
    cost, residual, violation = judge(ocp)(plan, s0, data, lower, upper, ca.MX.zeros(ocp.state.size, ocp.stages))
    posed = sane(s0, data, lower, upper)
    finite = ca.logic_and(posed, is_finite(ca.vertcat(ca.vec(plan) if beside is None else beside, cost, residual)))
    status = status_of(finite, residual, violation, settings[1])
    status = ca.if_else(ca.mmax(lower - upper) > 0, int(Status.INFEASIBLE), status)
    numbers = ca.if_else(finite, ca.vertcat(cost, residual, violation), ca.MX.zeros(3))
    return finite, posed, ca.vertcat(numbers, settings[0], status)


def improved(
    optimiser: Optimiser,
    ocp: OptimalControl,
    state: np.ndarray,
    data: np.ndarray | ca.DM,
    memory: np.ndarray,
    *,
    calls: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Improve a plan until it is OK or its violation stays; return the plan, diagnostics of all calls, memory, number of calls."""
    fixed = np.asarray(ca.DM(data).full()), ocp.input_lower, ocp.input_upper
    count, iterations, violation, stuck = 0, 0.0, np.inf, 0
    while True:
        inputs, numbers, remembered = worked(optimiser, ocp, (state, *fixed, memory))
        diagnostics, memory = numbers.ravel(), remembered.ravel()
        count, iterations, status = count + 1, iterations + diagnostics[3], Status(int(diagnostics[4]))
        better = status == Status.NOT_CONVERGED or diagnostics[2] < _SHRINKING * violation
        stuck, violation = (0 if better else stuck + 1), min(violation, diagnostics[2])
        if status not in (Status.NOT_CONVERGED, Status.INFEASIBLE) or stuck >= _PATIENCE or count >= calls:
            diagnostics[3] = max(iterations, UNKNOWN_ITERATIONS)
            return inputs, diagnostics, memory, count


def worked(optimiser: Optimiser, ocp: OptimalControl, call: Columns) -> Columns:
    """Return the results of a call of `improve` or, where there is none, of a step."""
    if optimiser.improve is not None:
        return optimiser.improve(ocp, call)
    return [np.asarray(v.full()) for v in built(optimiser, ocp, optimiser.step)(*call)]


def first_memory(optimiser: Optimiser, ocp: OptimalControl, state: np.ndarray, data: np.ndarray) -> np.ndarray:
    """Return the memory with which a run begins, at the first state (ns,) and data (ntheta, N + 1) of its first horizon."""
    start = optimiser.memory(ocp).start()
    memory = start if optimiser.improve is None else first_plan(optimiser, ocp, state, data, calls=_FIRST_CALLS)[2]
    return memory if np.isfinite(memory).all() else start


def first_plan(
    optimiser: Optimiser, ocp: OptimalControl, state: np.ndarray, data: np.ndarray | ca.DM, *, calls: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Return what `improved` does from no input or, where that plan is at limits only, from their middle if this is cheaper.

    A plan whose inputs all stand at a limit may be stationary because the plant has left what they act on: an empty tank
    flows out as before, whatever the pump adds to nothing.
    """
    layout = optimiser.memory(ocp)
    first = improved(optimiser, ocp, state, data, layout.start(), calls=calls)
    lower, upper = (np.asarray(b)[:, None] for b in (ocp.input_lower, ocp.input_upper))
    reach = upper - lower
    if not np.isfinite(reach).all() or not (np.minimum(first[0] - lower, upper - first[0]) <= _AT_LIMIT * reach).all():
        return first
    memory = layout.start()
    memory[layout.slice("plan_inputs")] = np.tile(lower + reach / 2, ocp.stages).ravel(order="F")
    other, price = improved(optimiser, ocp, state, data, memory, calls=calls), paid(ocp)
    costs = [plan[1][0] + float(price(state, plan[0], data)) for plan in (other, first)]
    return other if other[1][4] == Status.OK and costs[0] < costs[1] else first


LAST = "(arg[5] ? *arg[5] : 0)"


def require_compiler() -> None:
    """Raise NotInstalled, with how to get one, where there is no C compiler."""
    if find_compiler() is None:
        raise NotInstalled(
            f"plans with limits of states need a C compiler (the system's, or pip install ziglang): {why_no_compiler()}"
        )


def compiled_plan(ocp: OptimalControl, name: str, driver: Driver, memory: int) -> ca.Function:
    """Return a driver as the library (s0, data, lower, upper, memory, `LAST`) -> (U, diagnostics, memory), or raise."""
    results = [ca.MX.zeros(*size) for size in ((ocp.input.size, ocp.stages), (5, 1), (memory, 1))]
    arguments = [*call_arguments(ocp, memory), ca.MX.sym("last")]
    unique = registered(name, driver)
    require_compiler()
    library = native(ca.Function(unique, arguments, results), required=True)
    if not library.compiled:
        raise CompileError(library.reason)  # else the plans would be zeros
    return ca.Function(unique, arguments, library.function.call(arguments))


def with_last(ocp: OptimalControl, library: ca.Function, last: int) -> ca.Function:
    """Return the library's Function without its last argument."""
    arguments = call_arguments(ocp, library.size1_in(4))
    return ca.Function(
        "fpirhc_plan_library", arguments, library.call([*arguments, ca.MX(last)]), {"always_inline": True}
    )


def call_arguments(ocp: OptimalControl, memory: int) -> list[ca.MX]:
    """Return the symbols (s0, data, lower, upper, memory) of a step that remembers so many numbers."""
    nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
    sizes = {"s0": (ns, 1), "data": (ocp.data.size, n + 1), "lower": (nu, 1), "upper": (nu, 1), "memory": (memory, 1)}
    return [ca.MX.sym(name, *size) for name, size in sizes.items()]


_CAPACITY = 1e4  # largest multiplier of a hard limit, in units of cost per unit


@dataclass(frozen=True, eq=False)
class Scales:
    """Units of a problem."""

    inputs: np.ndarray  # shape (nu,)
    states: np.ndarray  # shape (ns,)
    cost: float  # C
    bounded: tuple[int, ...]  # places of the states that have a limit
    capacity: np.ndarray  # largest multipliers of the bounded states, in cost per unit
    hard: np.ndarray  # whether the limits of the bounded states have no price

    @property
    def rows(self) -> np.ndarray:
        """Units of the entries that can be limited: the inputs, then the bounded states."""
        return np.concatenate([self.inputs, self.states[list(self.bounded)]])


def scales(ocp: OptimalControl) -> Scales:
    """Return the scales of a problem, from its limits and its reference.

        inputs    half the range of the input; where it is free, the least move along the reference that shifts a limited state
                  by its unit, which is 1 for an input that shifts none
        states    half the range of the state's limits; without both, or where they are an equation, half the spread
                  of the reference and a tenth of its size
        cost      C = median over the inputs of Q_uu (half range)^2, with Q_uu the curvature that is left along an input of the
                  first stage once all later inputs answer it: without the answer it grows with every stage of an unstable model

    gamma = unit^2 / C turns a gradient into a move, and 1e4 C / unit is the largest multiplier that a limit of a state may have.
    """
    states = state_units(ocp)
    places = np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper))
    inputs = _input_units(ocp, states, places)
    answered = answered_curvature(ocp.along)
    usable = np.isfinite(answered) & (answered > 0)
    cost = float(np.median(np.where(usable, answered, ocp.step * ocp.curvature) * inputs**2))
    hard = ocp.hard[places]
    capacity = np.where(hard, _CAPACITY * cost / states[places], ocp.state_price[places])
    return Scales(inputs, states, cost, tuple(int(k) for k in places), capacity, hard)


def tolerated(ocp: OptimalControl) -> np.ndarray:
    """Return the violation of every state's limits that still counts as kept, shape (ns,)."""
    return KEPT * state_units(ocp)


def _input_units(ocp: OptimalControl, states: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The units of the inputs (nu,), with those of the states (ns,), of which some are limited at these places."""
    with np.errstate(invalid="ignore"):
        half = np.asarray(0.5 * (ocp.input_upper - ocp.input_lower))
    free = ~np.isfinite(half)
    units = np.where(~free & (half > 0), half, 1.0)
    if not free.any() or not places.size:
        return units
    # A force of 1 N is nothing to a car: limits that a plan can keep were given up.
    slopes = np.abs(ocp.along.sensitivity()[:, places]).reshape(ocp.stages, places.size, ocp.stages, ocp.input.size)
    with np.errstate(divide="ignore", invalid="ignore"):
        moves = (states[places, None] / slopes.max(axis=(0, 2))).min(axis=0)
    return np.where(free & np.isfinite(moves) & (moves > 0), moves, units)
