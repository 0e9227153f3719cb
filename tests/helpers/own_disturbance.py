"""A disturbance of a user's own."""

from __future__ import annotations

import numpy as np

from fpirhc.contracts import Disturbance


class Sawtooth(Disturbance):
    """A user's own: rises by 3 per second and falls back by 1.5 every half second."""

    def values(self, times, random):  # noqa: ARG002
        return 3.0 * np.mod(times + 1e-12, 0.5)
