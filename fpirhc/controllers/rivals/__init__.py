"""Controllers of the literature by their names, to compare with: `fp.rivals.INDI(tracking)`.

Offset-free predictive control is `Estimating(RecedingHorizon(...), DisturbanceKalman(...), at_once=True)`; with `frequencies` of
the filter it is the periodic one.
"""

from fpirhc.controllers.rivals.acceleration_feedback import AccelerationFeedback
from fpirhc.controllers.rivals.adaptive_inverse_dynamics import AdaptiveInverseDynamics
from fpirhc.controllers.rivals.adrc import ADRC
from fpirhc.controllers.rivals.force_mrac import ForceMRAC
from fpirhc.controllers.rivals.indi import INDI
from fpirhc.controllers.rivals.l1_adaptive import L1Adaptive
from fpirhc.controllers.rivals.lyapunov_mrac import LyapunovMRAC
from fpirhc.controllers.rivals.pid import PID
from fpirhc.controllers.rivals.resolved_rate import ResolvedAccelerationRate
from fpirhc.controllers.rivals.sliding_mode import SlidingMode
from fpirhc.controllers.rivals.slotine_li import SlotineLi
from fpirhc.errors import without

__all__ = [
    "ADRC", "INDI", "PID", "AccelerationFeedback", "AdaptiveInverseDynamics",
    "ForceMRAC", "L1Adaptive", "LyapunovMRAC", "ResolvedAccelerationRate",
    "SlidingMode", "SlotineLi",
]  # fmt: skip
__getattr__ = without("fpirhc.rivals", __all__)
