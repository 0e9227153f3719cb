"""The public names; `__init__.py` imports each when it is first used."""

from .acceleration_feedback import AccelerationFeedback
from .adaptive_inverse_dynamics import AdaptiveInverseDynamics
from .adrc import ADRC
from .backstepping_mrac import BacksteppingMRAC
from .disturbance_observer import DisturbanceObserver
from .force_mrac import ForceMRAC
from .indi import INDI
from .intelligent_pid import IntelligentPID
from .l1_adaptive import L1Adaptive
from .lyapunov_mrac import LyapunovMRAC
from .pid import PID
from .repetitive_control import RepetitiveControl
from .resolved_rate import ResolvedAccelerationRate
from .sliding_mode import SlidingMode
from .slotine_li import SlotineLi

__all__ = [
    "ADRC",
    "INDI",
    "PID",
    "AccelerationFeedback",
    "AdaptiveInverseDynamics",
    "BacksteppingMRAC",
    "DisturbanceObserver",
    "ForceMRAC",
    "IntelligentPID",
    "L1Adaptive",
    "LyapunovMRAC",
    "RepetitiveControl",
    "ResolvedAccelerationRate",
    "SlidingMode",
    "SlotineLi",
]
