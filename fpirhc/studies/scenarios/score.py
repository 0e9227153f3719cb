"""One number by which runs of different controllers are ranked, and when a run counts as failed."""

from __future__ import annotations

import math

import numpy as np

from fpirhc.simulation.metrics import Metrics
from fpirhc.simulation.run import Run
from fpirhc.task.problem import Problem

DIVERGED = 1.0  # relative error from which a run that lasted to its end has diverged: as large as the motion itself
_SAMPLES = 2000


def ranges(problem: Problem) -> dict[str, float]:
    """Range of the reference of every judged coordinate; where it hardly moves, the error at the start, and else 1."""
    plant = problem.plant
    places = [plant.state.elements.index(c) for c in problem.judged_names]
    function = problem.reference.function(plant)
    times = np.linspace(0.0, problem.duration, _SAMPLES)
    states = np.asarray(function.map(_SAMPLES)(times[None, :])[0].full())[places]
    sizes = np.maximum(np.ptp(states, axis=1), np.abs(states[:, 0] - problem.start_state[places]))
    return {c: float(s) if s > 0 else 1.0 for c, s in zip(problem.judged_names, sizes, strict=True)}


def relative_error(metrics: Metrics, sizes: dict[str, float]) -> float:
    """Rms error relative to the reference's range, root mean square over the judged coordinates.

    Infinite for a run that ended early: it is worse than any that did not.
    """
    shares = [error / sizes[c] for c, error in metrics.rms_error.items()]
    found = math.sqrt(math.fsum(s * s for s in shares) / len(shares))
    return found if math.isfinite(found) else math.inf


def outcome(run: Run, error: float) -> str:
    """Return 'finished', 'diverged' or 'ended early'."""
    if run.stop is not None:
        return "ended early"
    return "finished" if error <= DIVERGED else "diverged"
