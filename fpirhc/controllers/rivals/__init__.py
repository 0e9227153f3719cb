"""Controllers of the literature by their names, to compare with: `fp.rivals.INDI(tracking)`.

Offset-free predictive control is `Estimating(RecedingHorizon(...), DisturbanceKalman(...), at_once=True)`; with `frequencies` of
the filter it is the periodic one.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
