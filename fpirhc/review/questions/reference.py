"""What does the reference ask for? No jumps, states inside their limits, an inverse, and commands inside their limits.

A step by `if_else` has the derivative zero, so that no symbolic question sees it. Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.plant.motion import controlled_places, with_space
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import ReviewGrid, each
from fpirhc.review.question import Answer, ProblemQuestion, Verdict
from fpirhc.task.problem import Problem

JUMPS = "Is the reference free of jumps?"
_INTERVALS = 4000  # of the run
_LOOKED_AT = 6  # intervals with the largest rests, of every state
_HALVINGS = 40
_MARGIN = 1e-7  # on either side of a jump, as a share of the interval that holds it
_SIZE = 1e-4  # of a jump, as a share of the state's range

Motion = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Jump:
    """A jump of the reference."""

    state: str  # name of the state of the reference
    time: float  # of the jump
    size: float  # of the jump, in the state's unit


def jumps(problem: Problem) -> list[Jump]:
    """Return the jumps of those states of the reference that are tracked, judged or weighed, the first of each state."""
    times = np.linspace(0.0, problem.duration, min(_INTERVALS, problem.cycles) + 1)
    values, slopes = _motion(problem, len(times))(times)
    rests = np.abs(_rests(times, values, slopes))
    scales = np.maximum(np.ptp(values, axis=1), 1e-12 * np.abs(values).max(axis=1, initial=0.0))
    largest = np.sort(np.argsort(rests, axis=1)[:, -_LOOKED_AT:])
    places, detected = np.repeat(np.arange(len(rests)), largest.shape[1]), list[Jump]()
    for place, time, size in zip(places, *_narrowed(problem, places, times[largest], times[largest + 1]), strict=True):
        name = problem.plant.output.elements[place]
        if abs(size) > _SIZE * scales[place] > 0 and name not in [one.state for one in detected]:
            detected.append(Jump(name, float(time), float(size)))
    return detected


def reference_free_of_jumps(grid: ReviewGrid) -> Answer:
    """Return whether a state of the reference jumps, where, and what to use instead; a map has differences instead."""
    problem = grid.problem
    if problem.integrator.steps_maps:
        text = "a map follows differences of the reference over its cycles, which a jump does not hide"
        return Answer(JUMPS, Verdict.YES, text, "", {"jumps": 0.0})
    detected = jumps(problem)
    if not detected:
        return Answer(
            JUMPS, Verdict.YES, "every state of the reference is the integral of the next one", "", {"jumps": 0.0}
        )
    units = dict(zip(problem.plant.output.elements, problem.plant.output.units, strict=True))
    listed = [f"{j.state} by {j.size:.3g} {units[j.state]} at t = {j.time:.4g} {problem.time_unit}" for j in detected]
    first = detected[0]
    numbers = {"jumps": float(len(detected)), "time": first.time, "size": first.size}
    text = (
        f"{', '.join(listed)}; its derivative there is not that of the expressions, so that no other answer covers it"
    )
    return Answer(JUMPS, Verdict.NO, text, _instead(problem, first), numbers)


def _instead(problem: Problem, jump: Jump) -> str:
    """A set-point filtered by one pole more than the coordinate's order, with as many continuous derivatives."""
    plant = problem.plant
    order = plant.chains[jump.state.rstrip("'")]
    terms = ["1", "w*s", *(f"(w*s)**{k}/{math.factorial(k)}" for k in range(2, order + 1))]
    return (
        f"Use a filtered set-point: 1 - ca.exp(-w*s) * ({' + '.join(terms)}) with s = ca.fmax(t - {jump.time:.4g}, 0) rises "
        f"from 0 to 1 and has {order} continuous derivative(s); choose the rate w, {problem.rate_unit}, that the limits allow."
    )


def _motion(problem: Problem, count: int) -> Motion:
    """Times (count,) -> states of the reference and their derivatives, shape (nx, count) each."""
    plant, function = problem.plant, problem.reference.function(problem.plant).map(count)
    elements, names = plant.output.elements, list(plant.chains)

    def values(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        states, responses = (np.asarray(v.full()) for v in function(times[None, :]))
        rows = [
            states[elements.index(e + "'")] if e + "'" in elements else responses[names.index(e.rstrip("'"))]
            for e in elements
        ]
        return states, np.array(rows)

    return values


def _rests(times: np.ndarray, values: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """What the derivatives do not explain of the differences, shape (nx, m - 1)."""
    rests = np.diff(values, axis=1) - 0.5 * np.diff(times) * (slopes[:, 1:] + slopes[:, :-1])
    return np.where(np.isfinite(rests), rests, 0.0)


def _narrowed(
    problem: Problem, places: np.ndarray, first: np.ndarray, last: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Times and sizes of what is left of some intervals' rests after many halvings, each time of the half with the larger one.

    Args:
        problem: of the reference.
        places: of the states whose rests they are, shape (m,).
        first: the intervals' first times, m numbers.
        last: the last ones.
    """
    first, last, which = first.ravel(), last.ravel(), np.arange(len(places))
    margin = _MARGIN * (last - first)

    def rests(*times: np.ndarray) -> np.ndarray:
        """Of each state in its own intervals, shape (intervals, m)."""
        between = np.array(times)
        motion = motions[len(times)](between.ravel())
        values, slopes = (v.reshape(-1, *between.shape)[places, :, which] for v in motion)
        return _rests(between.T, values, slopes).T

    motions = {count: _motion(problem, count * len(places)) for count in (2, 3)}
    for _ in range(_HALVINGS):
        middle = 0.5 * (first + last)
        halves = np.abs(rests(first, middle, last))
        later, moved = halves[1] > halves[0], halves.any(axis=0)
        first, last = np.where(moved & later, middle, first), np.where(moved & ~later, middle, last)
        if not moved.any():
            break
    # At its very time a kink has the mean of both slopes: half the jump stands on either side.
    size = rests(first - margin, last + margin)[0]
    return np.where(last <= margin, 0.0, last), size


LIMITS = "Does the reference keep the limits of states, rates and paths?"
_TOUCHES = 1e-6  # of the interval's size, within which a value is at its limit


def reference_keeps_limits(grid: ReviewGrid) -> Answer | None:
    """Return the limits that the reference leaves or touches; None without such limits, or where no plan is drawn to it."""
    problem, limits = grid.problem, grid.problem.limits
    if problem.horizon is None or problem.cost is None or not (limits.states or limits.rates or limits.paths):
        return None
    horizon = replace(problem.horizon, terminal=())
    try:
        all_hard, start = replace(limits, soft={}, prices={}), problem.start_state
        ocp = transcribe(problem.plant, problem.reference, horizon, problem.cost, all_hard, start=start)
    except FpirhcError as error:
        return Answer(LIMITS, Verdict.UNKNOWN, str(error))
    if not _drawn_to_reference(ocp):
        return None
    values = _values(grid, ocp)
    usable = np.isfinite(values).all(axis=1)
    if not usable.any():
        return Answer(LIMITS, Verdict.UNKNOWN, "no finite command is known", "See whether the problem is well posed.")
    low, high = values[usable].min(axis=0), values[usable].max(axis=0)
    rooms = _rooms(ocp, low, high)
    bound = [k for k in range(len(rooms)) if np.isfinite(rooms[k])]
    name_of = dict(enumerate(zip(ocp.state.elements, ocp.state.units, strict=True)))
    text = "; ".join(
        f"{name_of[k][0]} from {low[k]:.3g} to {high[k]:.3g} {name_of[k][1]}, limits {ocp.state_lower[k]:.3g} and "
        f"{ocp.state_upper[k]:.3g}"
        for k in bound
    )
    numbers = {f"room_{name_of[k][0]}": float(rooms[k]) for k in bound}
    outside = [name_of[k][0] for k in bound if rooms[k] < -_TOUCHES]
    touched = [name_of[k][0] for k in bound if abs(rooms[k]) <= _TOUCHES]
    change = f"Move the reference inside the limits of {', '.join([*outside, *touched])}, or widen them."
    soft = {*limits.soft, *limits.prices}
    softened = soft | {f"{i} rate" for i in soft - {*problem.plant.state.elements}}
    hard = [name for name in outside if name not in softened]
    verdict = Verdict.NO if hard else Verdict.CAUTION if outside or touched else Verdict.YES
    return Answer(LIMITS, verdict, text, change, numbers)


def _drawn_to_reference(ocp: OptimalControl) -> bool:
    """Whether a cost has the reference in it, or the command that it needs; an economic one has not."""
    s, u, theta = (
        ca.SX.sym(n, size) for n, size in zip("sut", (ocp.state.size, ocp.input.size, ocp.data.size), strict=True)
    )
    depends = ca.which_depends(ca.vertcat(ocp.stage_cost(s, u, theta)[0], ocp.terminal_cost(s, theta)), theta, 1, False)
    wanted = [ocp.data.slice(name) for name in ("reference", "feedforward") if name in ocp.data.names]
    return any(any(depends[places]) for places in wanted)


def _rooms(ocp: OptimalControl, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Distance to the nearest limit as a share of the interval, negative outside; infinite where nothing is limited."""
    with np.errstate(invalid="ignore"):
        interval = ocp.state_upper - ocp.state_lower
    ends = [
        abs(low),
        abs(high),
        *(np.where(np.isfinite(end), abs(end), 0.0) for end in (ocp.state_lower, ocp.state_upper)),
    ]
    size = np.max(ends, axis=0)
    scale = np.where(np.isfinite(interval) & (interval > 0), interval, np.where(size > 0, size, 1.0))
    return np.asarray(np.minimum(ocp.state_upper - high, low - ocp.state_lower) / scale)


def _values(grid: ReviewGrid, ocp: OptimalControl) -> np.ndarray:
    """The stage's state along the reference with the limited rates and paths as its last entries, shape (m, ns)."""
    problem, plant = grid.problem, grid.problem.plant
    assert problem.horizon is not None
    assert problem.cost is not None
    nx, nu = plant.state.size, plant.input.size
    data_of = stage_data(plant, problem.reference, replace(problem.horizon, terminal=()), problem.cost)
    data = np.array([np.asarray(data_of(t, plant.approximate).full())[:, 0] for t in grid.times])
    states = np.zeros((len(grid.times), ocp.state.size))
    states[:, :nx] = grid.states
    if ocp.state.size - ocp.written > nx:
        states[:, nx : nx + nu] = _commands_before(grid)
    written = each(ocp.dynamics, states, grid.commands[0], data)
    states[:, ocp.state.size - ocp.written :] = written[:, ocp.state.size - ocp.written :]
    return states


def _commands_before(grid: ReviewGrid) -> np.ndarray:
    """Inputs that the reference needs one stage earlier, shape (m, nu)."""
    problem, plant = grid.problem, grid.problem.plant
    assert problem.horizon is not None
    earlier = np.maximum(grid.times - problem.horizon.step, 0.0)
    responses = np.asarray(problem.reference.function(plant).map(len(earlier))(earlier[None, :])[1].full())
    exact = np.tile(plant.exact, (len(earlier), 1))
    return each(plant.equations.inverse, grid.states_at(earlier), responses[controlled_places(plant)].T, exact)


INVERSE = "Does the inverse exist along the reference?"
_SINGULAR = 1e8
_DOUBTFUL = 1e4
_VANISHING = 0.01  # share of its largest size below which a gain is doubtful


def inverse_exists(grid: ReviewGrid) -> Answer:
    """Return the conditioning of B along the reference and over the box, and whether the plant's inverse inverts its response.

    Between two points at which det B has different signs it is zero somewhere.
    """
    answer, missed = _conditioning(grid), _missed(grid)
    if answer.verdict is Verdict.NO or missed is None or missed <= _INVERTED:
        return answer
    text = f"the response to the command that the inverse finds is off by up to {missed:.2g} of the largest response of the model"
    return Answer(INVERSE, Verdict.NO, text, _MENDED, {**answer.numbers, "missed": missed})


_INVERTED = 1e-4
_MENDED = "Mend Plant(inverse=...), or leave it out: it is then derived, or found by Newton's method."


def _missed(grid: ReviewGrid) -> float | None:
    """How far the model's response to inverse(x, r) is from r, as a share of the largest r, for responses r that it can have."""
    plant = grid.problem.plant
    own, response = np.tile(plant.approximate, (len(grid.times), 1)), plant.equations.controlled_response
    wanted = each(response, grid.states, grid.needed(plant.approximate), own)
    got = each(response, grid.states, each(plant.equations.inverse, grid.states, wanted, own), own)
    size = np.abs(wanted).max()
    return float(np.abs(got - wanted).max() / size) if np.isfinite(got).all() and size > 0 else None


def _conditioning(grid: ReviewGrid) -> Answer:
    gains = _gains(grid)
    bad = ~np.isfinite(gains).all(axis=(2, 3))
    if bad[0].any():
        return Answer(INVERSE, Verdict.NO, "the gain of the inputs is not finite along the reference", _CHANGE)
    usual = gains[~bad]
    sizes = np.linalg.svd(usual, compute_uv=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = float((sizes[:, 0] / sizes[:, -1]).max())
    share = float(sizes[:, -1].min() / sizes[:, -1].max()) if sizes[:, -1].max() > 0 else 0.0
    numbers = {"condition": condition, "smallest_share": share}
    signs = [np.sign(np.linalg.det(g)) for g in (gains[0], usual)]
    text = f"condition at most {condition:.3g}, the smallest gain is {share:.3g} of its largest"
    if np.unique(signs[0]).size > 1 or not np.linalg.cond(gains[0]).max() < _SINGULAR:
        return Answer(INVERSE, Verdict.NO, f"{text}; it vanishes along the reference", _CHANGE, numbers)
    if np.unique(signs[1]).size > 1 or bad.any():
        return Answer(
            INVERSE, Verdict.CAUTION, f"{text}; it changes sign within the box of the parameters", _CHANGE, numbers
        )
    doubtful = condition > _DOUBTFUL or share < _VANISHING
    return Answer(INVERSE, Verdict.CAUTION if doubtful else Verdict.YES, text, _CHANGE, numbers)


_CHANGE = "Control another coordinate, move the reference away from the singular state, or use time slots."


def _gains(grid: ReviewGrid) -> np.ndarray:
    """B at every draw and point, shape (draws + 1, m, n, n); the last one is the model's."""
    plant = grid.problem.plant
    x, u, p = plant.symbols()
    slope = ca.densify(ca.jacobian(plant.equations.controlled_response(x, u, p), u))
    function = ca.Function("fpirhc_input_gain", [x, u, p], [ca.vec(slope)])
    m, n = len(grid.times), len(plant.inputs)
    sets = np.vstack([grid.draws, plant.approximate])
    states = np.concatenate([grid.drawn_states, grid.states[None]]).reshape(-1, plant.state.size)
    commands = np.concatenate([grid.commands, grid.needed(plant.approximate)[None]]).reshape(-1, n)
    columns = each(function, states, commands, np.repeat(sets, m, axis=0))
    return columns.reshape(len(sets), m, n, n).transpose(0, 1, 3, 2)


COMMANDS = "Are the commands that the reference needs inside the limits?"


def commands_inside(grid: ReviewGrid) -> Answer:
    """Return the largest share of its limits that the reference needs of an input."""
    plant = grid.problem.plant
    lower, upper = grid.problem.limits.input_bounds(plant)
    # Inner states begin at the problem's start, and not where the reference would have led them before.
    commands = grid.commands[:, 1:] if grid.inner else grid.commands
    text = "needed: " + _named_ranges(plant, commands[0])
    used = _used(commands, lower, upper)
    if not np.isfinite(used).any():
        return Answer(COMMANDS, Verdict.UNKNOWN, "no finite command is known", "See whether the problem is well posed.")
    own, widest = float(np.nanmax(used[0])), float(np.nanmax(used))
    numbers = {"share_of_limits": own, "share_over_box": widest}
    if not np.isfinite(np.concatenate([lower, upper])).any():
        return Answer(COMMANDS, Verdict.YES, f"{text}; no input has limits", "", numbers)
    text += f"; {100 * own:.3g} % of the way from the middle of the limits to one of them, {100 * widest:.3g} % over the box"
    held = _named_ranges(plant, commands, np.nan_to_num(used).max(axis=(0, 1)) > 1)
    change = f"Slow the reference down or ask for less; limits that are a choice must hold {held}."
    verdict = Verdict.NO if own > 1 else Verdict.CAUTION if widest > 1 else Verdict.YES
    return Answer(COMMANDS, verdict, text, change, numbers)


def _named_ranges(plant: Plant, commands: np.ndarray, chosen: np.ndarray | None = None) -> str:
    """The ranges of the inputs with their units, or of the chosen ones."""
    low, high = _range(commands.reshape(-1, commands.shape[-1]))
    ranges = [
        f"{n} {a:.3g} to {b:.3g}{with_space(u)}" for (n, u), a, b in zip(plant.inputs.items(), low, high, strict=True)
    ]
    return ", ".join(text for k, text in enumerate(ranges) if chosen is None or chosen[k])


def _range(commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    own = commands[np.isfinite(commands).all(axis=1)]
    if not len(own):
        nothing = np.full(commands.shape[1], np.nan)
        return nothing, nothing
    return own.min(axis=0), own.max(axis=0)


def _used(commands: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Share of the way from the middle to its limit that a command needs; above 1 it is outside.

    Where one side has no limit, the share is 0 inside and 2 outside.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        two_sided = np.abs(commands - (lower + upper) / 2) / ((upper - lower) / 2)
    one_sided = np.where((commands > upper) | (commands < lower), 2.0, 0.0)
    shares = np.where(np.isfinite(lower) & np.isfinite(upper), two_sided, one_sided)
    return np.asarray(np.where(np.isfinite(commands), shares, np.nan))


QUESTIONS = (
    ProblemQuestion(reference_free_of_jumps, JUMPS, order=10),
    ProblemQuestion(reference_keeps_limits, LIMITS, order=30),
    ProblemQuestion(inverse_exists, INVERSE, order=3, doubts=True),
    ProblemQuestion(commands_inside, COMMANDS, order=4, doubts=True),
)
