"""The public names; `__init__.py` imports each when it is first used."""

from .controller import check_controller
from .deformation import check_deformation
from .laws import check_live
from .observer import check_observer
from .optimiser import check_optimiser
from .plant import check_plant
from .tracking import check_tracking

__all__ = [
    "check_controller",
    "check_deformation",
    "check_live",
    "check_observer",
    "check_optimiser",
    "check_plant",
    "check_tracking",
]
