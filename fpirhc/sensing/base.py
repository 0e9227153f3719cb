"""The contracts of derivative estimators and of state observers, a plant that is measured as a whole, and what never shows.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias, final

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.checked import Checked
from fpirhc.plant.chain import require_derivatives, response_names
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal

Array: TypeAlias = np.ndarray


class DerivativeEstimator(Checked, ABC):
    """Contract: a block from the measured quantities to the controller's 'state' and 'realised'."""

    @abstractmethod
    def measures(self, plant: Plant) -> tuple[str, ...]:
        """Names of the measured quantities: state elements, and highest derivatives of controlled coordinates."""

    @abstractmethod
    def block(self, plant: Plant, period: float, start: Array, seen: Signal) -> Block:
        """Block (seen) -> (state, realised).

        Args:
            plant: the plant that is measured.
            period: control cycle, s.
            start: first state of the problem, shape (nx,).
            seen: signal of the quantities in `measures`.
        """

    @abstractmethod
    def weights(self, order: int, period: float) -> Array:
        """Weights w_1, w_2, ... of past requests in the estimated response of a coordinate of that order."""

    def fills(self, order: int) -> int:  # noqa: ARG002
        """Number of the first cycle (from 0) whose response is of this run's samples alone: 1, or 0 where all is measured."""
        return 1

    @final
    @cached_property
    def measures_all(self) -> bool:
        """Whether state and response are both measured, so that nothing is estimated."""
        return self.fills(1) == 0

    def check(self, plant: Plant) -> None:
        """Raise if the estimator cannot serve the plant; by default it estimates derivatives."""
        require_derivatives(plant, type(self).__name__, of_time=True, instead="leave the estimator out")


def values_of(plant: Plant, x: ca.SX, u: ca.SX, p: ca.SX) -> dict[str, ca.SX]:
    """Return everything that a sensor may show as expressions of the state and the input that acted, by name."""
    responses = ca.vertsplit(plant.equations.controlled_response(x, u, p))
    named = dict(zip(plant.state.elements, ca.vertsplit(x), strict=True))
    outputs = ca.vertsplit(plant.equations.output(x, u, p, np.zeros(len(plant.names))))
    named = {**dict(zip(plant.output.elements, outputs, strict=True)), **named}
    return {**named, **dict(zip(response_names(plant), responses, strict=True))}


def spline_weights(order: int) -> Array:
    """Weights A(n, j) / n! of the last n held values of y^(n) in the n-th difference of y over T^n."""
    row = np.ones(1)
    for n in range(2, order + 1):
        j = np.arange(n)
        row = (j + 1) * np.append(row, 0.0) + (n - j) * np.append(0.0, row)
    return np.asarray(row / math.factorial(order))


def backward_difference(degree: int) -> Array:
    """Coefficients of y_k, y_{k-1}, ... in the difference of that degree."""
    return np.array([(-1.0) ** j * math.comb(degree, j) for j in range(degree + 1)])


def combine(coefficients: Array, samples: Sequence[Expression]) -> Expression:
    """Return the sum of samples (newest first) times coefficients; terms with a zero coefficient are left out."""
    return sum(c * s for c, s in zip(coefficients, samples, strict=True) if c != 0)


@dataclass(frozen=True)
class Measured(DerivativeEstimator):
    """State and response as the sensors show them, without delay."""

    def check(self, plant: Plant) -> None:
        """Serve every plant: nothing is estimated."""

    def fills(self, order: int) -> int:  # noqa: ARG002
        return 0

    def measures(self, plant: Plant) -> tuple[str, ...]:
        return tuple(dict.fromkeys(plant.output.elements + response_names(plant)))

    def weights(self, order: int, period: float) -> Array:
        del order, period
        return np.ones(1)

    def block(self, plant: Plant, period: float, start: Array, seen: Signal) -> Block:
        del period, start
        realised = plant.response_signal("realised")
        responses = [seen.elements.index(name) for name in response_names(plant)]

        def step(s: Signals) -> dict[str, Expression]:
            both = getattr(s, seen.name)
            return {plant.output.name: both[: plant.output.size], "realised": both[responses]}

        return Block("estimate", Layout((seen,)), Layout((plant.output, realised)), step)


EXAMPLES = (Measured(),)


Remembered: TypeAlias = Mapping[str, Expression]


@dataclass(frozen=True, eq=False)
class Model:
    """What an observer is built from.

    Args:
        move: Function (state, input, parameters, forcing, whether it moves) -> state a cycle later, or the same one.
        start: first state, shape (nx,).
    """

    plant: Plant
    move: ca.Function
    start: np.ndarray
    measured: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Evidence:
    """Data of an observer in one cycle."""

    measured: Mapping[str, Expression]  # what the sensors show, by name of the quantity
    command: Expression  # it acted until the sample was taken
    parameters: Expression  # of the model
    moves: Expression  # 1 where the sample is a cycle later than the last one, 0 where it still shows the start
    counts: Expression  # 1 where the sample was taken in this run, and is not the start again that fills a dead time


Predict: TypeAlias = Callable[[Evidence, Remembered], Expression]
Correct: TypeAlias = Callable[[Evidence, Remembered, Expression], tuple[Expression, dict[str, Expression]]]


class StateObserver(Checked, ABC):
    """Contract: a frozen value that becomes a prediction and a correction of the model's state."""

    @abstractmethod
    def check(self, plant: Plant, measured: tuple[str, ...]) -> None:
        """Raise if it cannot serve the plant with these measured quantities.

        Raises:
            InvalidProblem: all mistakes together.
        """

    def uses(self, measured: tuple[str, ...]) -> tuple[str, ...]:
        """Names of the measured quantities that correct the state; by default all."""
        return measured

    @abstractmethod
    def memory(self, model: Model) -> Layout:
        """Signals that are remembered from cycle to cycle."""

    @abstractmethod
    def predict(self, model: Model) -> Predict:
        """Function (evidence, memory) -> predicted state x-."""

    @abstractmethod
    def correct(self, model: Model) -> Correct:
        """Function (evidence, memory, predicted state) -> (state x^, memory one cycle later)."""


def require_named(owner: str, **named: Mapping[str, float]) -> None:
    """Raise InvalidValue for a mapping without entries."""
    for name, values in named.items():
        if not values:
            raise InvalidValue(f"{owner}({name}={{}}): name at least one")


_NOTHING = 1e-9  # share of a matrix below which a part of it counts as zero


def unobservable(slopes: Sequence[np.ndarray], shown: Sequence[np.ndarray]) -> np.ndarray:
    """Return an orthonormal basis of the errors that never show, shape (nx, number).

    Args:
        slopes: A_i, each (nx, nx), in states of size one.
        shown: C_i, each (number, nx), in states of size one.
    """
    basis = _kernel(np.vstack([_rows_of_size_one(c) for c in shown]))
    motions = [a / max(np.abs(a).max(), np.finfo(float).tiny) for a in slopes]
    while basis.shape[1]:
        leaving = np.vstack([a @ basis - basis @ (basis.T @ (a @ basis)) for a in motions])
        staying = _kernel(leaving)
        if staying.shape[1] == basis.shape[1]:
            break
        basis = basis @ staying
    return basis


def members(basis: np.ndarray) -> list[int]:
    """Return the places of the states that have a part in these errors."""
    return [k for k, row in enumerate(basis) if np.abs(row).max(initial=0.0) > 1e-6]


def slowest(
    slopes: Sequence[np.ndarray], basis: np.ndarray, growth: Callable[[np.ndarray], np.ndarray] = np.real
) -> float:
    """Return the largest real part of the poles with which these errors move, in 1 / unit of time; negative: all decay.

    `growth`: of poles; of a map's divided differences it is not the real part (`fpirhc.plant.maps.growth_rates`).
    """
    if not basis.shape[1]:
        return -np.inf
    dual = np.linalg.pinv(basis)
    return max(float(growth(np.linalg.eigvals(dual @ a @ basis)).max()) for a in slopes)


def _kernel(matrix: np.ndarray) -> np.ndarray:
    _, values, rows = np.linalg.svd(matrix, full_matrices=True)
    rank = int((values > _NOTHING).sum())
    return np.asarray(rows[rank:].T)


def _rows_of_size_one(matrix: np.ndarray) -> np.ndarray:
    """The matrix with rows of size one at most; rows of zero stay zero."""
    largest = np.abs(matrix).max(axis=1, keepdims=True)
    return np.asarray(matrix / np.where(largest > 0, largest, 1.0))
