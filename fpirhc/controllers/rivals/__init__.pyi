"""The public names; `__init__.py` imports each when it is first used."""

from .acceleration_feedback import AccelerationFeedback as AccelerationFeedback
from .adaptive_inverse_dynamics import AdaptiveInverseDynamics as AdaptiveInverseDynamics
from .adrc import ADRC as ADRC
from .force_mrac import ForceMRAC as ForceMRAC
from .indi import INDI as INDI
from .l1_adaptive import L1Adaptive as L1Adaptive
from .lyapunov_mrac import LyapunovMRAC as LyapunovMRAC
from .pid import PID as PID
from .resolved_rate import ResolvedAccelerationRate as ResolvedAccelerationRate
from .sliding_mode import SlidingMode as SlidingMode
from .slotine_li import SlotineLi as SlotineLi
