"""Numbers that sum up a run: one value per metric, found by discovery, measured in one place.

A file of the folder `entries` that defines `METRICS`, a tuple of `Metric`, adds them; so does an entry point of the group
`fpirhc.metrics` of another package, and `metrics = (...)` in a problem file.
"""

from fpirhc.simulation.metrics import figures
from fpirhc.simulation.metrics.base import Better, Metric
from fpirhc.simulation.metrics.measuring import Metrics, known_metrics, measure, with_own_metrics

__all__ = ["Better", "Metric", "Metrics", "figures", "known_metrics", "measure", "with_own_metrics"]
