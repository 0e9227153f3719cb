"""The public names; `__init__.py` imports each when it is first used."""

from .base import DerivativeEstimator as DerivativeEstimator
from .base import Measured as Measured
from .positions import PositionDifference as PositionDifference
from .positions import SavitzkyGolay as SavitzkyGolay
from .positions import StepDifference as StepDifference
from .sensing import Sensing as Sensing
from .sensing import Sensor as Sensor
from .velocities import LowPassDifference as LowPassDifference
from .velocities import VelocityDifference as VelocityDifference
