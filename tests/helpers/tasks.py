"""The shipped problems as attributes, `tasks.two_mass`: each is loaded once in a process, and not before a test reads it."""

from __future__ import annotations

from functools import cache

from fpirhc import load_problem
from fpirhc.problem_files.problem_file import Task

_loaded = cache(load_problem)


def __getattr__(name: str) -> Task:
    """The task of a name; names of Python's own are not there."""
    if name.startswith("__"):
        raise AttributeError(name)
    return _loaded(name)
