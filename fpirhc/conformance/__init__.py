"""Laws that every member of a family keeps; one line tries them on a user's class, `check_deformation(MyMap(gain=-0.5), seed=1)`.

Each function raises one AssertionError for the first law that is broken, with the numbers, and returns nothing; FpirhcError: the
member refuses what it is tried on. `seed` is that of every draw. A law is a function in the module of its family that yields what
breaks it.
`examples(family)` are the members that they are tried on, of other distributions too.
"""

from fpirhc.conformance.controller import check_controller as check_controller
from fpirhc.conformance.deformation import check_deformation as check_deformation
from fpirhc.conformance.laws import FAMILIES as FAMILIES
from fpirhc.conformance.laws import Example as Example
from fpirhc.conformance.laws import examples as examples
from fpirhc.conformance.laws import laws_of as laws_of
from fpirhc.conformance.laws import member_classes as member_classes
from fpirhc.conformance.laws import two_masses as two_masses
from fpirhc.conformance.observer import check_observer as check_observer
from fpirhc.conformance.optimiser import check_optimiser as check_optimiser
from fpirhc.conformance.optimiser import compiled as compiled
from fpirhc.conformance.optimiser import posed as posed
from fpirhc.conformance.plant import check_plant as check_plant
from fpirhc.conformance.tracking import check_tracking as check_tracking
