"""Sensing: the way from the plant to the controller, through sensors and an estimator of unmeasured quantities."""

from fpirhc.sensing.base import DerivativeEstimator
from fpirhc.sensing.measured import Measured
from fpirhc.sensing.positions import PositionDifference, SavitzkyGolay, StepDifference
from fpirhc.sensing.sensing import Sensing, Sensor
from fpirhc.sensing.state_filter import StateVariableFilter
from fpirhc.sensing.velocities import LowPassDifference, VelocityDifference

__all__ = [
    "DerivativeEstimator",
    "LowPassDifference",
    "Measured",
    "PositionDifference",
    "SavitzkyGolay",
    "Sensing",
    "Sensor",
    "StateVariableFilter",
    "StepDifference",
    "VelocityDifference",
]
