"""Disturbances: what acts on the plant and no controller is told.

A disturbance is attached by name, to an input (it adds to the clipped command) or to a coordinate (it adds to the
response). It is sampled once per control cycle and held over the cycle.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.symbolic.layout import Expression


class Disturbance(ABC):
    """Contract: values at the given times."""

    @abstractmethod
    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return one value per time, shape (m,), in the unit of what it adds to."""


@dataclass(frozen=True)
class Step(Disturbance):
    """Zero before time `at` (s), `size` from then on."""

    at: float
    size: float

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:  # noqa: ARG002
        """Return the step's values."""
        return np.where(times >= self.at, self.size, 0.0)


@dataclass(frozen=True)
class Pulse(Disturbance):
    """`size` from time `at` for `duration` seconds, zero otherwise."""

    at: float
    duration: float
    size: float

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:  # noqa: ARG002
        """Return the pulse's values."""
        return np.where((times >= self.at) & (times < self.at + self.duration), self.size, 0.0)


@dataclass(frozen=True)
class Sine(Disturbance):
    """amplitude sin(2 pi frequency t + phase); frequency in Hz, phase in rad."""

    amplitude: float
    frequency: float
    phase: float = 0.0

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:  # noqa: ARG002
        """Return the sine's values."""
        return self.amplitude * np.sin(2 * np.pi * self.frequency * times + self.phase)


@dataclass(frozen=True)
class Noise(Disturbance):
    """White Gaussian noise of the given standard deviation, drawn from the run's seed."""

    deviation: float

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return the noise's values."""
        return random.normal(0.0, self.deviation, times.shape)


@dataclass(frozen=True, eq=False)
class Formula(Disturbance):
    """Any CasADi expression of time: Formula(lambda t: 3 * ca.tanh(t - 1))."""

    expression: Callable[[Expression], Expression]

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:  # noqa: ARG002
        """Return the expression's values.

        Raises:
            InvalidValue: some value is not finite.
        """
        t = ca.SX.sym("t")
        function = ca.Function("fpirhc_disturbance", [t], [self.expression(t)])
        found = np.asarray(function.map(times.size)(times[None, :]).full()).ravel()
        if not np.all(np.isfinite(found)):
            where = times[np.argmin(np.isfinite(found))]
            raise InvalidValue(f"a disturbance expression is not finite at t = {where:g} s")
        return found
