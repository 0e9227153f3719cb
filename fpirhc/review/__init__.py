"""Questions that the symbols, the two parameter sets and the settings answer before a run.

The function `fpirhc.review` hides this package by its name, so the modules of the package are attributes of the function too.
"""

import sys
from types import ModuleType


class _Package(ModuleType):
    def __setattr__(self, name: str, value: object) -> None:
        super().__setattr__(name, value)
        own = vars(self)
        if "review" in own:  # the module of the function, which imports others before it is complete
            for one in own if name == "review" else (name,):
                if isinstance(own[one], ModuleType):
                    setattr(own["review"].review, one, own[one])


sys.modules[__name__].__class__ = _Package
