"""The public names; `__init__.py` imports each when it is first used."""

from .controller import check_controller as check_controller
from .controller import check_live as check_live
from .deformation import check_deformation as check_deformation
from .laws import FAMILIES as FAMILIES
from .laws import Example as Example
from .laws import examples as examples
from .laws import laws_of as laws_of
from .laws import member_classes as member_classes
from .laws import two_masses as two_masses
from .observer import check_observer as check_observer
from .optimiser import check_optimiser as check_optimiser
from .optimiser import compiled as compiled
from .optimiser import posed as posed
from .plant import check_plant as check_plant
from .tracking import check_tracking as check_tracking
