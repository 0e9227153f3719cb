"""Sensing: the way from the plant to the controller, through sensors and an estimator of unmeasured quantities."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
