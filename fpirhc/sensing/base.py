"""The contract of derivative estimators, state and response from the measured quantities; and the one that needs no formula.

Theory: docs/theory-estimation.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.fields.checked import Checked
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal

Array: TypeAlias = np.ndarray


class DerivativeEstimator(Checked, ABC):
    """Contract: a block from the measured quantities to the controller's 'state' and 'realised'."""

    @property
    def measures_all(self) -> bool:
        """Whether state and response are both measured, so that nothing is estimated."""
        return False

    @property
    def of_steps(self) -> bool:
        """Whether it takes differences of a map's steps; False for derivatives with respect to time."""
        return False

    @abstractmethod
    def measures(self, plant: Plant) -> tuple[str, ...]:
        """Names of the measured quantities: state elements, and highest derivatives of controlled coordinates."""

    def known(self, plant: Plant, measured: Sequence[str]) -> tuple[str, ...]:
        """State elements that follow from these measured quantities alone; by default those among them."""
        return tuple(e for e in plant.output.elements if e in measured)

    def answers(self, plant: Plant) -> tuple[str, ...]:
        """Names of the measured quantities that the response follows from; by default all."""
        return self.measures(plant)

    @abstractmethod
    def block(self, plant: Plant, period: float, start: Array, seen: Signal) -> Block:
        """Block (seen) -> (state, realised).

        Args:
            plant: the plant that is measured.
            period: control cycle, s.
            start: first state of the problem, shape (nx,).
            seen: signal of the quantities in `measures`.
        """

    @property
    def shows_response(self) -> bool:
        """Whether the response itself is measured, and so belongs to this instant; False by default."""
        return False

    @abstractmethod
    def weights(self, order: int, period: float) -> Array:
        """Weights w_1, w_2, ... of past requests in the estimated response of a coordinate of that order."""

    @abstractmethod
    def delay(self, order: int, period: float) -> float:
        """Delay of the response in cycles, beyond the ideal pair: the weights' centre."""

    @abstractmethod
    def fills(self, order: int) -> int:
        """Number of the first cycle (from 0) whose response depends on this run's samples alone."""

    def settles(self, order: int, period: float) -> int:  # noqa: ARG002
        """Number of further cycles in which a jump of what is measured decays, where it begins anew in it; by default none."""
        return 0

    def check(self, plant: Plant) -> None:
        """Raise if the estimator cannot serve the plant.

        Raises:
            InvalidValue: with a remedy.
        """


def known_by_positions(plant: Plant, measured: Sequence[str]) -> tuple[str, ...]:
    """State elements of the coordinates that are measured: their derivatives are estimated."""
    return tuple(e for e in plant.output.elements if e.rstrip("'") in measured)


def response_names(plant: Plant) -> tuple[str, ...]:
    """Names of the highest derivatives of the controlled coordinates: "q1''"; of order 0 it is the output's own name."""
    return tuple(name + "'" * order for name, order in plant.response_orders.items())


def quantities(plant: Plant) -> tuple[str, ...]:
    """Names of all that a sensor may show: states, outputs and their derivatives, and the highest ones of controlled quantities."""
    return tuple(dict.fromkeys((*plant.state.elements, *plant.output.elements, *response_names(plant))))


def values_of(plant: Plant, x: ca.SX, u: ca.SX, p: ca.SX) -> dict[str, ca.SX]:
    """Return everything that a sensor may show as expressions of the state and the input that acted, by name."""
    responses = ca.vertsplit(plant.equations.controlled_response(x, u, p))
    named = dict(zip(plant.state.elements, ca.vertsplit(x), strict=True))
    outputs = ca.vertsplit(plant.equations.output(x, u, p, np.zeros(len(plant.names))))
    named = {**dict(zip(plant.output.elements, outputs, strict=True)), **named}
    return {**named, **dict(zip(response_names(plant), responses, strict=True))}


def names_of_responses(plant: Plant, signal: Signal) -> tuple[str, ...]:
    """Names of the entries of a signal of responses: highest derivatives of coordinates, and others as they are."""
    orders = plant.equations.output_orders
    return tuple(e + "'" * orders.get(e, 0) for e in signal.elements)


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

    @property
    def measures_all(self) -> bool:
        return True

    def measures(self, plant: Plant) -> tuple[str, ...]:
        return tuple(dict.fromkeys(plant.output.elements + response_names(plant)))

    def answers(self, plant: Plant) -> tuple[str, ...]:
        return response_names(plant)

    def block(self, plant: Plant, period: float, start: Array, seen: Signal) -> Block:
        del period, start
        realised = plant.response_signal("realised")
        responses = [seen.elements.index(name) for name in response_names(plant)]

        def step(s: Signals) -> dict[str, Expression]:
            both = getattr(s, seen.name)
            return {plant.output.name: both[: plant.output.size], "realised": both[responses]}

        return Block("estimate", Layout((seen,)), Layout((plant.output, realised)), step)

    @property
    def shows_response(self) -> bool:
        return True

    def weights(self, order: int, period: float) -> Array:
        del order, period
        return np.ones(1)

    def delay(self, order: int, period: float) -> float:
        del order, period
        return 0.0

    def fills(self, order: int) -> int:
        del order
        return 1


EXAMPLES = (Measured(),)
