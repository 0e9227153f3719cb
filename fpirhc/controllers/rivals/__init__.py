"""Controllers of the literature by their names, to compare with: `fp.rivals.INDI(tracking)`.

Offset-free predictive control is `Estimating(RecedingHorizon(...), DisturbanceKalman(...), at_once=True)`; with `frequencies` of
the filter it is the periodic one.
"""

import lazy_loader as _lazy

from fpirhc.errors import without as _without

_import, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
_missing = _without("fpirhc.rivals", __all__)


def __getattr__(name: str) -> object:
    return _import(name) if name in __all__ else _missing(name)
