"""The points of a review: points of the reference, and draws of the exact parameters from their box.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.controllers.reference_states import nominal_motion
from fpirhc.horizon.nominal import filled
from fpirhc.plant.mismatch import exact_ranges
from fpirhc.review.inner import inner_motion, inner_places
from fpirhc.task.problem import Problem

_POINTS = 41
_DRAWS = 64
_INNER_DRAWS = 16  # where each has inner states that are simulated
_FINE = 2001  # times of the plant's own inner states


@dataclass(frozen=True, eq=False)
class ReviewGrid:
    """Points of the reference and draws of the parameters; build it with `review_grid`.

    Args:
        problem: the problem.
        times: times of the points, shape (m,).
        states: states of the reference, shape (m, nx); inner ones are simulated with the exact parameters, see `inner`.
        responses: responses of the controlled coordinates that the reference needs, shape (m, n).
        draws: exact parameters, shape (draws, np); the first row is the plant's own.
        inner: places of the simulated states.
        mismatch: range of the exact parameters and of the dead times, percent.
        real: the problem with its reality, where it has one that is a plant; `problem` is then that of the model alone.
        elsewhere: whether a run moves something else than the model's plant, so that its exact parameters move nothing.
    """

    problem: Problem
    times: np.ndarray
    states: np.ndarray
    responses: np.ndarray
    draws: np.ndarray
    inner: tuple[int, ...] = ()
    mismatch: float = 0.0
    real: Problem | None = None
    elsewhere: bool = False

    @property
    def outside(self) -> bool:
        """Whether the plant is a simulator of somebody else, which a review does not run."""
        return self.elsewhere and self.real is None

    @cached_property
    def drawn_states(self) -> np.ndarray:
        """States of the reference with the inner states that each draw has, shape (draws, m, nx)."""
        states = np.tile(self.states, (len(self.draws), 1, 1))
        if self.inner:
            for rows, motion in zip(
                states[1:], inner_motion(self.problem, self.inner, self.draws[1:], self.times), strict=True
            ):
                rows[:, list(self.inner)] = np.nan if motion is None else motion
        return states

    def states_at(self, times: np.ndarray) -> np.ndarray:
        """Return states of the reference with the plant's own inner states, shape (k, nx)."""
        plant = self.problem.plant
        followed = np.asarray(self.problem.reference.function(plant).map(len(times))(times[None, :])[0].full()).T
        states = filled(plant, followed)
        if self.inner:
            grid, motion = self._fine
            for place, column in zip(self.inner, motion.T, strict=True):
                states[:, place] = np.interp(times, grid, column)
        return states

    @cached_property
    def _fine(self) -> tuple[np.ndarray, np.ndarray]:
        """Times, and the inner states with the exact parameters."""
        times = np.linspace(0.0, self.problem.duration, _FINE)
        [motion] = inner_motion(self.problem, self.inner, self.draws[:1], times)
        if motion is None:  # the coarse points, which `review_grid` has found finite
            return self.times, self.states[:, list(self.inner)]
        return times, motion

    @cached_property
    def commands(self) -> np.ndarray:
        """Inputs that the reference needs, per draw and point, shape (draws, m, nu); NaN where there is no inverse."""
        m, k = len(self.times), len(self.draws)
        states, responses = self.drawn_states.reshape(k * m, -1), np.tile(self.responses, (k, 1))
        commands = each(self.problem.plant.equations.inverse, states, responses, np.repeat(self.draws, m, axis=0))
        return commands.reshape(k, m, -1)

    def needed(self, parameters: np.ndarray) -> np.ndarray:
        """Inputs that the reference needs with these parameters, shape (m, nu)."""
        return each(self.problem.plant.equations.inverse, self.states, self.responses, self._rows(parameters))

    def requests(self, believed: np.ndarray) -> np.ndarray:
        """Requests r* of a controller with the believed parameters along the reference, shape (m, n)."""
        function = self.problem.plant.equations.controlled_response
        return each(function, self.states, self.commands[0], self._rows(believed))

    def _rows(self, parameters: np.ndarray) -> np.ndarray:
        return np.tile(parameters, (len(self.times), 1))


def review_grid(problem: Problem, mismatch: float, seed: int) -> ReviewGrid:
    """Return the points and draws of a review.

    Args:
        problem: the problem.
        mismatch: range of the exact parameters, percent, see `fpirhc.plant.mismatch`.
        seed: of the draws.

    Raises:
        NotInvertible: the inputs and the controlled coordinates differ in number.
    """
    elsewhere, known = problem.reality is not None, problem.of_equations
    real = known if known.reality else None
    problem = problem.of_model
    plant = problem.plant
    times = np.linspace(0.0, problem.duration, _POINTS)
    nominal = nominal_motion(problem).map(_POINTS)(times[None, :])
    followed, responses = (np.asarray(v.full()).T for v in nominal)
    states = filled(plant, followed)
    ranges = exact_ranges(plant, mismatch)
    lower, upper = (np.array([ranges[name][k] for name in plant.parameters]) for k in (0, 1))
    inner = inner_places(problem)
    draws = _draws(lower, upper, plant.approximate, np.random.default_rng(seed), _INNER_DRAWS if inner else _DRAWS)
    rows = np.vstack([plant.exact[None, :], draws])
    own = inner_motion(problem, inner, rows[:1], times)[0] if inner else None
    if own is None:
        inner = ()
    else:
        states[:, list(inner)] = own
    return ReviewGrid(problem, times, states, responses, rows, inner, mismatch, real, elsewhere)


def _draws(
    lower: np.ndarray, upper: np.ndarray, approximate: np.ndarray, random: np.random.Generator, most: int
) -> np.ndarray:
    """Corners of the range, all of them where they are few; the approximate parameters; and points inside and between."""
    free = np.flatnonzero(upper > lower)
    corners = np.zeros((0, lower.size))
    if free.size:
        if 2**free.size <= most:
            signs = np.array(np.meshgrid(*[[0.0, 1.0]] * free.size)).reshape(free.size, -1).T
        else:
            signs = random.integers(0, 2, size=(most, free.size)).astype(float)
        corners = np.repeat(lower[None, :], len(signs), axis=0)
        corners[:, free] += signs * (upper - lower)[free]
    if not free.size and np.array_equal(lower, approximate):
        return corners
    inside = lower + random.uniform(size=(most // 2, lower.size)) * (upper - lower)
    # Without a mismatch the range is a point, and the draws are evenly spaced on the way to the approximate parameters.
    shares = (random.uniform(size=most // 2) if free.size else np.arange(1, most // 2 + 1) / (most // 2 + 1))[:, None]
    return np.vstack([corners, approximate[None, :], (1 - shares) * inside + shares * approximate])


def each(function: ca.Function, *arguments: np.ndarray) -> np.ndarray:
    """Return the values of a Function of columns at every row of its arguments, shape (rows, size)."""
    table = function.map(len(arguments[0]))(*(rows.T for rows in arguments))
    return np.asarray(table.full()).T
