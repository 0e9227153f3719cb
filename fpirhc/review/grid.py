"""The points of a review: points of the reference, and draws of the exact parameters from their box.

The box of a parameter spans the range of its exact value (see `fpirhc.plant.mismatch`) and its approximate value. At every point
the symbols give the input u* that the reference needs and the request r* for which the model computes this input:

    u* = inverse(x^N, r^N; exact),        r* = response(x^N, u*; approximate),

so that f(r*) = r^N: r* is the fixed point that a deformation is to find.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.plant.mismatch import exact_ranges
from fpirhc.task.problem import Problem

_POINTS = 41
_DRAWS = 64


@dataclass(frozen=True, eq=False)
class ReviewGrid:
    """Points of the reference and draws of the parameters; build it with `review_grid`.

    Args:
        problem: the problem.
        times: times of the points, s, shape (m,).
        states: states of the reference, shape (m, nx).
        responses: responses of the controlled coordinates that the reference needs, shape (m, n).
        draws: exact parameters, shape (draws, np); the first row is the plant's own.
        mismatch: range of the exact parameters and of the dead times, percent.
    """

    problem: Problem
    times: np.ndarray
    states: np.ndarray
    responses: np.ndarray
    draws: np.ndarray
    mismatch: float = 0.0

    @cached_property
    def commands(self) -> np.ndarray:
        """Inputs that the reference needs, per draw and point, shape (draws, m, nu); NaN where there is no inverse."""
        m, k = len(self.times), len(self.draws)
        states, responses = (np.tile(rows, (k, 1)) for rows in (self.states, self.responses))
        commands = each(self.problem.plant.inverse_function, states, responses, np.repeat(self.draws, m, axis=0))
        return commands.reshape(k, m, -1)

    def needed(self, parameters: np.ndarray) -> np.ndarray:
        """Inputs that the reference needs with these parameters, shape (m, nu)."""
        return each(self.problem.plant.inverse_function, self.states, self.responses, self._rows(parameters))

    def requests(self, believed: np.ndarray) -> np.ndarray:
        """Requests r* of a controller with the believed parameters along the reference, shape (m, n)."""
        function = self.problem.plant.controlled_response_function
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
    plant = problem.plant
    function = problem.reference.function(plant)
    times = np.linspace(0.0, problem.duration, _POINTS)
    nominal = function.map(_POINTS)(times[None, :])
    states, responses = (np.asarray(v.full()).T for v in nominal)
    box = parameter_box(problem, mismatch)
    lower, upper = (np.array([box[name][k] for name in plant.parameters]) for k in (0, 1))
    draws = _draws(lower, upper, np.random.default_rng(seed))
    rows = np.vstack([plant.exact[None, :], draws])
    return ReviewGrid(problem, times, states, responses[:, list(plant.controlled_indices)], rows, mismatch)


def parameter_box(problem: Problem, mismatch: float) -> dict[str, tuple[float, float]]:
    """Return the interval of every parameter of the plant: the range of the exact value, extended to the approximate one.

    Raises:
        InvalidValue, InvalidProblem: see `exact_ranges`.
    """
    ranges, parameters = exact_ranges(problem.plant, mismatch), problem.plant.parameters
    return {
        n: (min(parameters[n].approximate, low), max(parameters[n].approximate, high))
        for n, (low, high) in ranges.items()
    }


def _draws(lower: np.ndarray, upper: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """All corners of the box where they are few, else random corners; and as many random points inside."""
    free = np.flatnonzero(upper > lower)
    if not free.size:
        return np.zeros((0, lower.size))
    if 2**free.size <= _DRAWS:
        corners = np.array(np.meshgrid(*[[0.0, 1.0]] * free.size)).reshape(free.size, -1).T
    else:
        corners = random.integers(0, 2, size=(_DRAWS, free.size)).astype(float)
    shares = np.vstack([corners, random.uniform(size=(len(corners), free.size))])
    rows = np.repeat(lower[None, :], len(shares), axis=0)
    rows[:, free] += shares * (upper - lower)[free]
    return rows


def each(function: ca.Function, *arguments: np.ndarray) -> np.ndarray:
    """Return the values of a Function of columns at every row of its arguments, shape (rows, size)."""
    table = function.map(len(arguments[0]))(*(rows.T for rows in arguments))
    return np.asarray(table.full()).T
