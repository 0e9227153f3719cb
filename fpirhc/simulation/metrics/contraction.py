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
from fpirhc.task.exogenous import model_values, real_values, rows_of
from fpirhc.task.problem import Problem

_SHORTEST = 10  # cycles from which a run is long enough for a factor
_SAMPLES = 200  # cycles of a run whose eigenvalues are computed


def predicted(problem: Problem, run: Run) -> float | None:
    """Return the largest max|1 - a lambda| in sampled cycles of the run; None for an ExternalPlant. See `fpirhc.contraction`."""
    eigenvalues = _eigenvalues(problem, run)
    return None if eigenvalues is None else predicted_factor(eigenvalues, _gain(run))


def growing(problem: Problem, run: Run) -> float | None:
    """Return the share of the sampled cycles with max|1 - a lambda| >= 1, in which small errors do not shrink."""
    eigenvalues = _eigenvalues(problem, run)
    return None if eigenvalues is None else float(np.mean(np.abs(1 - _gain(run) * eigenvalues).max(axis=1) >= 1))


def measured(problem: Problem, run: Run) -> float | None:
    """Return the factor that is fitted to requests and responses of the run; NaN where they do not excite every direction.

    None for a plant outside whose response is late, or that nothing excites.
    """
    if not _adapts(run) or (not problem.equations_known and problem.response_delay):
        return None
    factor = identified_factor(run["deformed"], run["plant_realised"], _gain(run), _weights(run))
    return factor if problem.equations_known or np.isfinite(factor) else None


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

    With a reality that is a plant they are those over a whole cycle; signals from outside have the values of the cycle.
    """
    first = max(1, int(np.argmax(measured_cycles(problem, run))))
    rows = np.unique(np.linspace(first, run.cycles - 1, _SAMPLES).astype(int))
    states, deformed, times = run["state"][rows], run["deformed"][rows], run.time[rows] + problem.period / 2
    task = problem.of_equations
    modelled = replace(task, plant=task.real_plant) if run.settings.get("model is reality") else task
    real = run["reality_state"][rows] if "reality_state" in run.layout else states
    known = rows_of(model_values(modelled.plant, task.signals), times, np.array(run.settings["parameters"]))
    exact = rows_of(real_values(task.real_plant, task.signals), times, task.real_plant.exact)
    jacobians = jacobians_along(modelled, real, states, deformed, known, exact)
    finite, weights = jacobians[np.isfinite(jacobians).all(axis=(1, 2))], _weights(run)
    return Spectrum(np.linalg.eigvals(finite if weights is None else finite @ weights))


def _eigenvalues(problem: Problem, run: Run) -> np.ndarray | None:
    """Those of sampled cycles; None where its factors do not follow from equations."""
    eigenvalues = sampled_spectrum(problem, run).eigenvalues if _adapts(run) and problem.equations_known else None
    return eigenvalues if eigenvalues is not None and len(eigenvalues) else None


def _adapts(run: Run) -> bool:
    """Whether the run has a contraction: where its controller adapts the plant's own response."""
    return bool(run.settings.get("iterates")) and run.cycles >= _SHORTEST


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
        always=False,
    ),
    Metric("contraction.growing", growing, title="contraction above 1", text=in_percent, order=85, always=False),
    Metric("contraction.measured", measured, floor=1e-4, order=85, always=False),
)
