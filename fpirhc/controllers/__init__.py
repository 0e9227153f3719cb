"""Controllers: blocks from a measurement to a command."""

from importlib import import_module as _import_module


def __getattr__(name: str) -> object:
    """The module `rivals`, which is imported when it is first used."""
    if name == "rivals":
        return _import_module("fpirhc.controllers.rivals")
    raise AttributeError(f"module 'fpirhc.controllers' has no attribute '{name}'")
