"""Gain, dead time, lag, noise and drift of a response f, from the model's response m to the commands that acted.

    f_i = sum_j lambda_ij (G m)_j + w_i + n_i,        G: d cycles, then x_k = rho x_{k-1} + (1 - rho) m_k with rho = e^(-T / tau)

For every d, tau and share of the drift w the differences are whitened, and lambda is least squares. Theory: docs/review.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.signal import lfilter

from fpirhc.errors import InvalidValue
from fpirhc.sensing.base import spline_weights

# Difference of 2 log L with which a dead time or a lag is in its interval; factor of all: no body is exactly of this form.
_ENOUGH, _WIDER = 5.0, 1.5
_MOST_DEAD, _LAGS = 10, 50  # cycles that are searched first; lags from a part of a cycle to a fifth of the record
_SETTLED, _DRIFTS = 5, (1, 2)  # cycles after the longest dead time that do not count; integrations
_SHARES = np.arange(-8, 3.1, 0.5)  # log10 of the drift's share


@dataclass(frozen=True)
class Interval:
    """An estimate, and an interval that contains the right value 19 times of 20."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Channel:
    """What one response is made of."""

    gains: tuple[Interval, ...]  # lambda_ij of every model response j
    dead_time: Interval  # d, cycles
    lag: Interval  # tau, in the problem's unit of time
    noise: float  # rms of what is no response of the plant, in the unit of what is measured
    drift: np.ndarray  # what is, and the model does not have: w by cycle
    drifting: float  # rms change of w per square root of the unit of time
    edge: str  # what the record is too short to bound: "dead time", "lag", or nothing
    ends: tuple[Fit, ...]  # the best, and the likeliest at the ends of dead time and lag


@dataclass(frozen=True, eq=False)
class Fit:
    """The likeliest gains with one dead time, lag, and share of the drift."""

    likelihood: float
    dead: int
    lag: float
    noise: tuple[int, int]
    ratio: float
    gains: np.ndarray
    deviation: np.ndarray
    innovation: float


def identify(
    measured: np.ndarray, modelled: np.ndarray, period: float, usable: np.ndarray, differences: Sequence[int],
) -> tuple[Channel, ...]:  # fmt: skip
    """Return what every response f, shape (cycles, n), is made of, from m of the same cycles, and which of them count.

    `differences`: how often each is a difference of what is measured, with noise that is one too; m is averaged alike.
    """
    averages = (lfilter(spline_weights(c), 1.0, modelled - modelled[0], axis=0) + modelled[0] for c in differences)
    pairs = zip(measured.T, averages, differences, strict=True)
    return tuple(_channel(f, m, period, usable, c) for f, m, c in pairs)


def require_cycles(cycles: int) -> None:
    """Raise if these are too few."""
    if cycles < 40:
        few = f"probe: {cycles} cycles are too few to tell a gain from noise"
        raise InvalidValue(f"{few}; expected at least 40, 300 are usual")


def _channel(f: np.ndarray, m: np.ndarray, period: float, good: np.ndarray, differences: int) -> Channel:
    cycles, most, noises = len(f), _MOST_DEAD, [(p, c) for c in (0, max(differences, 1)) for p in _DRIFTS]
    lags = np.r_[0.0, 0.1 * period, np.geomspace(0.2 * period, 0.2 * cycles * period, _LAGS)]
    while True:  # an estimate at the edge of the search widens it, and a gain that may be nothing
        fits = _profile(f, m, period, good, noises, range(most + 1), lags)
        best = _likeliest(fits)
        inside = best.dead < most - 1 and (np.abs(best.gains) > 5 * best.deviation).any()
        if inside or 2 * most > cycles // 3:
            break
        most *= 2
    best, near, nearest = _likeliest(fits), _near(fits, _ENOUGH * _WIDER**2), _near(fits, _ENOUGH)
    beside = [_likeliest(one for one in fits if one.lag == tau) for tau in _around(fits, nearest)]
    within = np.array([one.gains for one in (*nearest, *beside)])
    half = _WIDER * np.hypot(2 * best.deviation, 0.5 * np.ptp(within, axis=0))
    gains = tuple(Interval(float(g), float(g - h), float(g + h)) for g, h in zip(best.gains, half, strict=True))
    dead = Interval(best.dead, min(one.dead for one in near), max(one.dead for one in near))
    lag = Interval(best.lag, *_around(fits, near))
    root = abs(_whitener(sum(best.noise), best.ratio)[-1])
    size, rest = math.sqrt(best.innovation * root), f - delayed(m, best.dead, best.lag, period) @ best.gains
    drift = _smoothed(rest, *best.noise, 10.0**best.ratio)
    moved = float(np.sqrt(np.mean(np.diff(drift[_SETTLED:]) ** 2) / period))
    at = [("dead", dead.low), ("dead", dead.high), ("lag", lag.low), ("lag", lag.high)]
    ends = (best, *(_likeliest(one for one in fits if getattr(one, what) == end) for what, end in at))
    noise = size * (period**differences if differences else math.sqrt(1 + best.noise[1]))
    if differences and not best.noise[1]:  # what moves at random is the plant, not the sensor
        noise, drift = 0.0, rest
    edge = "lag" if lag.high >= lags[-1] else "dead time" if dead.high >= most else ""
    return Channel(gains, dead, lag, noise, drift, moved, edge, ends)


def delayed(m: np.ndarray, dead: int, lag: float, period: float) -> np.ndarray:
    """Return G m of model responses, shape (cycles, n): late by whole cycles and lagging; before the record it is at rest."""
    late = np.vstack([np.repeat(m[:1], dead, axis=0), m[: len(m) - dead]])
    if not lag:
        return late
    rho = math.exp(-period / lag)
    return np.asarray(lfilter([1 - rho], [1, -rho], late, axis=0, zi=rho * late[:1])[0])


def _profile(
    f: np.ndarray, m: np.ndarray, period: float, good: np.ndarray, noises: Sequence[tuple[int, int]],
    deads: Sequence[int], lags: np.ndarray,
) -> list[Fit]:  # fmt: skip
    """The best gains at every point of a grid; all points of one noise are whitened together."""
    points = [(d, float(tau)) for d in deads for tau in lags]
    rows = np.array([delayed(m, d, tau, period).T for d, tau in points])  # (points, n, cycles)
    counts = good.copy()
    counts[: min(max(deads) + _SETTLED, len(f) // 3)] = False
    channels = []
    for p, c in noises:
        x, y = (np.diff(one, p, axis=-1) for one in (rows, f))
        some = counts[p:]
        total = int(some.sum())
        for ratio in _SHARES:
            whitener = _whitener(p + c, float(ratio))
            xw, yw = (lfilter([1.0], whitener, one, axis=-1)[..., some] for one in (x, y))
            square = xw @ xw.transpose(0, 2, 1)
            square += 1e-12 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(m.shape[1])
            inverse, mixed = np.linalg.inv(square), xw @ yw
            gains = (inverse @ mixed[..., None])[..., 0]
            rest = np.maximum(yw @ yw - np.sum(gains * mixed, axis=1), 1e-300) / total
            spread = np.sqrt(rest[:, None] * np.diagonal(inverse, axis1=1, axis2=2))
            likelihood = -0.5 * total * np.log(rest)
            channels += [
                Fit(float(value), d, tau, (p, c), float(ratio), gain, std, float(s))
                for (d, tau), value, gain, std, s in zip(points, likelihood, gains, spread, rest, strict=True)
            ]
    return channels


def _likeliest(fits: Iterable[Fit]) -> Fit:
    return max(fits, key=lambda one: one.likelihood)


def _near(fits: Sequence[Fit], distance: float) -> list[Fit]:
    """The points whose 2 log L is that near to the best."""
    best = _likeliest(fits).likelihood
    return [one for one in fits if 2 * (best - one.likelihood) < distance]


def _around(fits: Sequence[Fit], near: Sequence[Fit]) -> tuple[float, float]:
    """The searched lags just outside those that are near: the ends of an interval are before these."""
    low, high = min(one.lag for one in near), max(one.lag for one in near)
    below, above = (one.lag for one in fits if one.lag < low), (one.lag for one in fits if one.lag > high)
    return max(below, default=low), min(above, default=high)


@cache
def _whitener(order: int, ratio: float) -> np.ndarray:
    """The stable factor of r z^n + (-1)^n (1 - z)^2n: the moving average that drift and noise are together."""
    spectrum = (-1) ** order * np.poly(np.ones(2 * order))
    spectrum[order] += 10.0**ratio
    roots = np.roots(spectrum)
    return np.real(np.poly(roots[np.argsort(np.abs(roots))][:order]))


def _smoothed(rest: np.ndarray, integrations: int, differences: int, ratio: float) -> np.ndarray:
    """The drift in what the gains leave: without the noise that makes itself and the drift's jumps the smallest together."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    def difference(count: int, size: int) -> sparse.spmatrix:
        entries, shape = np.atleast_1d(np.poly(np.ones(count))), (size, size + count)
        return sparse.diags(entries, range(count + 1), shape=shape, format="csc")

    size = len(rest)
    jumps, noisy = difference(integrations, size - integrations), difference(differences, size)
    both = jumps @ noisy
    normal = both.T @ both + max(ratio, 1e-9) * sparse.eye(size + differences, format="csc")
    return np.asarray(rest - noisy @ spsolve(normal, both.T @ (jumps @ rest)))


_DRAWS, _QUANTILE, _COUPLED = 400, 0.025, 1.2  # the last: ratio of eigenvalues from which one gain for all wastes some


class Estimates:
    """What is known of a plant: estimates, intervals, and the eigenvalues of draws from them."""

    def __init__(self, channels: Sequence[Channel], seed: int) -> None:
        self.channels = tuple(channels)
        self.gains = np.array([[g.value for g in one.gains] for one in channels])
        deviations = np.array([[(g.high - g.low) / 4 for g in one.gains] for one in channels])
        random = np.random.default_rng(seed)
        draws = self.gains + deviations * random.standard_normal((_DRAWS, *self.gains.shape))
        real = np.linalg.eigvals(draws).real
        self.smallest, self.least_at_most = map(float, np.quantile(real.min(axis=1), [_QUANTILE, 1 - _QUANTILE]))
        self.largest_real = float(np.quantile(real.max(axis=1), 1 - _QUANTILE))
        self.largest = _largest(draws)
        self.dead, self.lag = (  # the least, the estimated and the greatest of every input, shape (3, n)
            np.array([(one.low, one.value, one.high) for one in some]).T
            for some in zip(*((one.dead_time, one.lag) for one in channels), strict=True)
        )
        ends = np.ceil((self.dead[0] + self.dead[2]) / 2)
        self.counted = np.where(self.dead[2] > self.dead[0], ends, self.dead[1])  # what forms count, cycles
        self.drift = np.column_stack([one.drift for one in channels])  # by cycle, shape (cycles, n)
        self.likely = tuple(self.dead[1].tolist()), tuple(self.lag[1].tolist())  # dead times and lags
        # Dead times, lags and gains of plants that the likelihood allows: of the best, and at both ends of dead times and lags.
        self.ends = {
            (tuple(float(f.dead) for f in fits), tuple(f.lag for f in fits)): np.array([f.gains for f in fits])
            for fits in zip(*(one.ends for one in channels), strict=True)
        }
        sizes = np.abs(np.linalg.eigvals(self.gains))
        # The inverse of Lambda; None: all directions have one gain.
        self.weights: tuple[tuple[float, ...], ...] | None = None
        if len(sizes) > 1 and not self.refused and sizes.max() >= _COUPLED * sizes.min():
            self.weights = tuple(tuple(float(f"{w:.3g}") for w in row) for row in np.linalg.inv(self.gains))
            self.largest_weighted = _largest(draws @ np.array(self.weights))  # of Lambda times the weights

    @property
    def refused(self) -> str:
        """Why nothing may be adapted; empty where something may."""
        if self.largest_real <= 0:
            return "the sign of the gain is wrong: the plant answers against its model; turn the sign of an input in the model"
        if self.least_at_most <= 0:
            return "an eigenvalue of the gains has the wrong sign: an input of the model has, or is paired with the wrong output"
        if self.smallest <= 0 or np.linalg.eigvals(self.gains).real.min() <= 0:
            return "the sign of a gain is not certain: excite more or longer (amplitude, cycles)"
        return ""

    @property
    def unbounded(self) -> str:
        """What the record is too short to bound, so that nothing may be adapted untried; empty where it bounds everything."""
        edges = [one.edge for one in self.channels if one.edge]
        return f"the record is too short for the {edges[0]}: take more cycles" if edges else ""


def _largest(matrices: np.ndarray) -> float:
    """The gain that 1 / is deadbeat: |lambda|^2 / |Re lambda| of the eigenvalues, exceeded by one matrix in 40."""
    values = np.linalg.eigvals(matrices)
    sizes = np.abs(values) ** 2 / np.maximum(np.abs(values.real), 1e-300)
    return float(np.quantile(sizes.max(axis=1), 1 - _QUANTILE))
