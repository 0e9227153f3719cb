"""Disturbances: signals that act on the plant and that no controller receives.

A disturbance is attached by name, to an input (it adds to the clipped command), to a coordinate (it adds to the
response), or to an output that is an expression (it adds to the output, see `output_disturbance`). It is sampled once per control
cycle and held over the cycle.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import AboveZero, NotNegative
from fpirhc.fields.user_code import called, scalar_expression
from fpirhc.symbolic.layout import Expression


class Disturbance(Checked, ABC):
    """Contract: values at given times, and the size and speed of their changes where these are known."""

    @abstractmethod
    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return one value per time, shape (m,), in the unit of the disturbed signal."""

    def derivative(self, times: np.ndarray, order: int) -> np.ndarray:  # noqa: ARG002
        """Return the derivative of that order, 1 or more, between jumps, shape (m,); zero by default: constant between jumps.

        A disturbed output has it in its own derivatives. A subclass whose values change smoothly should override it.
        """
        return np.zeros_like(times)


@dataclass(frozen=True)
class Step(Disturbance):
    """Zero before a time, constant from then on, or for a while: a pulse.

    Args:
        at: first time of the step, s.
        size: value from then on.
        duration: of a pulse, s; infinite: it stays.
    """

    at: float
    size: float
    duration: AboveZero = math.inf

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:  # noqa: ARG002
        return np.where((times >= self.at) & (times < self.at + self.duration), self.size, 0.0)


@dataclass(frozen=True)
class Noise(Disturbance):
    """Gaussian noise, drawn from the run's seed: white, or with the correlation exp(-|t - t'| / correlation_time).

        v_k = c v_{k-1} + sqrt(1 - c^2) deviation w_k,     c = exp(-T / correlation_time),

    begun in its stationary distribution; with correlation it needs equally spaced times.

    Args:
        deviation: standard deviation, in the unit of the disturbed signal.
        correlation_time: s; 0: white.
    """

    deviation: NotNegative
    correlation_time: NotNegative = 0.0

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:
        white = random.normal(0.0, self.deviation, times.shape)
        if not self.correlation_time or times.size < 2:
            return white
        from scipy.signal import lfilter  # it takes longer to import than all the rest of a problem

        decay = math.exp(-float(times[1] - times[0]) / self.correlation_time)
        white[1:] *= math.sqrt(1 - decay**2)
        return np.asarray(lfilter([1.0], [1.0, -decay], white))


@dataclass(frozen=True, eq=False)
class Formula(Disturbance):
    """A CasADi expression of time: Formula(lambda t: 3 * ca.tanh(t - 1)).

    Args:
        expression: function of the time.
    """

    expression: Callable[[Expression], Expression]

    def values(self, times: np.ndarray, random: np.random.Generator) -> np.ndarray:  # noqa: ARG002
        return self.derivative(times, 0)

    def derivative(self, times: np.ndarray, order: int) -> np.ndarray:
        t = ca.SX.sym("t")
        expression = scalar_expression(
            "disturbance", called("disturbance", self.expression, t), of=self.expression, symbols=(t,)
        )
        for _ in range(order):
            expression = ca.jacobian(expression, t)
        function = ca.Function("fpirhc_disturbance", [t], [expression])
        samples = np.asarray(function.map(times.size)(times[None, :]).full()).ravel()
        if not np.all(np.isfinite(samples)):
            where = times[np.argmin(np.isfinite(samples))]
            what = "a disturbance expression" + (f" is differentiated {order} times and" if order else "")
            raise InvalidValue(f"{what} is not finite at t = {where:g}")
        return samples
