"""Adaptive receding-horizon control by fixed-point iteration, on CasADi.

The public names stand in `__init__.pyi`; each is imported when it is first used, so that `fpirhc --help` need not load CasADi.
A member of a family that does not stand there yet is found by the name of its file (see `fpirhc.members`).
"""

from importlib import import_module as _import_module
from importlib.metadata import version as _version

import lazy_loader as _lazy

__version__ = _version("fpirhc")
_import, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
_MODULES = {"rivals": "fpirhc.controllers.rivals", "figures": "fpirhc.simulation.metrics.figures"}


def __getattr__(name: str) -> object:
    if name in _MODULES:
        return _import_module(_MODULES[name])
    if name in __all__:
        return _import(name)
    if name.startswith("_"):  # tools look for such names in whatever they meet, and nobody means a public one by them
        raise AttributeError(f"module 'fpirhc' has no attribute '{name}'")
    from fpirhc.errors import InvalidName, nearest
    from fpirhc.members import adapter_module, public_member

    member = public_member(name)
    if member is None and (module := adapter_module(name)):
        raise InvalidName(f"fpirhc.{name} is in the module of its adapter; write: from {module} import {name}")
    if member is None:
        raise InvalidName(f"fpirhc has no name '{name}'.{nearest(name, __all__)}")
    return member


def __reduce_ex__(_: object) -> object:
    """The package is pickled by its name, so that functions of notebooks that use it can go to other processes."""
    return _import_module, (__name__,)
