"""Is the reference free of jumps? A step by `if_else` has the derivative zero, so that no symbolic question sees it.

Differences over the run are compared with the derivatives that the reference gives. Over a smooth piece of length h

    v(t + h) - v(t) = h / 2 (v'(t) + v'(t + h)) + O(h^3),

and at a jump the rest is the jump, however small h is. The intervals with the largest rests are therefore halved until the rest has
vanished or is known to stay. A jump of the highest derivative is none of the reference's states, and does no harm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.question import ProblemQuestion
from fpirhc.task.problem import Problem

TEXT = "Is the reference free of jumps?"
_INTERVALS = 4000  # of the run
_LOOKED_AT = 6  # intervals with the largest rests, of every state
_HALVINGS = 40
_MARGIN = 1e-7  # on either side of a jump, as a share of the interval that holds it
_SIZE = 1e-4  # of a jump, as a share of the state's range

Motion = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Jump:
    """A jump of the reference.

    Args:
        state: name of the state of the reference.
        time: of the jump.
        size: of the jump, in the state's unit.
    """

    state: str
    time: float
    size: float


def jumps(problem: Problem) -> list[Jump]:
    """Return the jumps of those states of the reference that are tracked, judged or weighed, the first of each state."""
    motion = _motion(problem)
    times = np.linspace(0.0, problem.duration, min(_INTERVALS, problem.cycles) + 1)
    values, slopes = motion(times)
    rests = np.abs(_rests(times, values, slopes))
    scales = np.maximum(np.ptp(values, axis=1), 1e-12 * np.abs(values).max(axis=1, initial=0.0))
    detected = []
    for place, name in enumerate(problem.plant.output.elements):
        largest = np.sort(np.argsort(rests[place])[-_LOOKED_AT:])
        candidates = (_jump(motion, place, name, times[k], times[k + 1]) for k in largest)
        real = (one for one in candidates if abs(one.size) > _SIZE * scales[place] > 0)
        detected += [one for _, one in zip(range(1), real, strict=False)]
    return detected


def reference_free_of_jumps(grid: ReviewGrid) -> Answer:
    """Return whether a state of the reference jumps, where, and what to use instead; a map has differences instead."""
    problem = grid.problem
    if problem.plant.step is not None:
        text = "a map follows differences of the reference over its cycles, which a jump does not hide"
        return Answer(TEXT, Verdict.YES, text, "", {"jumps": 0.0})
    detected = jumps(problem)
    if not detected:
        return Answer(
            TEXT, Verdict.YES, "every state of the reference is the integral of the next one", "", {"jumps": 0.0}
        )
    units = dict(zip(problem.plant.output.elements, problem.plant.output.units, strict=True))
    listed = [f"{j.state} by {j.size:.3g} {units[j.state]} at t = {j.time:.4g} {problem.time_unit}" for j in detected]
    first = detected[0]
    numbers = {"jumps": float(len(detected)), "time": first.time, "size": first.size}
    text = (
        f"{', '.join(listed)}; its derivative there is not that of the expressions, so that no other answer covers it"
    )
    return Answer(TEXT, Verdict.NO, text, _instead(problem, first), numbers)


def _instead(problem: Problem, jump: Jump) -> str:
    """A set-point filtered by one pole more than the coordinate's order, with as many continuous derivatives."""
    plant = problem.plant
    order = plant.chains[jump.state.rstrip("'")]
    terms = ["1", "w*s", *(f"(w*s)**{k}/{_factorial(k)}" for k in range(2, order + 1))]
    return (
        f"Use a filtered set-point: 1 - ca.exp(-w*s) * ({' + '.join(terms)}) with s = ca.fmax(t - {jump.time:.4g}, 0) rises "
        f"from 0 to 1 and has {order} continuous derivative(s); choose the rate w, {problem.rate_unit}, that the limits allow."
    )


def _factorial(k: int) -> int:
    return k if k < 3 else k * _factorial(k - 1)


def _motion(problem: Problem) -> Motion:
    """Times (m,) -> states of the reference and their derivatives, shape (nx, m) each."""
    plant, function = problem.plant, problem.reference.function(problem.plant)
    elements, names = plant.output.elements, list(plant.chains)

    def values(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        states, responses = (np.asarray(v.full()) for v in function.map(len(times))(times[None, :]))
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


def _jump(motion: Motion, place: int, name: str, first: float, last: float) -> Jump:
    """What is left of an interval's rest after many halvings, each time of the half with the larger one."""
    margin = _MARGIN * (last - first)
    for _ in range(_HALVINGS):
        times = np.array([first, 0.5 * (first + last), last])
        rests = np.abs(_rests(times, *motion(times))[place])
        larger = int(np.argmax(rests))
        if rests[larger] == 0.0:
            break
        first, last = times[larger], times[larger + 1]
    # At its very time a kink has the mean of both slopes: half the jump stands on either side.
    around = np.array([first - margin, last + margin])
    time = 0.0 if last <= margin else float(last)
    return Jump(name, time, float(_rests(around, *motion(around))[place, 0]))


QUESTION = ProblemQuestion(ask=reference_free_of_jumps, order=10)
