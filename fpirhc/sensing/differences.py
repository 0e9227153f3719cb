"""State and response from differences: of positions alone over the last samples, or of the highest measured derivative.

    y^(s)_k = sum_i c_{s,i} y_{k-i} / T^s,     s = 0 ... n,             of positions
    f_k = p f_{k-1} + (1 - p) (y^(n-1)_k - y^(n-1)_{k-1}) / T,        of the highest derivative, with p = exp(-T / tau)

The start's motion, continued backwards, fills the samples before the first one, so the first estimates are those of the start.
Without filter (p = 0) the second is the mean response to the last request: the ideal pair. Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import Count, Range, whole
from fpirhc.plant.chain import require_derivatives
from fpirhc.plant.motion import controlled_places
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Array, DerivativeEstimator, backward_difference, combine, spline_weights
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

LONGEST = 1001  # samples: the memory has a fixed size


class _Finite(DerivativeEstimator, ABC):
    """Common part of the formulas."""

    def measures(self, plant: Plant) -> tuple[str, ...]:
        return tuple(plant.chains)

    @abstractmethod
    def coefficients(self, order: int) -> Array:
        """Rows c_0 ... c_n, newest sample first, shape (order + 1, samples); the last row gives the response."""

    def weights(self, order: int, period: float) -> Array:
        del period
        average = self.coefficients(order)[-1]
        for _ in range(order):
            average = np.cumsum(average)
        # Division by (1 - 1/z)^n leaves no remainder: an n-th derivative ignores polynomials below degree n.
        return np.convolve(average[: average.size - order], spline_weights(order))

    def fills(self, order: int) -> int:
        return int(self.coefficients(order).shape[1]) - 1

    def block(self, plant: Plant, period: float, start: Array, seen: Signal) -> Block:
        """Block (positions) -> (state, response)."""
        rows = [self.coefficients(r) / period ** np.arange(r + 1)[:, None] for r in plant.chains.values()]
        queue = _queue(plant, period, start, [row.shape[1] - 1 for row in rows])
        realised = plant.response_signal("realised")

        def step(s: Signals) -> dict[str, Expression]:
            newest, past, at = getattr(s, seen.name), s.estimate_past, 0
            known: dict[str, Expression] = {}
            past_next: list[Expression] = []
            responses: list[Expression] = []
            for k, ((name, order), row) in enumerate(zip(plant.chains.items(), rows, strict=True)):
                count = row.shape[1] - 1
                samples = [newest[k], *(past[at + i] for i in range(count))]
                at += count
                past_next += samples[:count]
                known |= {name + "'" * d: combine(row[d], samples) for d in range(order)}
                responses.append(combine(row[-1], samples))
            state = ca.vertcat(*(known[e] for e in plant.output.elements))
            realised = ca.vertcat(*(responses[k] for k in controlled_places(plant)))
            return {plant.output.name: state, "realised": realised, "estimate_past_next": ca.vertcat(*past_next)}

        return Block("estimate", Layout((seen,)), Layout((plant.output, realised)), step, Layout((queue,)))


def _queue(plant: Plant, period: float, start: Array, counts: list[int]) -> Signal:
    """Past positions of every coordinate, newest first, filled with y(-iT) = sum_s y^(s)(0) (-iT)^s / s!."""
    names, values = [], []
    for (name, order), count in zip(plant.chains.items(), counts, strict=True):
        first = [start[plant.output.elements.index(name + "'" * s)] / math.factorial(s) for s in range(order)]
        names += [f"{name}@{i}" for i in range(1, count + 1)]
        values += [float(sum(c * (-i * period) ** s for s, c in enumerate(first))) for i in range(1, count + 1)]
    return Signal("estimate_past", tuple(names), start=tuple(values))


@dataclass(frozen=True)
class PositionDifference(_Finite):
    """The s-th backward difference over T^s for every derivative, which is late by s T / 2.

    The response averages the last n requests, so its delay beyond the ideal pair is (n - 1) / 2 cycles. White noise of
    deviation sigma becomes sigma sqrt(binomial(2 n, n)) / T^n: 2.4 sigma / T^2 for n = 2, 8.4 sigma / T^4 for n = 4.
    """

    def coefficients(self, order: int) -> Array:
        rows = np.zeros((order + 1, order + 1))
        for s in range(order + 1):
            rows[s, : s + 1] = backward_difference(s)
        return rows


@dataclass(frozen=True)
class StepDifference(PositionDifference):
    """The divided differences of a map's last steps, delta^s y = (s-th backward difference) / T^s.

    The one of relative order n is exact, with no average: the difference up to this cycle is the response to the request of n
    cycles ago. So it is n - 1 cycles later than the ideal pair, and pairs are complete from cycle n on. The lower differences are
    those of s cycles ago; `fpirhc.controllers.seeing` brings them to this cycle by the model.
    """

    def check(self, plant: Plant) -> None:
        require_derivatives(plant, "StepDifference", of_time=False, instead="leave the estimator out")

    def weights(self, order: int, period: float) -> Array:
        del period
        return np.eye(order)[-1]


@dataclass(frozen=True)
class SavitzkyGolay(_Finite):
    """A polynomial fitted to the window by least squares: the response at its centre, the state at its newest sample.

    At the centre a derivative has the least noise and a known delay, (window - 1) / 2 - 1 / 2 cycles beyond the ideal pair. The
    state is needed now; at the window's end it is noisier, and has no delay on polynomials up to the degree.

    Args:
        window: number of samples, odd.
        degree: of the polynomial, at least the plant's order.

    Raises:
        InvalidValue: a window that is even, not longer than the degree, or longer than 1001 samples.

    References:
        A. Savitzky, M. J. E. Golay, Smoothing and differentiation of data by simplified least squares procedures, Analytical
        Chemistry 36(8), 1964.
    """

    window: Annotated[int, whole(1, LONGEST)]
    degree: Count

    def __post_init__(self) -> None:
        what = f"SavitzkyGolay(window={self.window!r}, degree={self.degree!r})"
        least = self.degree + 1 + self.degree % 2
        if self.window % 2 == 0 or self.window < least:  # an even one has no sample at its centre
            odd = sorted({max(least, self.window - 1), max(least, self.window + 1)})
            wanted = f"an odd window of at least {least} samples for degree {self.degree}"
            raise InvalidValue(f"{what}: expected {wanted}; use {' or '.join(map(str, odd))}")

    def check(self, plant: Plant) -> None:
        """Raise if the polynomial has too low a degree.

        Raises:
            InvalidValue: a degree below the plant's order.
        """
        super().check(plant)
        highest = max(plant.chains.values())
        if self.degree < highest:
            raise InvalidValue(
                f"SavitzkyGolay(degree={self.degree}): the response is a derivative of order {highest}, which a polynomial of "
                f"degree {self.degree} does not have; use a degree of at least {highest}"
            )

    def coefficients(self, order: int) -> Array:
        half = (self.window - 1) // 2
        # Time counts in half windows from the centre, so that the powers stay of size one.
        unit = max(half, 1)
        fit = np.linalg.pinv(np.vander(-np.arange(-half, half + 1) / unit, self.degree + 1, increasing=True))
        rows = [self._derivative(fit, s, half / unit) / float(unit) ** s for s in range(order)]
        return np.vstack([*rows, math.factorial(order) * fit[order] / float(unit) ** order])

    def _derivative(self, fit: Array, order: int, place: float) -> Array:
        powers = range(order, self.degree + 1)
        return np.asarray(sum(math.perm(k, order) * place ** (k - order) * fit[k] for k in powers))


_TAIL = 1e-9  # share of the low-pass's weights that is left out


class _OfHighest(DerivativeEstimator):
    """The difference over the period, through a low-pass with a pole."""

    @abstractmethod
    def pole(self, period: float) -> float:
        """Pole of the low-pass."""

    def measures(self, plant: Plant) -> tuple[str, ...]:
        return plant.output.elements

    def weights(self, order: int, period: float) -> Array:
        """(1 - p) p^(j-1), without the negligible tail."""
        del order
        pole = self.pole(period)
        count = max(1, math.ceil(math.log(_TAIL) / math.log(pole))) if pole > 0 else 1
        return np.asarray((1 - pole) * pole ** np.arange(count))

    def block(self, plant: Plant, period: float, start: Array, seen: Signal) -> Block:
        """Block (state) -> (state, p f + (1 - p) difference over the period)."""
        pole, highest = self.pole(period), [name + "'" * (plant.chains[name] - 1) for name in plant.controlled_names]
        places = [plant.output.elements.index(e) for e in highest]
        first = tuple(map(float, start[places]))
        before = Signal("estimate_before", tuple(seen.elements[p] for p in places), start=first)
        realised, smooth = plant.response_signal("realised"), Signal("estimate_smooth", plant.controlled_names)
        memory = (before, smooth, scalar("estimate_cycles")) if pole else (before,)

        def step(s: Signals) -> dict[str, Expression]:
            state = getattr(s, seen.name)
            newest = state[places]
            response = (newest - s.estimate_before) / period
            results = {plant.output.name: state, "realised": response, "estimate_before_next": newest}
            if not pole:
                return results
            response = ca.if_else(s.estimate_cycles < 1.5, response, pole * s.estimate_smooth + (1 - pole) * response)
            kept = {"estimate_smooth_next": response, "estimate_cycles_next": ca.fmin(s.estimate_cycles + 1, 2)}
            return {**results, "realised": response, **kept}

        return Block("estimate", Layout((seen,)), Layout((plant.output, realised)), step, Layout(memory))


@dataclass(frozen=True)
class VelocityDifference(_OfHighest):
    """Backward difference of the highest measured derivative over the period."""

    def pole(self, period: float) -> float:
        del period
        return 0.0


_TIME_CONSTANT = Range("a positive number of seconds (or use VelocityDifference())", lambda v: 0 < v < math.inf)


@dataclass(frozen=True)
class LowPassDifference(_OfHighest):
    """The same difference through a first-order low-pass, which begins with the first difference; it is p / (1 - p) cycles late.

    The filtered response is later than the unfiltered desired response. `Filtered` filters their difference instead, and
    `Paired(cycles=...)` compares the response with the request that caused it.

    Args:
        time_constant: tau, s.
    """

    time_constant: Annotated[float, _TIME_CONSTANT]

    def pole(self, period: float) -> float:
        """Pole of the low-pass, exp(-T / tau)."""
        return math.exp(-period / self.time_constant)


EXAMPLES = (
    PositionDifference(),
    StepDifference(),
    SavitzkyGolay(window=11, degree=4),
    VelocityDifference(),
    LowPassDifference(time_constant=0.01),
)
