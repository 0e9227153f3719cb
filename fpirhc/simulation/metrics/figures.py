"""Figures of merit of many fields, as metrics that a problem file lists: `metrics = (fp.figures.InBand("output.BIS", 40, 60),)`.

Each function returns a `Metric` of one signal or of one `Quantity` over the cycles from `measure_from` on; a run that ended early
has NaN. Two figures of one kind in a problem need names of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from fpirhc.errors import InvalidValue, without
from fpirhc.fields.checked import checked_call
from fpirhc.simulation.metrics import Better, Metric, measured_cycles
from fpirhc.simulation.pictures import Quantity, numbers
from fpirhc.simulation.run import Run
from fpirhc.task.problem import Problem

__all__ = ["InBand", "Largest", "Nadir", "Overshoot", "TimeOver", "Total"]
__getattr__ = without("fpirhc.figures", __all__)
What = str | Quantity


@checked_call
def InBand(what: What, low: float, high: float, *, name: str = "in_band") -> Metric:
    """Return the share of the time in which low <= s <= high, from 0 to 1; larger is better.

    Args:
        what: signal of the run, 'output.BIS', or a Quantity.
        low: smallest value of the band, in the signal's unit.
        high: largest value of the band.
        name: of the metric.

    Raises:
        InvalidValue: `low` is not below `high`.
    """
    if not low < high:
        raise InvalidValue(f"InBand({what!r}): low is {low:g} and high is {high:g}; expected low < high")
    return _figure(name, what, lambda s, _: np.mean((s >= low) & (s <= high)), lambda *_: "1", better="larger")


@checked_call
def TimeOver(what: What, level: float, *, name: str = "time_over") -> Metric:
    """Return the time during which s > level, in the problem's unit of time; arguments as in `InBand`."""
    return _figure(name, what, lambda s, period: np.sum(s > level) * period, lambda _, time: time)


@checked_call
def Total(what: What, *, name: str = "total") -> Metric:
    """Return the integral of s over time, its sum over the cycles times the period: EUR for s in EUR/h; see `InBand`."""
    return _figure(name, what, lambda s, period: np.sum(s) * period, _times)


@checked_call
def Largest(what: What, *, name: str = "largest") -> Metric:
    """Return the largest |s|; arguments as in `InBand`."""
    return _figure(name, what, lambda s, _: np.max(np.abs(s)), lambda unit, _: unit)


@checked_call
def Nadir(what: What, *, name: str = "nadir") -> Metric:
    """Return the lowest s; larger is better, as of the frequency of a grid; arguments as in `InBand`."""
    return _figure(name, what, lambda s, _: np.min(s), lambda unit, _: unit, better="larger")


@checked_call
def Overshoot(judged: str, *, name: str = "overshoot") -> Metric:
    """Return how far a judged quantity y goes beyond its reference r, in the direction in which the reference last changed.

    It is max(sign_k (y_k - r_k), 0) over the cycles; sign_k is that of the last change of r, at first that of r_0 - y_0.

    Args:
        judged: coordinate or output, by name.
        name: of the metric.
    """

    def beyond(problem: Problem, run: Run) -> float:
        error, reference = run[f"true_error.{judged}"], run[f"reference.{judged}"]
        changes = np.concatenate([[np.sign(error[0])], np.sign(np.diff(reference))])
        latest = np.maximum.accumulate(np.where(changes != 0, np.arange(len(changes)), 0))
        beyond = -changes[latest] * error
        return float(max(beyond[measured_cycles(problem, run)].max(), 0.0))

    unit = lambda problem, _: problem.plant.followed.get(judged, "")  # noqa: E731 -- one line says it
    return Metric(name, partial(_of_whole_runs, beyond), unit=unit, main=True)


def _figure(
    name: str,
    what: What,
    figure: Callable[[np.ndarray, float], float | np.floating],
    unit: Callable[[str, str], str],
    better: Better = "smaller",
) -> Metric:
    """The metric of one signal: `figure` of its values and the period, `unit` of its unit and that of time."""

    def function(problem: Problem, run: Run) -> float:
        values = numbers(run, what)
        if values.ndim > 1 and values.shape[1] > 1:
            named = f", such as '{what}.{run.layout[what].elements[0]}'" if isinstance(what, str) else ""
            raise InvalidValue(f"expected one number a cycle, got {values.shape[1]} of {what!r}; name one{named}")
        return float(figure(values[measured_cycles(problem, run)], problem.period))

    whole = partial(_of_whole_runs, function)
    return Metric(name, whole, unit=lambda p, _: unit(_unit(p, what), p.time_unit), main=True, better=better)


def _times(unit: str, time: str) -> str:
    """The unit times that of time; a rate per time loses it."""
    return unit.removesuffix(f"/{time}") if unit.endswith(f"/{time}") else f"{unit} {time}"


def _of_whole_runs(function: Callable[[Problem, Run], float], problem: Problem, run: Run) -> float:
    """NaN for a run that ended early or before it is measured."""
    return function(problem, run) if run.stop is None and measured_cycles(problem, run).any() else float("nan")


def _unit(problem: Problem, what: What) -> str:
    """The unit of a state, an output, an error or an input; nothing for other signals."""
    if isinstance(what, Quantity):
        return what.unit
    plant, (signal, _, element) = problem.plant, what.partition(".")
    units = {**plant.followed, **dict(zip(plant.state.elements, plant.state.entry_units, strict=True))}
    commanded = signal in ("command", "command_unclipped", "command_shift", "planned")
    units = {**units, **plant.inputs} if commanded else {**plant.inputs, **units}  # both may have an entry of one name
    higher = signal in ("realised", "nominal", "desired", "deformed", "plant_realised")
    return "" if higher else units.get(element, "")
