"""Laws that every member of a family keeps, to be tried on a class of one's own in one line.

    check_deformation(MyMap(gain=-0.5), seed=1)
    check_tracking(MyLaw(rate=6.0), seed=1)
    check_optimiser(MyOptimiser(tolerance=1e-6), tolerance=1e-6, seed=1)
    check_controller(MyController(...), seed=1)
    check_plant(my_plant, seed=1)

Each raises one AssertionError for the first law that is broken, with the numbers; nothing is returned. The laws themselves are
the tuples `LAWS` of the modules, one module per family.
"""

from fpirhc.testing.controller import check_controller
from fpirhc.testing.deformation import check_deformation
from fpirhc.testing.optimiser import check_optimiser
from fpirhc.testing.plant import check_plant
from fpirhc.testing.tracking import check_tracking

__all__ = ["check_controller", "check_deformation", "check_optimiser", "check_plant", "check_tracking"]
