"""The contract of metrics: one value holds a number's name, function, appearance and comparison."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Literal, SupportsIndex

import numpy as np

from fpirhc.errors import InvalidName, InvalidValue
from fpirhc.fields.checked import Checked
from fpirhc.plant.motion import followed_units
from fpirhc.simulation.metrics.summed import Summed
from fpirhc.simulation.run import Run
from fpirhc.summary import written_out
from fpirhc.task.problem import Problem

Better = Literal["smaller", "larger", "neither"]
Compared = Literal["banded", "tight", "exact", "not"]
Function = Callable[[Problem, Run], float | Mapping[str, float] | None]

_NAME = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)?")


def _no_step(period: float, cycles: int) -> float:  # noqa: ARG001
    return 0.0


@dataclass(frozen=True, eq=False)
class Metric(Checked):
    """A number that sums up a run, or one number for every coordinate, input or term.

        overshoot = Metric("overshoot", function, by="coordinate", unit=lambda problem, name: problem.plant.coordinates[name])

    Args:
        name: small letters, digits and '_'; one dot may put it in a group, 'solve.worst_iterations'.
        function: (problem, run) -> a number, or with `by` a mapping with one number for every element; None where the run has no
            such number. NaN means that the run did not reach it. A `Summed` is summed up where runs keep no log, too.
        by: kind of the elements ('coordinate', 'input', 'term', ...); None for one number.
        unit: of every element: text, or a function (problem, element) -> text; the element of a single number is ''.
        better: direction of an improvement: 'smaller', 'larger' or 'neither'.
        title: heading in a report; '': the name.
        short: heading on a terminal; '': the heading in a report.
        text: function that writes a finite number.
        headline: whether the metric stands in short tables; its best value is marked in the report.
        report: whether the metric stands in the report's table.
        shown: the elements that stand in the report's table; None: all.
        compared: how baselines compare it: 'banded' (inside a computed band), 'tight' (to 1e-6), 'exact', 'not'.
        finite: whether a run that finished must have a finite number.
        floor: size of a difference up to which two numbers count as equal.
        step: (period, number of cycles) -> the smallest step of a number that counts cycles; zero for every other number.
        order: place among the columns, smallest first.
        reads: names of the signals that its function reads, where it reads nothing else of a run; None: anything.

    Raises:
        InvalidName: a name that cannot be a key.
        InvalidValue: an unknown direction or comparison.
    """

    name: str
    function: Function
    by: str | None = None
    unit: str | Callable[[Problem, str], str] = "1"
    better: Better = "smaller"
    title: str = ""
    short: str = ""
    text: Callable[[float], str] = written_out
    headline: bool = False
    report: bool = True
    shown: tuple[str, ...] | None = None
    compared: Compared = "banded"
    finite: bool = False
    floor: float = 1e-12
    step: Callable[[float, int], float] = _no_step
    order: float = 100.0
    reads: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise InvalidName(
                f"metric {self.name!r}: expected a name of small letters, digits and '_', such as 'rms_error' or "
                "'solve.worst_iterations'"
            )

    def __reduce_ex__(self, protocol: SupportsIndex) -> str | tuple[object, ...]:
        """A known metric is pickled by its name, so that metrics of runs can come from other processes."""
        from fpirhc.simulation.metrics.measuring import known_metric

        return (known_metric, (self.name,)) if known_metric(self.name) is self else super().__reduce_ex__(protocol)

    @property
    def summed(self) -> Summed | None:
        """How it is summed up cycle by cycle, for runs side by side that keep no log; None: its function reads a log."""
        return self.function if isinstance(self.function, Summed) else None

    @property
    def heading(self) -> str:
        """Heading in a report."""
        return self.title or self.name.replace("_", " ").replace(".", " ")

    def key(self, element: str) -> str:
        """Return the name of one number in files: 'rms_error.q1', or the metric's name."""
        return f"{self.name}.{element}" if element else self.name

    def unit_of(self, problem: Problem, element: str) -> str:
        """Return the unit of one element."""
        return self.unit if isinstance(self.unit, str) else self.unit(problem, element)

    def values(self, problem: Problem, run: Run) -> dict[str, float]:
        """Return the numbers of a run by element, a single number under ''; empty where the run has none.

        Raises:
            InvalidValue: the function did not return numbers, or not in the form that `by` announces.
        """
        return self.numbers(self.function(problem, run))

    def numbers(self, result: object) -> dict[str, float]:
        """Return a result of the function as numbers by element; see `values`.

        Raises:
            InvalidValue: no numbers, or not in the form that `by` announces.
        """
        if result is None:
            return {}
        if isinstance(result, Mapping) != (self.by is not None):
            expected = "one number" if self.by is None else f"a mapping with a number for every {self.by}"
            raise InvalidValue(
                f"metric '{self.name}': its function must return {expected}, got {type(result).__name__}"
            )
        items = result.items() if isinstance(result, Mapping) else [("", result)]
        return {str(element): self._number(value) for element, value in items}

    def _number(self, value: object) -> float:
        """The value as a number; a count stays whole, so that files show a whole number."""
        if isinstance(value, Integral):
            return int(value)
        if isinstance(value, Real):
            return float(value)
        raise InvalidValue(f"metric '{self.name}': expected numbers, got {type(value).__name__}")


def first_measured(problem: Problem) -> int:
    """Return the first cycle that is measured."""
    return max(0, math.ceil(problem.measure_from / problem.period - 0.5))


def measured_cycles(problem: Problem, run: Run) -> np.ndarray:
    """Return which cycles are measured, those from `measure_from` on; shape (cycles,), boolean."""
    return np.asarray(run.time >= problem.measure_from - 0.5 * problem.period)


def measured_errors(problem: Problem, run: Run) -> np.ndarray:
    """Return the true errors of the measured cycles, shape (cycles, coordinates).

    A run that ended early, or before `measure_from`, has one row of NaN.
    """
    errors = run["true_error"][measured_cycles(problem, run)]
    if run.stop is not None or not errors.shape[0]:
        return np.full((1, errors.shape[1]), np.nan)
    return np.asarray(errors)


def by_name(names: Sequence[str], values: np.ndarray) -> dict[str, float]:
    """Return numbers by name."""
    return {n: float(v) for n, v in zip(names, values, strict=True)}


def coordinate_unit(problem: Problem, coordinate: str) -> str:
    """Return the unit of a judged coordinate or output."""
    return followed_units(problem.plant)[coordinate]


def input_unit(problem: Problem, name: str) -> str:
    """Return the unit of an input."""
    return problem.plant.inputs[name]
