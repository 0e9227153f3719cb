"""The shipped problems as attributes, `tasks.two_mass`: each is loaded once in a process, and not before a test reads it."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from fpirhc import Problem, load_problem
from fpirhc.contracts import Controller

_loaded = cache(load_problem)


def __getattr__(name: str) -> Any:
    """The task of a name; names of Python's own are not there."""
    if name.startswith("__"):
        raise AttributeError(name)
    return _loaded(name)


def made(problem: Problem, controllers: Mapping[str, Controller], name: str = "case", **more: Any) -> Any:
    """A task that no file has: what `load_problem` returns, with these contents alone."""
    none: dict[str, Any] = {"headline": None, "tuning": {}, "pictures": (), "cases": None, "headline_metric": None}
    told: dict[str, Any] = {"name": name, "path": Path(f"{name}.py"), "title": name, "description": ""}
    return replace(_loaded("two_mass"), problem=problem, controllers=controllers, **none | told | more)
