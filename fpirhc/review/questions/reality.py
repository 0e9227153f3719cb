"""Does the loop of the model's controller around the reality converge? Both are linear plants at points of the reference.

The reality's own states z are where they settle, 0 = z'(x^N, z, u) with r^N = y^(r)(x^N, z, u), or move along: see `_carrying`.
The eigenvalues of the response Jacobian do not decide there: the poles of the whole loop do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.contraction.delayed import damped_product, resonant_limit
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation.base import Iteration
from fpirhc.errors import FpirhcError, NotSupported
from fpirhc.plant.chain import derivatives_function
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import Points, thinned, usable
from fpirhc.review.question import Answer, Case, ControllerQuestion, Verdict, by_run
from fpirhc.review.questions.margins import smallest_margins
from fpirhc.review.questions.speed import law_of
from fpirhc.sensing.base import response_names
from fpirhc.simulation.linearise.linear_loop import NEUTRAL, LinearLoop
from fpirhc.task.problem import Problem
from fpirhc.task.reality import Equations, Reality

Guided: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray] | None]
_LEFT = 1e-6  # of an equation, relative to the size of its terms
_MOST_STEPS = 6  # of a map that are looked ahead: every one more doubles an expression
_POINTS = 5  # of the reference
_SLOW = 0.05  # frequency of slow requests, as a share of the slowest of the poles that the model lacks
_MOVES = 1e-9  # rate, as a share of the fastest, below which a pole is an integrator's


@dataclass(frozen=True, eq=False)
class RealPoint:
    """A point of the reference where reality and model have the same input."""

    place: int  # number of the point
    real: np.ndarray  # state of the reality, shape (its nx,)
    command: np.ndarray  # shape (nu,)


@dataclass(frozen=True, eq=False)
class Extra:
    """What a reality has beyond its model at a point."""

    poles: np.ndarray  # that the settled reality does not have, per unit of time
    # of the response Jacobian for requests that are slow beside these poles, shape (n,). What is behind a spring moves
    # along with the plant then, so this is no gain at rest.
    eigenvalues: np.ndarray


@lru_cache(maxsize=4)  # several questions of a review need them
def real_points(grid: ReviewGrid) -> tuple[RealPoint, ...]:
    """Return some points of the reference at which the reality settles, or moves along; none where it nowhere does."""
    assert grid.real is not None
    reality, model = grid.real.truth, grid.problem.plant
    known = reality.shared(model)
    carried = _carrying(reality, model) if len(known) < model.state.size else None
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


def real_loops(grid: ReviewGrid, controller: Controller) -> list[LinearLoop]:
    """Return linear loops of the real pair at some points of the reference."""
    assert grid.real is not None
    if controller.plant_model(grid.real).plant is not grid.problem.plant:
        raise NotSupported("its model is the reality")
    if deaf := _deaf(grid.real):
        raise NotSupported(
            f"the reality rounds or switches {', '.join(deaf)}, so that no small change of it moves anything"
        )
    points = Points(grid, controller, grid.real)
    return [points.at(k) for k in thinned(usable(grid), _POINTS)]


def _deaf(problem: Problem) -> list[str]:
    """Inputs of which no small change moves the reality at its start: a rounded or a switched one has a slope of zero."""
    plant = problem.truth.plant
    x, u, p = plant.symbols()
    moved = ca.vertcat(plant.equations.rate(x, u, p), plant.equations.response(x, u, p))
    slopes = ca.Function("fpirhc_deaf", [x, u, p], [ca.densify(ca.jacobian(moved, u))])
    sizes = np.abs(slopes(problem.real_start, problem.inputs_before, plant.exact).full()).max(axis=0)
    return [name for name, size in zip(plant.inputs, sizes, strict=True) if size == 0]


def extra_modes(grid: ReviewGrid, point: RealPoint, believed: np.ndarray, iteration: Iteration) -> Extra:
    """Return the poles of the reality beyond the settled one, and the weighted response Jacobian below them, at a point."""
    assert grid.real is not None
    reality, model = grid.real.truth, grid.problem.plant
    plant = reality.plant
    x, u, p = plant.symbols()
    calm = ca.SX.zeros(len(plant.names))
    rate = plant.equations.rate(x, u, p)
    response = reality.function(response_names(model))(x, u, p, calm)
    slopes = [ca.densify(ca.jacobian(v, w)) for v in (rate, response) for w in (x, u)]
    values = ca.Function("fpirhc_modes", [x, u, p], slopes)(point.real, point.command, plant.exact)
    a, b, c, d = (np.asarray(m.full()) for m in values)
    modes = _beyond(
        np.linalg.eigvals(a), np.linalg.eigvals(_reduced(a, _outer_slopes(reality, model, point.real, point.command)))
    )
    slow = 1j * _SLOW * float(np.abs(modes).min(initial=np.inf))
    gain = d + c @ np.linalg.solve(slow * np.eye(len(a)) - a, b) if modes.size else d
    assumed = np.asarray(model.equations.input_gain(grid.states[point.place], point.command, believed).full())
    return Extra(modes, np.linalg.eigvals(iteration.weighted(gain @ np.linalg.inv(assumed))))


def _settling(problem: Problem, free: list[int]) -> Guided:
    """Function (state, input, response) -> settled state and the input that gives the response, or None."""
    reality, model = problem.truth, problem.plant
    plant = reality.plant
    x, u, p = plant.symbols()
    kept = [k for k in range(plant.state.size) if k not in free]
    wanted = ca.SX.sym("wanted", len(model.controlled_names))
    response = reality.function(response_names(model))(x, u, p, ca.SX.zeros(len(plant.names)))
    rate = plant.equations.rate(x, u, p)
    unknown = ca.vertcat(_entries(x, free), u)
    equations = Equations(unknown, [_entries(x, kept), p, wanted], ca.vertcat(_entries(rate, free), response - wanted))

    def solve(state: np.ndarray, command: np.ndarray, responses: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        root = equations.root(np.append(state[free], command), state[kept], plant.exact, responses)
        if root is None or root.left > _LEFT * (1 + np.abs(responses).max()):
            return None
        settled = state.copy()
        settled[free] = root.at[: len(free)]
        return settled, root.at[len(free) :]

    return solve


def _entries(column: ca.SX, places: list[int]) -> ca.SX:
    """Some entries of a column, one by one: an empty selection of a column with one entry is that entry."""
    return ca.vertcat(ca.SX(0, 1), *(column[k] for k in places))


def _beyond(every: np.ndarray, settled: np.ndarray) -> np.ndarray:
    """The poles that remain when each of the settled plant's has been paired with its nearest one."""
    from scipy.optimize import linear_sum_assignment  # it takes longer to import than a problem to load

    paired, _ = linear_sum_assignment(np.abs(every[:, None] - settled[None, :]))
    rest = np.delete(every, paired)
    return rest[np.abs(rest) > _MOVES * max(1.0, float(np.abs(every).max(initial=0.0)))]


def _carrying(reality: Reality, model: Plant) -> Guided | None:
    """The function (first guess of state, of input, wanted y ... y^(r)) -> state and input where all moves along, or None.

        y^(k) = y^N(k)  for k <= r,        y^(k) = 0  for r < k <= m,

    with as many derivatives as the reality has states and inputs, and the input held.

    Args:
        model: of the controllers; the wanted values are in the order of its state, then its controlled responses.

    Returns:
        None where the numbers of derivatives and of states do not match, the model has coordinates that are not controlled, or a
        map has many states.
    """
    plant, names = reality.plant, model.names
    count, rest = divmod(plant.state.size, len(names))
    on_reference = model.equations.known_by_outputs == tuple(range(model.state.size))
    if not on_reference or rest or len(model.controlled_names) != len(names) or len(plant.inputs) != len(names):
        return None
    if min(model.orders) != max(model.orders) or count < max(model.orders):
        return None
    if plant.step is not None and count > _MOST_STEPS:
        return None
    x, u, p = plant.symbols()
    wanted = ca.SX.sym("wanted", model.state.size + len(names))
    places = [(reality.true_name(c), k) for k in range(count + 1) for c in names]
    chain = derivatives_function(plant, places)(x, u, p, ca.SX.zeros(len(plant.names)))
    left = chain - ca.vertcat(wanted, ca.SX.zeros(len(places) - wanted.numel()))
    equations = Equations(ca.vertcat(x, u), [p, wanted], left)

    def solve(state: np.ndarray, command: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        root = equations.root(np.append(state, command), plant.exact, values)
        if root is None or root.left > _LEFT * (1 + np.abs(root.at).max()):
            return None
        return root.at[: state.size], root.at[state.size :]

    return solve


def _outer_slopes(reality: Reality, model: Plant, state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Return the slopes of the model's states by the reality's, shape (count, nx of the reality).

    Where the reality lacks a state of the model, or the model has outputs, they are those of its coordinates of the same names.

    Args:
        state: of the reality, shape (nx,).
        command: shape (nu,).
    """
    plant, known = reality.plant, sorted(reality.shared(model).values())
    if len(known) == model.state.size or len(reality.shown(model.state.elements)) < model.state.size:
        return np.eye(plant.state.size)[known]
    x, u, p = plant.symbols()
    shown = reality.function(reality.shown(model.state.elements))(x, u, p, ca.SX.zeros(len(plant.names)))
    slopes = ca.Function("fpirhc_outer", [x, u, p], [ca.densify(ca.jacobian(shown, x))])
    return np.asarray(slopes(state, command, plant.exact).full())


def _reduced(a: np.ndarray, outer: np.ndarray) -> np.ndarray:
    """Return the matrix of the motion of `outer` x, shape (count, count), where all else settles.

    Args:
        a: of the motion, shape (nx, nx).
        outer: independent rows, shape (count, nx).
    """
    if not len(outer):
        return np.zeros((0, 0))
    from scipy.linalg import null_space  # it takes longer to import than a problem to load

    count, change = len(outer), np.vstack([outer, null_space(outer).T])
    straight = change @ a @ np.linalg.inv(change)
    settle = np.linalg.pinv(straight[count:, count:])
    return np.asarray(straight[:count, :count] - straight[:count, count:] @ settle @ straight[count:, :count])


LOOP = "Does the loop with the reality converge?"


def real_pair_converges(case: Case) -> Answer | None:
    """Return the largest pole of the real pair along the reference; None without a reality that is a plant."""
    if case.grid.real is None:
        return None
    try:
        loops = real_loops(case.grid, case.controller)
        adapted = max(one.radius for one in loops)
        bare = max(one.radius for one in real_loops(case.grid, without_deformation(case.controller)))
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return by_run(case, LOOP, f"no linear loop of the real pair: {error}")
    text = f"the slowest or fastest growing mode is multiplied by {adapted:.6g} per cycle, without adaptation by {bare:.6g}"
    numbers = {"radius": adapted, "bare_radius": bare}
    if adapted < 1:
        return _with_margins(Answer(LOOP, Verdict.YES, text, "", numbers), loops, case.problem)
    whole = case.controller.deformation.mirror.lags
    lag = "the whole lag of the reality." if whole else "the reality's lag: ModelReferenced(map, lag=...)."
    change = f"Lower the gain, or pair through {lag}"
    if bare >= 1:
        change = "Lower the rate of the tracking law: the loop does not converge without adaptation either."
    return Answer(LOOP, Verdict.CAUTION if adapted < 1 + NEUTRAL else Verdict.NO, text, change, numbers)


def plain_pair_converges(case: Case) -> Answer | None:
    """Return the largest pole of the real pair; None for adaptive controllers, and where there is no such loop to judge."""
    if case.grid.real is None or case.controller.deformation.adapts:
        return None
    try:
        loops = real_loops(case.grid, case.controller)
        radius = max(one.radius for one in loops)
    except (FpirhcError, np.linalg.LinAlgError):
        return None
    text, numbers = f"the slowest or fastest growing mode is multiplied by {radius:.6g} per cycle", {"radius": radius}
    if radius < 1:
        return _with_margins(Answer(LOOP, Verdict.YES, text, "", numbers), loops, case.problem)
    change = "Lower the rate of the tracking law, or the weights of the plan."
    return Answer(LOOP, Verdict.CAUTION if radius < 1 + NEUTRAL else Verdict.NO, text, change, numbers)


def _with_margins(answer: Answer, loops: list[LinearLoop], problem: Problem) -> Answer:
    """The answer with the margins of the real pair where its slowest mode is, which are not those of the model by itself."""
    said, sizes = smallest_margins([max(loops, key=lambda one: one.radius)], problem)
    numbers = {**answer.numbers, **sizes}
    return replace(answer, evidence=f"{answer.evidence}; {said}", numbers=numbers) if said else answer


LAG = "Does the tracking law leave room for the lag of the reality?"
_DAMPING = 0.3
_REAL = 1e-6  # share of the imaginary part, below which a pole is real


def _extras(case: Case) -> list[Extra]:
    """At points along the reference."""
    iteration = case.controller.deformation.iteration
    return [extra_modes(case.grid, point, case.believed, iteration) for point in real_points(case.grid)]


def leaves_room(case: Case) -> Answer | None:
    """Return N Lambda tau, and the largest a lambda with some damping; None without a reality, an unpaired lag or a known law."""
    law = law_of(case.grid, case.controller) if case.grid.real is not None else None
    if law is None or case.controller.deformation.mirror.lags:
        return None  # paired through it, which the loop with the reality judges
    rate, poles = law
    extras = _extras(case)
    lags = [float(np.sum(-1 / one.poles.real[_is_lag(one.poles)])) for one in extras]
    lag = max(lags, default=0.0)
    if lag == 0:
        return None
    period, unit = case.problem.period, case.problem.time_unit
    gain = abs(case.controller.deformation.effective_gain())
    product = gain * max(float(np.abs(one.eigenvalues).max()) for one in extras)
    room, most = poles * rate * lag, damped_product(period, lag, rate, poles, damping=_DAMPING)
    text = (
        f"a lag of {lag:.3g} {unit} that the model lacks; {poles} x {rate:g} {case.problem.rate_unit} x lag = {room:.3g}, "
        f"which must stay below 1 for a fast iteration; gain x eigenvalue is {product:.3g}"
    )
    numbers = {"lag": lag, "room": room, "product": product, "damped_product": most}
    if room >= 1:
        change = f"Use a rate below {1 / (poles * lag):.3g} {case.problem.rate_unit}, or pair through the lag: lag={lag:.2g}."
        return Answer(LAG, Verdict.NO, text, change, numbers)
    text += f", and keeps the damping {_DAMPING:g} up to {most:.3g}"
    if product <= most:
        return Answer(LAG, Verdict.YES, text, "", numbers)
    change = f"Multiply the gain by {most / product:.2g}, or pair through the lag: lag={lag:.2g}."
    return Answer(LAG, Verdict.CAUTION, text, change, numbers)


def _is_lag(poles: np.ndarray) -> np.ndarray:
    return (poles.real < 0) & (np.abs(poles.imag) <= _REAL * np.abs(poles))


RESONANCE = "Is the gain small enough for the resonance of the reality?"
_COMPLEX = 1e-6  # share of the imaginary part, above which a pole swings


def stays_below(case: Case) -> Answer | None:
    """Return the gain and its limit; None without a reality, a resonance or a law with known poles."""
    law = law_of(case.grid, case.controller) if case.grid.real is not None else None
    gain = abs(case.controller.deformation.effective_gain())
    if law is None or gain == 0:
        return None
    rate, poles = law
    extras = _extras(case)
    limits = [(_limit(case.problem.period, rate, poles, one, pole), pole) for one in extras for pole in _swinging(one)]
    if not limits:
        return None
    limit, pole = min(limits, key=lambda pair: pair[0])
    frequency, damping = abs(pole), -pole.real / abs(pole)
    text = (
        f"a resonance at {frequency:.4g} rad/{case.problem.time_unit} with damping {damping:.3g} unknown to the model bears "
        f"an effective gain of {max(limit, 0.0):.3g}; it is {gain:.3g}"
    )
    numbers = {"frequency": frequency, "damping": damping, "limit": limit, "gain": gain}
    if gain <= limit:
        return Answer(RESONANCE, Verdict.YES, text, "", numbers)
    if limit <= 0:
        rates = f"below {2 * damping * frequency / poles:.3g} {case.problem.rate_unit}"
        return Answer(
            RESONANCE, Verdict.NO, f"{text}: the tracking law alone excites it", f"Use a rate {rates}.", numbers
        )
    return Answer(RESONANCE, Verdict.NO, text, f"Multiply the gain by {limit / gain:.2g} or less.", numbers)


def _swinging(extra: Extra) -> list[complex]:
    return [complex(p) for p in extra.poles if p.imag > _COMPLEX * abs(p) and p.real <= 0]


def _limit(period: float, rate: float, poles: int, extra: Extra, pole: complex) -> float:
    eigenvalue = float(np.abs(extra.eigenvalues).max())
    return resonant_limit(
        period, rate, poles, frequency=abs(pole), damping=-pole.real / abs(pole), eigenvalue=eigenvalue
    )


QUESTIONS = (
    ControllerQuestion(real_pair_converges, LOOP, order=7, doubts=True, of_targets=True),
    ControllerQuestion(plain_pair_converges, LOOP, order=33, adaptive=False),
    ControllerQuestion(leaves_room, LAG, order=34),
    ControllerQuestion(stays_below, RESONANCE, order=35),
)
