"""Median of a sample with its confidence interval by resampling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RESAMPLES = 4000
LEVEL = 0.95
_AT_ONCE = 2_000_000  # largest number of values that are drawn at once


@dataclass(frozen=True)
class ConfidenceInterval:
    """A median and its interval at level `LEVEL`.

    Args:
        median: the median.
        low: lower end of the interval.
        high: upper end of the interval.
    """

    median: float
    low: float
    high: float


def median_interval(values: np.ndarray, seed: int) -> ConfidenceInterval:
    """Return the median of `values`, shape (n,), and its percentile bootstrap interval.

    Infinite values are allowed: they lie beyond all others. The interval is that of the population's median; with fewer than
    about ten values it is too narrow.

    References:
        B. Efron, R. J. Tibshirani, An Introduction to the Bootstrap, Chapman and Hall, 1993, chapter 13.
    """
    random = np.random.default_rng(np.random.SeedSequence(seed))
    rows = max(1, _AT_ONCE // values.size)
    samples: list[np.ndarray] = []
    for at in range(0, RESAMPLES, rows):
        size = (min(rows, RESAMPLES - at), values.size)
        samples.append(middle(values[random.integers(values.size, size=size)]))
    medians = np.sort(np.concatenate(samples))
    tail = round((1 - LEVEL) / 2 * RESAMPLES)
    return ConfidenceInterval(float(middle(values)), float(medians[tail]), float(medians[-1 - tail]))


def middle(values: np.ndarray) -> np.ndarray:
    """Median along the last axis; between minus and plus infinity lies zero."""
    size = values.shape[-1]
    places = [(size - 1) // 2, size // 2]
    low, high = np.moveaxis(np.partition(values, places, axis=-1)[..., places], -1, 0)
    with np.errstate(invalid="ignore"):
        between = 0.5 * low + 0.5 * high
    return np.where(low == high, low, np.where(np.isnan(between), 0.0, between))
