"""The public names; `__init__.py` imports each when it is first used."""

from . import figures
from .base import RELATIVE_ERROR, Better, Metric, Metrics, known_metrics, measure, with_own_metrics

__all__ = ["RELATIVE_ERROR", "Better", "Metric", "Metrics", "figures", "known_metrics", "measure", "with_own_metrics"]
