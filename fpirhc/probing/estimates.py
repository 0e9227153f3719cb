"""What is known of a plant: the channels, their intervals, and the eigenvalues of gains drawn from these."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from fpirhc.probing.identification import Channel

_DRAWS, _QUANTILE = 400, 0.025
_COUPLED = 1.2  # ratio of the eigenvalues' sizes from which one gain for all directions wastes some


class Estimates:
    """What is known of a plant: estimates, intervals, and the eigenvalues of draws from them."""

    def __init__(self, channels: Sequence[Channel], seed: int) -> None:
        """Take the channels and the seed of the draws."""
        self.channels = tuple(channels)
        self.gains = np.array([[g.value for g in one.gains] for one in channels])
        self._deviations = np.array([[(g.high - g.low) / 4 for g in one.gains] for one in channels])
        random = np.random.default_rng(seed)
        self.draws = self.gains + self._deviations * random.standard_normal((_DRAWS, *self.gains.shape))
        values = np.linalg.eigvals(self.draws)
        real, size = values.real.min(axis=1), np.abs(values) ** 2 / np.maximum(np.abs(values.real), 1e-300)
        self.smallest = float(np.quantile(real, _QUANTILE))
        self.largest_real = float(np.quantile(values.real.max(axis=1), 1 - _QUANTILE))
        self.largest = float(np.quantile(size.max(axis=1), 1 - _QUANTILE))

    @cached_property
    def weights(self) -> tuple[tuple[float, ...], ...] | None:
        """The inverse of Lambda by rows, in three digits: all directions then have one gain. None where they have it anyway."""
        if len(self.gains) == 1 or self.refused:
            return None
        sizes = np.abs(np.linalg.eigvals(self.gains))
        if sizes.max() < _COUPLED * sizes.min():
            return None
        return tuple(tuple(float(f"{w:.3g}") for w in row) for row in np.linalg.inv(self.gains))

    @cached_property
    def largest_weighted(self) -> float:
        """As `largest`, of Lambda times the weights."""
        values = np.linalg.eigvals(self.draws @ np.array(self.weights))
        size = np.abs(values) ** 2 / np.maximum(np.abs(values.real), 1e-300)
        return float(np.quantile(size.max(axis=1), 1 - _QUANTILE))

    @property
    def uncertain(self) -> bool:
        """Whether a gain may have either sign."""
        return self.smallest <= 0 < self.largest_real

    @property
    def refused(self) -> str:
        """Why nothing may be adapted; empty where something may."""
        edges = [one.edge for one in self.channels if one.edge]
        if self.largest_real <= 0:
            return "the sign of the gain is wrong: the plant answers against its model; turn the sign of an input in the model"
        if np.linalg.eigvals(self.gains).real.min() <= 0:
            return "an eigenvalue of the gains has the wrong sign: an input of the model has, or is paired with the wrong output"
        if self.uncertain:
            return "the sign of a gain is not certain: excite more or longer (amplitude=, cycles=)"
        return f"the record is too short for the {edges[0]}: take more cycles" if edges else ""

    @cached_property
    def dead(self) -> np.ndarray:
        """Least, estimated, and greatest dead time of every input, shape (3, n)."""
        return np.array([(one.dead_time.low, one.dead_time.value, one.dead_time.high) for one in self.channels]).T

    @cached_property
    def lag(self) -> np.ndarray:
        """Least, estimated, and greatest lag of every input, shape (3, n)."""
        return np.array([(one.lag.low, one.lag.value, one.lag.high) for one in self.channels]).T

    @property
    def drift(self) -> np.ndarray:
        """By cycle, shape (cycles, n)."""
        return np.column_stack([one.drift for one in self.channels])
