"""Controllers of the literature by their names, to compare with: `fp.rivals.INDI(tracking)`.

Offset-free predictive control is `Estimating(RecedingHorizon(...), DisturbanceKalman(...), at_once=True)`.
"""

from fpirhc.controllers.rivals.disturbance_observers import ADRC, L1Adaptive
from fpirhc.controllers.rivals.inverse_dynamics import INDI, AccelerationFeedback, ResolvedAccelerationRate, SlidingMode
from fpirhc.controllers.rivals.learned_dynamics import AdaptiveInverseDynamics, SlotineLi
from fpirhc.controllers.rivals.model_reference import ForceMRAC, LyapunovMRAC
from fpirhc.controllers.rivals.pid import PID
from fpirhc.errors import without

__all__ = [
    "ADRC", "INDI", "PID", "AccelerationFeedback", "AdaptiveInverseDynamics",
    "ForceMRAC", "L1Adaptive", "LyapunovMRAC", "ResolvedAccelerationRate",
    "SlidingMode", "SlotineLi",
]  # fmt: skip
__getattr__ = without("fpirhc.rivals", __all__)
