"""The public names; `__init__.py` imports each when it is first used."""

from .base import DerivativeEstimator, Measured
from .positions import PositionDifference, SavitzkyGolay, StepDifference
from .sensing import Sensing, Sensor
from .velocities import LowPassDifference, VelocityDifference

__all__ = [
    "DerivativeEstimator",
    "LowPassDifference",
    "Measured",
    "PositionDifference",
    "SavitzkyGolay",
    "Sensing",
    "Sensor",
    "StepDifference",
    "VelocityDifference",
]
