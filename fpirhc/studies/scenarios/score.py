"""The number by which runs of different controllers are ranked, and the rule by which a run counts as failed."""

from __future__ import annotations

import math

import numpy as np

from fpirhc.simulation.metrics import Metrics
from fpirhc.simulation.run import Run
from fpirhc.task.problem import Problem

DIVERGED = 1.0  # relative error above which a run that lasted to its end has diverged: as large as the motion itself
_SAMPLES = 2000


def ranges(problem: Problem) -> dict[str, float]:
    """Return the range of the reference of every judged coordinate.

    The error at the start stands for it where that is larger, and 1 where both are zero.
    """
    plant = problem.plant
    places = [plant.output.elements.index(c) for c in problem.judged_names]
    function = problem.reference.function(plant)
    times = np.linspace(0.0, problem.duration, _SAMPLES)
    states = np.asarray(function.map(_SAMPLES)(times[None, :])[0].full())[places]
    sizes = np.maximum(np.ptp(states, axis=1), np.abs(states[:, 0] - problem.start_output[places]))
    return {c: float(s) if s > 0 else 1.0 for c, s in zip(problem.judged_names, sizes, strict=True)}


def relative_error(metrics: Metrics, sizes: dict[str, float]) -> float:
    """Return the rms error divided by the reference's range, root mean square over the judged coordinates.

    The error of a run that ended early is infinite, larger than that of every other run.
    """
    shares = [rms / sizes[c] for c, rms in metrics.rms_error.items()]
    error = math.sqrt(math.fsum(s * s for s in shares) / len(shares))
    return error if math.isfinite(error) else math.inf


def outcome(run: Run, error: float) -> str:
    """Return 'finished', 'diverged' or 'ended early'."""
    if run.stop is not None:
        return "ended early"
    return "finished" if error <= DIVERGED else "diverged"
