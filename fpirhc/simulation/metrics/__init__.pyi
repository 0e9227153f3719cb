"""The public names; `__init__.py` imports each when it is first used."""

from . import figures
from .base import Better, Metric, Metrics, known_metrics, measure, with_own_metrics

__all__ = ["Better", "Metric", "Metrics", "figures", "known_metrics", "measure", "with_own_metrics"]
