"""The factor by which the iteration shrinks an error per cycle: from the symbols along the run, and identified from the run.

Factors from the symbols are those of the measured cycles. A run that ended before `measure_from` has them all along.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fpirhc.contraction.spectrum import Spectrum, identified_factor, jacobians_along, predicted_factor
from fpirhc.simulation.metrics.base import Metric, measured_cycles
from fpirhc.simulation.run import Run
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem

_SHORTEST = 10  # cycles from which a run is long enough for a factor
_SAMPLES = 200  # cycles of a run whose eigenvalues are computed


def predicted(problem: Problem, run: Run) -> float | None:
    """Return the largest max|1 - a lambda| in sampled cycles of the run; None for an ExternalPlant. See `fpirhc.contraction`."""
    if not _differentiable(problem, run):
        return None
    return predicted_factor(sampled_spectrum(problem, run).eigenvalues, _gain(run))


def growing(problem: Problem, run: Run) -> float | None:
    """Return the share of the sampled cycles with max|1 - a lambda| >= 1, in which small errors do not shrink."""
    if not _differentiable(problem, run):
        return None
    factors = np.abs(1 - _gain(run) * sampled_spectrum(problem, run).eigenvalues).max(axis=1)
    return float(np.mean(factors >= 1))


def measured(problem: Problem, run: Run) -> float | None:  # noqa: ARG001 -- every metric is given the problem
    """Return the factor that is fitted to requests and responses of the run; NaN where they do not excite every direction."""
    if not _adapts(run):
        return None
    return identified_factor(run["deformed"], run["plant_realised"], _gain(run), _weights(run))


def _gain(run: Run) -> float:
    gain = run.settings["effective_gain"]
    assert isinstance(gain, float)
    return gain


def _weights(run: Run) -> np.ndarray | None:
    rows = run.settings.get("weights")
    return None if rows is None else np.array(rows)


def sampled_spectrum(problem: Problem, run: Run) -> Spectrum:
    """Return the eigenvalues of the weighted response Jacobian at sampled cycles of a run, with its controller's parameters.

    The cycles are those from `measure_from` on, without the first of the run, before which there is no request.

    With a reality that is a plant they are those over a whole cycle.
    """
    first = max(1, int(np.argmax(measured_cycles(problem, run))))
    rows = np.unique(np.linspace(first, run.cycles - 1, _SAMPLES).astype(int))
    approximate, states, deformed = np.array(run.settings["parameters"]), run["state"][rows], run["deformed"][rows]
    task = problem.of_equations
    modelled = replace(task, plant=task.real_plant) if run.settings.get("model is reality") else task
    real = run["reality_state"][rows] if "reality_state" in run.layout else states
    exact = np.tile(task.real_plant.exact, (len(rows), 1))
    jacobians = jacobians_along(modelled, real, states, deformed, approximate, exact)
    finite, weights = jacobians[np.isfinite(jacobians).all(axis=(1, 2))], _weights(run)
    return Spectrum(np.linalg.eigvals(finite if weights is None else finite @ weights))


def _differentiable(problem: Problem, run: Run) -> bool:
    """Whether its factors follow from equations."""
    return _adapts(run) and problem.equations_known


def _adapts(run: Run) -> bool:
    """Whether the run has a contraction: where its controller adapts the plant's own response."""
    return "contraction" in run.layout and "effective_gain" in run.settings and run.cycles >= _SHORTEST


# They read more signals of a run with a contraction, which only one that is judged has.
# A difference of 1e-4 has no meaning: the factor is a fit, or a difference of eigenvalues from one.
METRICS = (
    Metric(
        "contraction.predicted",
        predicted,
        short="contr. factor",
        better="neither",  # the smallest factor is not the best gain
        headline=True,
        floor=1e-4,
        order=85,
        reads=("contraction",),
    ),
    Metric(
        "contraction.growing",
        growing,
        title="contraction above 1",
        text=in_percent,
        compared="not",
        order=85,
        reads=("contraction",),
    ),
    Metric("contraction.measured", measured, floor=1e-4, order=85, reads=("contraction",)),
)
