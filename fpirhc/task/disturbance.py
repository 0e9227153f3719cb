"""Disturbances: what acts on the plant and no controller is told.

A disturbance is attached by name, to an input (it adds to the clipped command) or to a coordinate (it adds to the
response). It is sampled once per control cycle and held over the cycle.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.signal import lfilter

from fpirhc.errors import InvalidValue
from fpirhc.symbolic.layout import Expression


class Disturbance(ABC):
    """Contract: values at the given times, and how suddenly and how fast they change, as far as that is known."""

    @property
    def jump(self) -> float:
        """Size of its largest sudden change, in the unit of what it adds to; zero where it has none or it is not known."""
        return 0.0

    @property
    def slew(self) -> float:
        """How fast it changes otherwise, per second; zero where that is not known, and for noise, which is no motion to follow."""
        return 0.0

    @abstractmethod
    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return one value per time, shape (m,), in the unit of what it adds to."""


@dataclass(frozen=True)
class Step(Disturbance):
    """Zero before time `at` (s), `size` from then on."""

    at: float
    size: float

    @property
    def jump(self) -> float:
        """The size."""
        return abs(self.size)

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:  # noqa: ARG002
        """Return the step's values."""
        return np.where(times >= self.at, self.size, 0.0)


@dataclass(frozen=True)
class Pulse(Disturbance):
    """`size` from time `at` for `duration` seconds, zero otherwise."""

    at: float
    duration: float
    size: float

    @property
    def jump(self) -> float:
        """The size."""
        return abs(self.size)

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:  # noqa: ARG002
        """Return the pulse's values."""
        return np.where((times >= self.at) & (times < self.at + self.duration), self.size, 0.0)


@dataclass(frozen=True)
class Sine(Disturbance):
    """amplitude sin(2 pi frequency t + phase); frequency in Hz, phase in rad."""

    amplitude: float
    frequency: float
    phase: float = 0.0

    @property
    def slew(self) -> float:
        """2 pi frequency amplitude."""
        return abs(2 * math.pi * self.frequency * self.amplitude)

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:  # noqa: ARG002
        """Return the sine's values."""
        return self.amplitude * np.sin(2 * np.pi * self.frequency * times + self.phase)


@dataclass(frozen=True)
class Noise(Disturbance):
    """White Gaussian noise of the given standard deviation, drawn from the run's seed.

    Raises:
        InvalidValue: a deviation that is negative or not finite.
    """

    deviation: float

    def __post_init__(self) -> None:
        _check_deviation(self)

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return the noise's values."""
        return random.normal(0.0, self.deviation, times.shape)


@dataclass(frozen=True)
class ColouredNoise(Disturbance):
    """Gaussian noise of the given standard deviation that forgets: correlation exp(-|t - t'| / correlation_time).

        v_k = c v_{k-1} + sqrt(1 - c^2) deviation w_k,     c = exp(-T / correlation_time),

    begun in its stationary distribution. It needs equally spaced times.

    Raises:
        InvalidValue: a deviation that is negative or not finite, a correlation time (s) that is not positive.
    """

    deviation: float
    correlation_time: float

    def __post_init__(self) -> None:
        _check_deviation(self)
        if not 0 < self.correlation_time < math.inf:
            raise InvalidValue(
                f"ColouredNoise(correlation_time={self.correlation_time!r}): expected a positive number of seconds; "
                "noise that forgets at once is Noise(deviation=...)"
            )

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return the noise's values."""
        white = random.normal(0.0, self.deviation, times.shape)
        if times.size < 2:
            return white
        kept = math.exp(-float(times[1] - times[0]) / self.correlation_time)
        white[1:] *= math.sqrt(1 - kept**2)
        return np.asarray(lfilter([1.0], [1.0, -kept], white))


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


def _check_deviation(noise: Noise | ColouredNoise) -> None:
    if not 0 <= noise.deviation < math.inf:
        raise InvalidValue(
            f"{type(noise).__name__}(deviation={noise.deviation!r}): expected a finite number of at least 0"
        )
