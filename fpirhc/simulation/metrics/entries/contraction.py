"""The factor by which the iteration shrinks an error per cycle: from the symbols along the run, and from what the run shows."""

from __future__ import annotations

import numpy as np

from fpirhc.contraction import Spectrum, identified_factor, predicted_factor, spectrum_over_run
from fpirhc.simulation.metrics.base import Metric
from fpirhc.simulation.run import Run
from fpirhc.task.problem import Problem

_SHORTEST = 10  # cycles from which a run says something about its contraction
_SAMPLES = 200  # cycles of a run whose eigenvalues are computed


def predicted(problem: Problem, run: Run) -> float | None:
    """Largest max|1 - a lambda| at sampled states of the run; see `fpirhc.contraction`."""
    if not _adapts(run):
        return None
    return predicted_factor(sampled_spectrum(problem, run).eigenvalues, _gain(run))


def measured(problem: Problem, run: Run) -> float | None:  # noqa: ARG001 -- every metric is given the problem
    """The factor that requests and realised responses of the run show; NaN where they do not excite every direction."""
    if not _adapts(run):
        return None
    return identified_factor(run["deformed"], run["plant_realised"], _gain(run))


def _gain(run: Run) -> float:
    gain = run.settings["effective_gain"]
    assert isinstance(gain, float)
    return gain


def sampled_spectrum(problem: Problem, run: Run) -> Spectrum:
    """Eigenvalues of the response Jacobian at sampled cycles of a run, with the parameters that its controller believed."""
    rows = np.unique(np.linspace(1, run.cycles - 1, _SAMPLES).astype(int))
    believed = np.array(run.settings["parameters"])
    return spectrum_over_run(problem.plant, run["state"][rows], run["deformed"][rows], approximate=believed)


def _adapts(run: Run) -> bool:
    """Whether the contraction along the run was logged, which is where a controller adapts the plant's own response."""
    return "contraction" in run.layout and "effective_gain" in run.settings and run.cycles >= _SHORTEST


# A difference of 1e-4 means nothing: the factor is a fit, or a difference of eigenvalues from one.
METRICS = (
    Metric("contraction.predicted", predicted, short="factor", headline=True, floor=1e-4, order=85),
    Metric("contraction.measured", measured, floor=1e-4, order=86),
)
