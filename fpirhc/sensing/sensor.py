"""A sensor of one quantity, with noise, quantisation and lost samples.

seen = Q round((true + noise) / Q);     in a cycle whose sample is lost, the last value seen is repeated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fpirhc.errors import InvalidValue
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import real_number
from fpirhc.task.disturbance import Disturbance


@dataclass(frozen=True, eq=False)
class Sensor(Checked):
    """Noise, quantisation and lost samples of one measured quantity.

    Args:
        noise: signal that adds to the true value, in its unit: Noise, ColouredNoise, Sine (hum), Step (bias), Formula (drift);
            None: no noise.
        quantum: Q, the resolution (of an encoder, for example), in the quantity's unit; None: no quantisation.
        dropout: probability that a cycle's sample is lost.

    Raises:
        InvalidValue: noise that is not a Disturbance, a quantum that is not positive, a probability outside [0, 1).
    """

    noise: Disturbance | None = None
    quantum: float | None = None
    dropout: float = 0.0

    def __post_init__(self) -> None:
        wrong = []
        if self.quantum is not None and not _within(self.quantum, 0.0, math.inf):
            wrong.append(f"quantum={self.quantum!r}: expected a positive number in the unit of the quantity, or None")
        if self.dropout != 0 and not _within(self.dropout, 0.0, 1.0):
            wrong.append(f"dropout={self.dropout!r}: expected a probability from 0 to below 1")
        if wrong:
            raise InvalidValue(f"Sensor: {'; '.join(wrong)}")


def _within(value: object, lower: float, upper: float) -> bool:
    number = real_number(value)
    return number is not None and lower < number < upper
