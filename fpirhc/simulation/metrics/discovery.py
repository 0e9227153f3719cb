"""Finds metrics: those of the folder `entries`, those of installed packages, and those of a problem file."""

from __future__ import annotations

import pkgutil
from collections import Counter
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points

from fpirhc.errors import InvalidName
from fpirhc.simulation.metrics import entries
from fpirhc.simulation.metrics.base import Metric

GROUP = "fpirhc.metrics"  # of entry points; each leads to a Metric or to a tuple of them
# Files hold other facts of a run under these names.
_TAKEN = frozenset({"compiled", "cycle_us", "notes", "optimality", "outcome", "plan", "statuses", "stop"})


@cache
def known_metrics() -> tuple[Metric, ...]:
    """Return the shipped metrics and those of installed packages, in the order of their columns.

    Raises:
        InvalidName: two metrics have the same name.
    """
    modules = (import_module(f"{entries.__name__}.{m.name}") for m in pkgutil.iter_modules(entries.__path__))
    shipped = [metric for module in modules for metric in getattr(module, "METRICS", ())]
    installed = [metric for point in entry_points(group=GROUP) for metric in _several(point.load())]
    return _ordered([*shipped, *installed])


def with_own_metrics(own: Iterable[Metric]) -> tuple[Metric, ...]:
    """Return the known metrics and the own ones of a problem file, in the order of their columns.

    Raises:
        InvalidName: another metric or another fact of a run has the name.
    """
    return _ordered([*known_metrics(), *own])


def _several(loaded: Metric | Iterable[Metric]) -> Iterable[Metric]:
    return (loaded,) if isinstance(loaded, Metric) else loaded


def _ordered(metrics: Iterable[Metric]) -> tuple[Metric, ...]:
    """The metrics in the order of their columns; raises where one name stands for two things in a file."""
    ordered = tuple(sorted(metrics, key=lambda metric: metric.order))
    counts = Counter(metric.name for metric in ordered)
    groups = {name.partition(".")[0] for name in counts if "." in name}
    for name, count in counts.items():
        if count > 1:
            raise InvalidName(f"metric '{name}' is defined {count} times; give yours another name")
        if name in groups or name.partition(".")[0] in _TAKEN:
            raise InvalidName(f"metric '{name}': the name has another meaning in results; give yours another one")
    return ordered
