"""Laws that every member of a family keeps, to be tried on a class of one's own in one line.

    check_deformation(MyMap(gain=-0.5), seed=1)
    check_tracking(MyLaw(rate=6.0), seed=1)
    check_plant(my_plant, seed=1)

Each raises one AssertionError for the first law that is broken, with the numbers; nothing is returned. The laws themselves are the
tuples `LAWS` of the modules, one module per family.
"""

from fpirhc.testing.deformation import check_deformation
from fpirhc.testing.plant import check_plant
from fpirhc.testing.tracking import check_tracking

__all__ = ["check_deformation", "check_plant", "check_tracking"]
