"""The real pair near the reference: the reality and the model as linear plants in one loop, and the modes that the model lacks.

At a point of the reference the reality's own states z are where they settle, and the input is what the reference needs then,

    0 = z'(x^N, z, u),        r^N = y^(r)(x^N, z, u).

The loop is the library's own around both linearisations, so the integrator, the sensors' estimator and the dead times are in it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np
from scipy.optimize import linear_sum_assignment

from fpirhc.controllers.base import Controller
from fpirhc.errors import NotSupported
from fpirhc.plant.plant import Parameter, Plant
from fpirhc.review.carried import carrying
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.linear import LinearLoop, cycle_of, linear_parameters, linear_problem, matrices_of, response_slopes
from fpirhc.review.loops import plan_gains_at
from fpirhc.review.reduced import outer_slopes, reduced
from fpirhc.review.stand_in import linear_stand_in
from fpirhc.sensing.base import response_names
from fpirhc.symbolic.layout import Expression, Named
from fpirhc.task.problem import Problem
from fpirhc.task.reality import Reality

Settling: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray] | None]
_STEPS = 60  # of Newton's method
_POINTS = 5  # of the reference
_SLOW = 0.05  # frequency of slow requests, as a share of the slowest of the poles that the model lacks
_MOVES = 1e-9  # rate, as a share of the fastest, below which a pole is an integrator's


@dataclass(frozen=True, eq=False)
class RealPoint:
    """A point of the reference where reality and model have the same input.

    Args:
        place: number of the point.
        real: state of the reality, shape (its nx,).
        command: shape (nu,).
    """

    place: int
    real: np.ndarray
    command: np.ndarray


@dataclass(frozen=True, eq=False)
class Extra:
    """What a reality has beyond its model at a point.

    Args:
        poles: that the settled reality does not have, per unit of time.
        eigenvalues: of the response Jacobian for requests that are slow beside these poles, shape (n,). What is behind a spring
            moves along with the plant then, so this is no gain at rest.
    """

    poles: np.ndarray
    eigenvalues: np.ndarray


@lru_cache(maxsize=4)  # several questions of a review need them
def real_points(grid: ReviewGrid) -> tuple[RealPoint, ...]:
    """Return some points of the reference at which the reality settles, or moves along; none where it nowhere does."""
    assert grid.real is not None
    reality, model = _reality(grid.real), grid.problem.plant
    known = reality.shared(model)
    carried = carrying(reality, model) if len(known) < model.state.size else None
    solve = _settling(grid.real, [k for k in range(reality.plant.state.size) if k not in known.values()])
    places = np.unique(np.linspace(0, len(grid.times) - 1, _POINTS).astype(int))
    points, guess = [], (grid.real.real_start, grid.real.inputs_before)
    for place in places:
        start = guess[0].copy()
        for own, there in known.items():
            start[there] = grid.states[place, own]
        at = solve(start, guess[1], grid.responses[place]) if carried is None else None
        if carried is not None:
            at = carried(start, guess[1], np.append(grid.states[place], grid.responses[place]))
        if at is not None:
            points.append(RealPoint(int(place), *at))
            guess = at
    return tuple(points)


def real_loops(grid: ReviewGrid, controller: Controller, points: Sequence[RealPoint]) -> list[LinearLoop]:
    """Return the linear loop of the real pair at some points.

    Raises:
        NotSupported: no linear loop; a controller whose model is the reality.
        FpirhcError: every error that the controller raises about a linear plant.
    """
    assert grid.real is not None
    problem, model, reality = grid.real, grid.problem.plant, _reality(grid.real)
    if model.outputs:
        raise NotSupported("a reality beside outputs has other inner states than the model; simulate it")
    if controller.plant_model(problem).plant is not model:
        raise NotSupported("its model is the reality")
    hidden = [c for c in problem.judged_names if reality.true_name(c) not in reality.plant.coordinates]
    if hidden:
        raise NotSupported(f"{', '.join(hidden)} of the reality are outputs and no coordinates; simulate it")
    believed = controller.plant_model(grid.problem).parameters(model)
    stand_in, plan = linear_stand_in(grid.problem, controller)
    linear = linear_problem(grid.problem, stand_in)
    plant = linear_reality(reality.plant)
    integrator = linear.integrator if problem.real_integrator.opaque else problem.real_integrator
    still = dict.fromkeys(plant.state.elements, 0.0)
    whole = replace(linear, reality=Reality(plant, start=still, integrator=integrator, seen=reality.seen))
    judged = tuple(plant.state.elements.index(reality.true_name(c)) for c in problem.judged_names)
    matrices = matrices_of(whole, stand_in, judged)
    own, slopes = _entries(reality.plant), response_slopes(model)
    feedbacks = plan_gains_at(grid, plan, [float(grid.times[p.place]) for p in points], believed)
    loops = []
    for point, feedback in zip(points, feedbacks, strict=True):
        exact = np.asarray(own(point.real, point.command, reality.plant.exact).full()).ravel()
        of_model = linear_parameters(slopes, grid.states[point.place], point.command, believed, feedback)
        loops.append(matrices.at(exact, of_model))
    return loops


def extra_modes(grid: ReviewGrid, point: RealPoint, believed: np.ndarray) -> Extra:
    """Return the poles of the reality that it has beyond the settled one, and its response Jacobian below them, at a point."""
    assert grid.real is not None
    reality, model = _reality(grid.real), grid.problem.plant
    plant = reality.plant
    x, u, p = plant.symbols()
    calm = ca.SX.zeros(len(plant.names))
    rate = plant.derivative_function(x, u, p)
    response = reality.function(response_names(model.face))(x, u, p, calm)
    slopes = [ca.densify(ca.jacobian(v, w)) for v in (rate, response) for w in (x, u)]
    values = ca.Function("fpirhc_modes", [x, u, p], slopes)(point.real, point.command, plant.exact)
    a, b, c, d = (np.asarray(m.full()) for m in values)
    modes = _beyond(
        np.linalg.eigvals(a), np.linalg.eigvals(reduced(a, outer_slopes(reality, model, point.real, point.command)))
    )
    slow = 1j * _SLOW * float(np.abs(modes).min(initial=np.inf))
    gain = d + c @ np.linalg.solve(slow * np.eye(len(a)) - a, b) if modes.size else d
    x, u, p = model.symbols()
    by_input = ca.Function("fpirhc_gain", [x, u, p], [ca.jacobian(model.controlled_response_function(x, u, p), u)])
    assumed = np.asarray(by_input(grid.states[point.place], point.command, believed).full())
    return Extra(modes, np.linalg.eigvals(gain @ np.linalg.inv(assumed)))


def linear_reality(plant: Plant) -> Plant:
    """Return a plant of the same coordinates and inputs whose parameters are the slopes of its responses.

    Slopes that are zero by structure are left out, so that an input reaches the same coordinates as in the plant itself.
    """
    places = _places(plant)
    parameters = {f"s{i}_{j}": Parameter(0.0, 0.0, "1") for i, j in places}

    def response(*arguments: Named) -> Mapping[str, Expression]:
        *derivatives, u, p = arguments
        by_name = {c + "'" * k: d[c] for k, d in enumerate(derivatives) for c in d}
        column = [*(by_name[e] for e in plant.state.elements), *(u[name] for name in plant.inputs)]
        sums: list[Expression] = [ca.SX(0)] * len(plant.names)
        for i, j in places:
            sums[i] = sums[i] + p[f"s{i}_{j}"] * column[j]
        return dict(zip(plant.names, sums, strict=True))

    kind = inspect.Parameter.POSITIONAL_ONLY
    names = [f"d{k}" for k in range(max(plant.orders))] + ["u", "p"]
    vars(response)["__signature__"] = inspect.Signature([inspect.Parameter(name, kind) for name in names])
    order = dict(zip(plant.names, plant.orders, strict=True))
    names_and_units = plant.coordinates, plant.inputs, parameters, response, order, plant.controlled
    return Plant(*names_and_units, time_unit=plant.time_unit, step=cycle_of(plant))


def _places(plant: Plant) -> list[tuple[int, int]]:
    """Rows and columns of the slopes of the responses by (state, input) that are not zero by structure."""
    x, u, p = plant.symbols()
    sparsity = ca.jacobian(plant.response_function(x, u, p), ca.vertcat(x, u)).sparsity()
    rows, columns = sparsity.get_triplet()
    return sorted(zip(rows, columns, strict=True))


def _entries(plant: Plant) -> ca.Function:
    """Function (state, input, parameters) -> parameters of `linear_reality`."""
    x, u, p = plant.symbols()
    slopes = ca.jacobian(plant.response_function(x, u, p), ca.vertcat(x, u))
    return ca.Function("fpirhc_entries", [x, u, p], [ca.vertcat(*(slopes[i, j] for i, j in _places(plant)))])


def _settling(problem: Problem, free: list[int]) -> Settling:
    """Function (state, input, response) -> settled state and the input that gives the response, or None."""
    reality, model = _reality(problem), problem.plant
    plant = reality.plant
    x, u, p = plant.symbols()
    calm = ca.SX.zeros(len(plant.names))
    wanted = ca.SX.sym("wanted", len(model.controlled_names))
    response = reality.function(response_names(model.face))(x, u, p, calm)
    rate = plant.derivative_function(x, u, p)
    # One by one: an empty selection of a column with one entry is that entry.
    residual = ca.vertcat(*(rate[k] for k in free), response - wanted)
    unknown = ca.vertcat(*(x[k] for k in free), u)
    newton = ca.Function("fpirhc_point", [x, u, p, wanted], [residual, ca.densify(ca.jacobian(residual, unknown))])

    def solve(state: np.ndarray, command: np.ndarray, responses: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        at, held = state.copy(), np.array(command, dtype=float)
        for _ in range(_STEPS):
            left, slope = (np.asarray(m.full()) for m in newton(at, held, plant.exact, responses))
            if not (np.isfinite(left).all() and np.isfinite(slope).all()):
                return None
            step = np.linalg.lstsq(slope, -left.ravel(), rcond=None)[0]
            at[free] += step[: len(free)]
            held += step[len(free) :]
            if np.abs(step).max() <= 1e-10 * (1 + max(np.abs(at).max(), np.abs(held).max())):
                return (at, held) if np.abs(left).max() <= 1e-6 * (1 + np.abs(responses).max()) else None
        return None

    return solve


def _beyond(every: np.ndarray, settled: np.ndarray) -> np.ndarray:
    """The poles that remain when each of the settled plant's has been paired with its nearest one."""
    distances = np.abs(every[:, None] - settled[None, :])
    paired, _ = linear_sum_assignment(distances)
    rest = np.delete(every, paired)
    return rest[np.abs(rest) > _MOVES * max(1.0, float(np.abs(every).max(initial=0.0)))]


def _reality(problem: Problem) -> Reality:
    assert problem.symbolic_reality is not None
    return problem.symbolic_reality
