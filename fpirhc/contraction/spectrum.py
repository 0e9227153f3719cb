"""Eigenvalues of the response Jacobian J = df/dr, over a run or over a box of parameters."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidName, InvalidShape, InvalidValue, nearest
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.evaluate import require_unsolved
from fpirhc.symbolic.expression import kind

Array: TypeAlias = np.ndarray

LARGEST_SAMPLE = 2000  # cycles of a run whose eigenvalues are computed; longer runs are thinned evenly
_NO_SIGN = 1e-9  # real parts below this share of the largest eigenvalue have no sign


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigenvalues of the response Jacobian.

    Args:
        eigenvalues: one row per sample, shape (samples, n), complex; rows that are not finite are left out.

    Raises:
        InvalidValue: no row is finite.
    """

    eigenvalues: Array

    def __post_init__(self) -> None:
        rows = np.atleast_2d(np.asarray(self.eigenvalues, dtype=complex))
        finite = rows[np.isfinite(rows).all(axis=1)]
        if finite.size == 0:
            raise InvalidValue(
                "no finite eigenvalue of the response Jacobian: the inverse response is singular at every sample; "
                "check that the inputs act on the controlled coordinates there"
            )
        values = np.array(finite)
        values.setflags(write=False)
        object.__setattr__(self, "eigenvalues", values)

    @cached_property
    def smallest_real(self) -> float:
        """Smallest real part."""
        return float(self.eigenvalues.real.min())

    @cached_property
    def largest_real(self) -> float:
        """Largest real part."""
        return float(self.eigenvalues.real.max())

    @cached_property
    def one_sign(self) -> bool:
        """Whether all real parts have the same sign and none is zero."""
        small = _NO_SIGN * float(np.abs(self.eigenvalues).max())
        return self.smallest_real > small or self.largest_real < -small


@lru_cache(maxsize=16)  # one run needs it several times
def response_jacobian(plant: Plant) -> ca.Function:
    """Return Function (state, deformed, exact, approximate) -> J = df/dr of the controlled coordinates, n x n.

        f(r) = response(state, inverse(state, r; approximate); exact)

    Raises:
        NotInvertible: the inputs and the controlled coordinates differ in number.
    """
    matrix = kind(plant.equations.inverse_opaque)
    x = matrix.sym("x", plant.state.size)
    r = matrix.sym("r", len(plant.controlled_names))
    exact = matrix.sym("exact", plant.parameter.size if plant.parameters else 0)
    assumed = matrix.sym("approximate", exact.numel())
    realised = plant.equations.controlled_response(x, plant.equations.inverse(x, r, assumed), exact)
    jacobian = ca.densify(ca.jacobian(realised, r))
    names = ["state", "deformed", "exact", "approximate"]
    return ca.Function("fpirhc_response_jacobian", [x, r, exact, assumed], [jacobian], names, ["jacobian"])


def spectrum_over_run(
    plant: Plant, states: Array, deformed: Array, *, exact: Array | None = None, approximate: Array | None = None
) -> Spectrum:
    """Return the eigenvalues of J along a run; long runs are thinned to `LARGEST_SAMPLE` cycles.

    Args:
        plant: that ran.
        states: state of every cycle, shape (cycles, nx).
        deformed: request of every cycle, shape (cycles, n).
        exact: parameters of the plant, shape (np,); None: the plant's own.
        approximate: parameters of the model, shape (np,); None: the plant's own.

    Raises:
        InvalidShape: arrays that do not fit the plant or each other.
        InvalidValue: no finite eigenvalue.
    """
    states, deformed = _checked_rows(plant, states, deformed)
    rows = _thinned(len(states))
    true = plant.exact if exact is None else np.asarray(exact, dtype=float)
    parameters = np.repeat(true[None, :], len(rows), axis=0)
    return _spectrum(plant, states[rows], deformed[rows], parameters, approximate)


def spectrum_over_box(
    plant: Plant, box: Mapping[str, tuple[float, float]], states: Array, deformed: Array, *, samples: int, seed: int
) -> Spectrum:
    """Return the eigenvalues of J for exact parameters drawn from a box, at states drawn from the given rows.

    Every corner of the box is a sample where there are at least as many samples as corners; the other samples are uniform.
    Parameters that the box does not name keep the plant's exact value.

    Args:
        plant: whose exact parameters vary.
        box: parameter -> (lower, upper), in its unit.
        states: states to draw from, shape (rows, nx).
        deformed: the requests at these states, shape (rows, n).
        samples: number of draws.
        seed: of the draws.

    Raises:
        InvalidName: the box names an unknown parameter.
        InvalidValue: an interval whose ends are swapped or not finite, or fewer than one sample.
        InvalidShape: arrays that do not fit the plant or each other.
    """
    states, deformed = _checked_rows(plant, states, deformed)
    if samples < 1:
        raise InvalidValue(f"samples={samples}: expected at least 1")
    lower, upper = _box_ends(plant, box)
    generator = np.random.default_rng(seed)
    parameters = generator.uniform(lower, upper, size=(samples, lower.size))
    places = [list(plant.parameters).index(name) for name in box]
    if 2 ** len(places) <= samples:
        for row, upper_ends in enumerate(itertools.product((False, True), repeat=len(places))):
            parameters[row, places] = np.where(upper_ends, upper[places], lower[places])
    rows = generator.integers(len(states), size=samples)
    return _spectrum(plant, states[rows], deformed[rows], parameters, None)


def factors_along(cycles: int, jacobians_at: Callable[[Array], Array], effective_gain: float) -> Array:
    """Return the predicted factor max|1 - a lambda| of every cycle of a run, shape (cycles,); every entry is a number.

    Long runs are evaluated at `LARGEST_SAMPLE` cycles, and in between the last value holds. Where J is singular or not
    finite nothing contracts, and the factor is 1.

    Args:
        cycles: number of cycles of the run.
        jacobians_at: function of the numbers of some cycles -> their Jacobians, shape (cycles, n, n).
        effective_gain: a of the deformation.
    """
    rows = _thinned(cycles)
    jacobians = jacobians_at(rows)
    finite = np.isfinite(jacobians).all(axis=(1, 2))
    factors = np.ones(len(rows))
    factors[finite] = np.abs(1 - effective_gain * np.linalg.eigvals(jacobians[finite])).max(axis=1)
    return factors[np.searchsorted(rows, np.arange(cycles), side="right") - 1]


def response_jacobians(plant: Plant, states: Array, deformed: Array, exact: Array, approximate: Array | None) -> Array:
    """Return J of every row, shape (rows, n, n); not finite where the model's inverse is not.

    Args:
        plant: whose response is differentiated.
        states: shape (rows, nx).
        deformed: requests, shape (rows, n).
        exact: parameters of the plant, one set per row, shape (rows, np).
        approximate: parameters of the model, shape (np,), or one set per row; None: the plant's own.
    """
    model = plant.approximate if approximate is None else np.asarray(approximate, dtype=float)
    function, n = response_jacobian(plant), deformed.shape[1]
    count = len(states)
    assumed = np.broadcast_to(model, (count, model.shape[-1]))
    try:
        stacked = function.map(count)(states.T, deformed.T, exact.T, assumed.T).full()
    except RuntimeError as error:  # Newton's method has no derivative where the inputs have no effect
        require_unsolved(error)
        stacked = np.hstack([_value(function, n, row) for row in zip(states, deformed, exact, assumed, strict=True)])
    return np.asarray(stacked).reshape((n, count, n)).transpose(1, 0, 2)


def _value(function: ca.Function, n: int, row: tuple[Array, ...]) -> Array:
    """The Jacobian of one row; NaN where it cannot be computed."""
    try:
        return np.asarray(function(*row).full())
    except RuntimeError as error:
        require_unsolved(error)
        return np.full((n, n), np.nan)


def _thinned(cycles: int) -> Array:
    """Numbers of at most `LARGEST_SAMPLE` cycles, evenly chosen, with the first and the last."""
    return np.unique(np.linspace(0, cycles - 1, min(cycles, LARGEST_SAMPLE)).astype(int))


def _spectrum(plant: Plant, states: Array, deformed: Array, exact: Array, approximate: Array | None) -> Spectrum:
    jacobians = response_jacobians(plant, states, deformed, exact, approximate)
    finite = jacobians[np.isfinite(jacobians).all(axis=(1, 2))]
    return Spectrum(np.linalg.eigvals(finite))


def _checked_rows(plant: Plant, states: Array, deformed: Array) -> tuple[Array, Array]:
    states = np.atleast_2d(np.asarray(states, dtype=float))
    deformed = np.atleast_2d(np.asarray(deformed, dtype=float))
    widths = (plant.state.size, len(plant.controlled_names))
    if (states.shape[1], deformed.shape[1]) != widths or len(states) != len(deformed):
        raise InvalidShape(
            f"states {states.shape} and deformed {deformed.shape}: expected (cycles, {widths[0]}) "
            f"and (cycles, {widths[1]})"
        )
    if len(states) == 0:
        raise InvalidShape("states and deformed have no rows; give at least one state and request")
    return states, deformed


def _box_ends(plant: Plant, box: Mapping[str, tuple[float, float]]) -> tuple[Array, Array]:
    lower, upper = plant.exact.copy(), plant.exact.copy()
    names = list(plant.parameters)
    for name, (low, high) in box.items():
        if name not in names:
            raise InvalidName(f"box: parameter '{name}' is unknown.{nearest(name, names)}")
        if not -np.inf < low <= high < np.inf:
            raise InvalidValue(f"box: '{name}' is from {low!r} to {high!r}; expected finite ends with lower <= upper")
        lower[names.index(name)], upper[names.index(name)] = low, high
    return lower, upper
