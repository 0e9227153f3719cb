"""Numbers that sum up a run.

Errors are nominal minus actual of the controlled coordinates; everything is taken from `problem.measure_from` on, except
settling and statuses, which are taken from the whole run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fpirhc.simulation.run import Run
from fpirhc.status import Status
from fpirhc.summary import line, number, table
from fpirhc.task.problem import Problem

SETTLED = 0.02  # share of the reference's range (or of the first error) that counts as settled


@dataclass(frozen=True)
class Metrics:
    """What a run achieved.

    rms_error, max_error, iae (integral of |error|), settling (s; NaN: never): by coordinate.
    effort: rms command by input. clipped_share: share of cycles with a clipped command.
    cost: integral of the stage cost along the run by term, and 'total'; empty without a cost.
    solve: solves, median and worst iterations, worst stationarity and feasibility; empty without an optimiser.
    statuses: cycles by status. worst_status: the worst. contraction_measured: see `fpirhc.contraction`.
    """

    rms_error: Mapping[str, float]
    max_error: Mapping[str, float]
    iae: Mapping[str, float]
    settling: Mapping[str, float]
    effort: Mapping[str, float]
    clipped_share: float
    cost: Mapping[str, float]
    solve: Mapping[str, float]
    statuses: Mapping[str, int]
    worst_status: str

    def __repr__(self) -> str:
        errors = ", ".join(f"{name} {number(value)}" for name, value in self.rms_error.items())
        return line(
            self, f"rms error {errors}", f"clipped {100 * self.clipped_share:.3g} %", f"worst {self.worst_status}"
        )

    def _repr_html_(self) -> str:
        """Errors by coordinate as a table, for notebooks."""
        measures = (self.rms_error, self.max_error, self.iae, self.settling)
        rows = [(name, *(number(m[name]) for m in measures)) for name in self.rms_error]
        effort = ", ".join(f"{name} {number(value)}" for name, value in self.effort.items())
        cost = ", ".join(f"{name} {number(value)}" for name, value in self.cost.items())
        cycles = ", ".join(f"{count} {name}" for name, count in self.statuses.items())
        notes = [f"rms command: {effort}", f"cost: {cost}" if cost else "", f"cycles: {cycles}"]
        notes.append(f"clipped: {100 * self.clipped_share:.3g} % of the cycles")
        return table("Metrics", ("coordinate", "rms error", "max error", "iae", "settled [s]"), rows, notes)


def measure(problem: Problem, run: Run) -> Metrics:
    """Return the metrics of a run; a run that ended before `measure_from` has NaN errors."""
    names = run.layout["error"].elements
    late = run.time >= problem.measure_from - 0.5 * problem.period
    errors, commands = true_errors(run)[late], run["command"][late]
    complete = run.stop is None and errors.shape[0] > 0
    if not complete:
        errors = np.full((1, len(names)), np.nan)
    return Metrics(
        rms_error=_by_name(names, np.sqrt(np.mean(errors**2, axis=0))),
        max_error=_by_name(names, np.max(np.abs(errors), axis=0)),
        iae=_by_name(names, np.sum(np.abs(errors), axis=0) * problem.period),
        settling=_by_name(names, np.array([_settling(run, c) for c in names])),
        effort=_by_name(run.layout["command"].elements, _rms(commands)),
        clipped_share=float(np.mean(run["clipped"])) if run.cycles else float("nan"),
        cost=_cost(run, late),
        solve=_solve(run),
        statuses=_statuses(run),
        worst_status=_worst(run),
    )


def true_errors(run: Run) -> np.ndarray:
    """Reference minus the plant's state at the same time; what a controller sees may be delayed, noisy, or predicted."""
    return run["true_error"] if "true_error" in run.layout else run["error"]


def _by_name(names: tuple[str, ...], values: np.ndarray) -> dict[str, float]:
    return {n: float(v) for n, v in zip(names, values, strict=True)}


def _rms(values: np.ndarray) -> np.ndarray:
    if not values.shape[0]:
        return np.full(values.shape[1], np.nan)
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _settling(run: Run, coordinate: str) -> float:
    """Time from which |error| stays within the band; 0 when it never left it, NaN when it ends outside."""
    if run.stop is not None or not run.cycles:
        return float("nan")
    place = run.layout["error"].elements.index(coordinate)
    error, reference = np.abs(true_errors(run)[:, place]), run[f"reference.{coordinate}"]
    band = SETTLED * max(float(np.ptp(reference)), float(error[0]), 1e-12)
    outside = np.flatnonzero(error > band)
    if not outside.size:
        return 0.0
    last = int(outside[-1])
    return float(run.time[last + 1]) if last + 1 < run.cycles else float("nan")


def _cost(run: Run, late: np.ndarray) -> dict[str, float]:
    if "cost" not in run.layout or run.stop is not None:
        return {}
    terms = _by_name(run.layout["cost"].elements, run["cost"][late].sum(axis=0))
    return {**terms, "total": sum(terms.values())}


def _solve(run: Run) -> dict[str, float]:
    if "solve" not in run.layout or not run.cycles:
        return {}
    solved = np.unique(run["solve"], axis=0)
    return {
        "median_iterations": float(np.median(run["solve.iterations"])),
        "worst_iterations": float(np.max(run["solve.iterations"])),
        "median_stationarity": float(np.median(run["solve.stationarity"])),
        "worst_stationarity": float(np.max(run["solve.stationarity"])),
        "worst_feasibility": float(np.max(run["solve.feasibility"])),
        "plans": float(solved.shape[0]),
    }


def _statuses(run: Run) -> dict[str, int]:
    values, counts = np.unique(run["status"].astype(int), return_counts=True)
    found = {Status(int(v)).name: int(c) for v, c in zip(values, counts, strict=True)}
    if run.stop is not None:
        found[Status.NON_FINITE.name] = found.get(Status.NON_FINITE.name, 0) + 1
    return found


def _worst(run: Run) -> str:
    found = _statuses(run)
    return max((Status[name] for name in found), default=Status.OK).name
