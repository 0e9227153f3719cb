"""The iteration of `FixedPoint` on horizons with limits of states, and where its plain iteration does not contract: loops in C.

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import resources

import casadi as ca
import numpy as np

from fpirhc.deformation.base import Deformation
from fpirhc.horizon.hessian_models import (
    ExactHessian,
    GaussNewton,
    HessianModel,
    hessian_end,
    hessian_stage,
    partial_count,
    split_hessian,
    split_stage,
)
from fpirhc.horizon.problem import OptimalControl, answered_curvature
from fpirhc.optimisers.base import FEASIBLE, KEPT, LAST, compiled_plan, shift, shift_gains, state_units, with_last
from fpirhc.optimisers.search import deformed_move
from fpirhc.status import Status
from fpirhc.symbolic.driver import Driver
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import FINITE
from fpirhc.symbolic.layout import Layout, Signal, scalar

MU_WARM = 1e-4  # barrier parameter of a remembered plan, in units of the cost
_TEXTS = ("kernels", "state_limits_sweep", "state_limits")
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
    cost = float(np.median(_answered_curvature(ocp) * inputs**2))
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


def _answered_curvature(ocp: OptimalControl) -> np.ndarray:
    """The curvature (nu,) along the inputs of the first stage once later inputs answer; that of later inputs at rest else."""
    diagonal = answered_curvature(ocp.along)
    usable = np.isfinite(diagonal) & (diagonal > 0)
    return np.where(usable, diagonal, ocp.step * ocp.curvature)


@dataclass(frozen=True)
class LimitedSettings:
    """Settings of one Function."""

    tolerance: float  # of the stationarity, in the unit of the inputs
    map: Deformation  # the deformation of pure steps
    hessian: (
        HessianModel | None
    )  # second derivatives; None: exact, and Gauss-Newton first where a remembered plan is improved
    damping: float  # added to the curvature of the inputs, in units of it
    iterations: int  # most iterations of one call


def limited_memory(ocp: OptimalControl) -> Layout:
    """Return the layout of plan, states, costates, feedback, multipliers, mu (zero: no plan is remembered) and damping."""
    n, states, inputs = range(ocp.stages), ocp.state.elements, ocp.input.elements
    rows = (*inputs, *(states[k] for k in scales(ocp).bounded))
    later = tuple(f"{e}@{k + 1}" for k in n for e in states)
    multipliers = tuple(f"{side} {e}@{k}" for side in ("lower", "upper") for k in n for e in rows)
    return Layout(
        (
            Signal("plan_inputs", tuple(f"{e}@{k}" for k in n for e in inputs)),
            Signal("plan_states", later),
            Signal("plan_costates", later),
            Signal("plan_gains", tuple(f"{e}/{x}@{k}" for k in n for x in states for e in inputs)),
            Signal("plan_multipliers", multipliers),
            scalar("plan_barrier"),
            scalar("plan_damping"),
        )
    )


def limited_step(ocp: OptimalControl, settings: LimitedSettings) -> ca.Function:
    """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory); it raises as `compiled_plan` does."""
    # The number of iterations is an argument of the loops: one library serves a loop and plans in open loop.
    alike = replace(settings, iterations=0)
    plan = _PLANS.of((ocp, settings.map), (alike,), lambda: _compiled(ocp, alike))
    return with_last(ocp, plan, settings.iterations)


def _compiled(ocp: OptimalControl, settings: LimitedSettings) -> ca.Function:
    return compiled_plan(ocp, "fpirhc_limited", _driver(ocp, settings), limited_memory(ocp).size)


_PLANS: Latest[ca.Function] = Latest(8)


def shifted_limited(ocp: OptimalControl, memory: ca.MX) -> ca.MX:
    """Return the memory one stage later; the last stage, which is repeated, has no feedback."""
    layout, n, nu, ns = limited_memory(ocp), ocp.stages, ocp.input.size, ocp.state.size
    parts = layout.split(memory)
    rows = layout["plan_multipliers"].size // (2 * n)
    sides = ca.horzsplit(ca.reshape(parts["plan_multipliers"], rows, 2 * n), n)
    shifted_parts: dict[str, ca.MX] = {
        name: ca.vec(shift(ca.reshape(parts[name], size, n), ocp, node))
        for name, size, node in (("plan_inputs", nu, 0), ("plan_states", ns, 1), ("plan_costates", ns, 1))
    }
    shifted_parts["plan_gains"] = shift_gains(parts["plan_gains"], nu * ns, ocp)
    shifted_parts["plan_multipliers"] = ca.vec(ca.horzcat(*(shift(side, ocp) for side in sides)))
    return layout.join({**parts, **shifted_parts})


def _driver(ocp: OptimalControl, settings: LimitedSettings) -> Driver:
    """The loops in C with what they call."""
    measures = scales(ocp)
    leaves = {
        "evaluate": split_stage(ocp)["evaluate"],
        "linearise": split_stage(ocp)["linearise"],
        **split_hessian(ocp, settings.hessian or ExactHessian()),
        "plain": hessian_stage(ocp, GaussNewton()),
        "end": hessian_end(ocp),
        "deformed": deformed_move(settings.map, ocp.input.size * ocp.stages),
        "guess": _guess(ocp),
    }
    folder = resources.files("fpirhc.optimisers")
    texts = [folder.joinpath(f"{name}.c").read_text(encoding="utf-8") for name in _TEXTS]
    sizes = {"NM": partial_count(ocp), "NH": leaves["curve"].numel_in(0), **_sizes(ocp, measures)}
    constants = {**sizes, **_constants(settings, measures), "ITERATIONS": LAST}
    return Driver("\n".join(texts), leaves, constants, _room(ocp, measures))


def _room(ocp: OptimalControl, measures: Scales) -> int:
    """Numbers of the struct Room of state_limits.c."""
    nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
    inputs, states, limits = n * nu, (n + 1) * ns, n * (nu + len(measures.bounded))
    point = 2 * inputs + states + n * ns * (2 + ns + nu) + ns + ns * ns + 1
    direction = 2 * inputs + inputs * ns + 2 * states
    kept = 2 * inputs + 2 * states + 6 * limits + n * ns
    shared = max(states * (ns + 1) + 6 * limits, n * partial_count(ocp))
    return 2 * point + 2 * 6 * limits + direction + kept + shared


def _sizes(ocp: OptimalControl, measures: Scales) -> dict[str, object]:
    places = list(measures.bounded)
    return {
        "NS": ocp.state.size,
        "NU": ocp.input.size,
        "NT": ocp.data.size,
        "N": ocp.stages,
        "NB": len(places),
        "MEMORY": limited_memory(ocp).size,
        "PLACES": _row(np.array([*places, 0])),
        "CURVATURE": _row(ocp.step * ocp.curvature),
        "UNITS": _row(np.append(measures.rows, 1.0)),
        "SPREADS": _row(measures.states),
        "CAPACITIES": _row(np.append(measures.capacity, 0.0)),
        "HARD": _row(np.append(measures.hard.astype(float), 0.0)),
        "STATE_LOWER": _row(np.append(ocp.state_lower[places], 0.0)),
        "STATE_UPPER": _row(np.append(ocp.state_upper[places], 0.0)),
    }


def _constants(settings: LimitedSettings, measures: Scales) -> dict[str, object]:
    statuses = {
        "CONVERGED": Status.OK,
        **{s.name: s for s in (Status.NOT_CONVERGED, Status.INFEASIBLE, Status.NON_FINITE)},
    }
    return {
        **{name: int(status) for name, status in statuses.items()},
        "COST": repr(float(measures.cost)),
        "NEAR_LIMIT": FEASIBLE,
        "KEPT_SHARE": KEPT,
        "DAMPING": repr(float(settings.damping)),
        "TOLERANCE": repr(float(settings.tolerance)),
        "SCALED_TOLERANCE": repr(float(max(settings.tolerance / measures.inputs.min(), 1e-12))),
        "PLAIN_FIRST": int(settings.hessian is None),
    }


def _guess(ocp: OptimalControl) -> ca.Function:
    """Function theta -> (reference as a stage's state (ns), that of the nodes where there is none, feedforward (nu))."""
    theta = ca.SX.sym("theta", ocp.data.size)
    reference, forward = (theta[ocp.data.slice(name)] for name in ("reference", "feedforward"))
    reference = ocp.state_of(reference)
    rest = ocp.state.size - reference.numel() - ocp.written
    state = ca.vertcat(reference, *([forward] if rest else []), ca.SX.zeros(ocp.written))
    return ca.Function("fpirhc_guess", [theta], [ca.densify(state), ca.densify(forward)])


def _row(values: np.ndarray) -> str:
    """A C initialiser; infinities become numbers beyond every finite one."""
    texts = (repr(v) if abs(v) <= FINITE else "-10 * FINITE" if v < 0 else "10 * FINITE" for v in values.tolist())
    return "{" + ", ".join(texts) + "}"
