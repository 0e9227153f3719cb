"""Laws that every member of a family keeps; one line tries them on a user's class, `check_deformation(MyMap(gain=-0.5), seed=1)`.

Each function raises one AssertionError for the first law that is broken, with the numbers, and returns nothing (`check_live`: what
became of every number); FpirhcError: the member refuses what it is tried on. `seed` is that of every draw. A law is a
function in the module of its family that yields what breaks it.
`examples(family)` are the members that they are tried on, of other distributions too.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
