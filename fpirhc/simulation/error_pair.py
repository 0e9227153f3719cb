"""Errors of a controller without adaptation and with it, and whether adaptation does harm."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fpirhc.plant.motion import followed_units, with_space
from fpirhc.simulation.log import judged_motion
from fpirhc.simulation.metrics.base import measured_errors
from fpirhc.simulation.metrics.entries.errors import rms_error
from fpirhc.simulation.run import Run
from fpirhc.summary import beside
from fpirhc.task.problem import Problem

WORSE, MUCH_WORSE, FAR_WORSE = 1.2, 2.0, 10.0  # ratio of the errors
_ROUNDING = 1e-9  # share of the coordinate's range
MOSTLY = 0.5  # share of the cycles at a limit, from which a run shows nothing
SLIGHT, CLEAR = 1e-3, 1e-2  # added error as a share of the coordinate's range


@dataclass(frozen=True, eq=False)
class ErrorPair:
    """Errors of two runs on the same plant.

    Args:
        without: rms tracking error by judged coordinate without adaptation, in the unit of the coordinate.
        adapted: the same with the deformation; infinite where the run ended early.
        ranges: range of the reference, or the largest error without adaptation where that is larger, by coordinate.
        units: of the coordinates.
        at_limit: share of the cycles in which a command stands at a limit, of the run where it is smaller.
    """

    without: Mapping[str, float]
    adapted: Mapping[str, float]
    ranges: Mapping[str, float]
    units: Mapping[str, str]
    at_limit: float = 0.0

    def unit(self, name: str) -> str:
        """The unit of a coordinate as it stands behind a number."""
        return with_space(self.units[name])

    @property
    def worst(self) -> str:
        """The coordinate to which adaptation adds the largest share of its range."""
        return max(self.without, key=self.added)

    def added(self, name: str) -> float:
        """The error that adaptation adds, as a share of the range of the coordinate."""
        return (self.adapted[name] - self.without[name]) / max(self.ranges[name], 1e-300)

    def ratio(self, name: str) -> float:
        """The error with adaptation over the error without."""
        return self.adapted[name] / max(self.without[name], 1e-300)

    @property
    def text(self) -> str:
        """Both errors of the worst coordinate in a sentence."""
        name, rounding = self.worst, beside(0.5 * _ROUNDING, 1.0)
        before, after = (beside(e[name], self.ranges[name]) for e in (self.without, self.adapted))
        before, after = (one if one == rounding else f"{one}{self.unit(name)}" for one in (before, after))
        if before == after:
            return f"run on its own model, rms error of {name} {before} without adaptation and with it"
        share = f"{100 * self.added(name):+.2g} % of its range"
        return f"run on its own model, rms error of {name} {before} without adaptation and {after} with it, {share}"

    @property
    def sentence(self) -> str:
        """Both errors of the worst coordinate, where a run may have ended early."""
        unit = self.unit(self.worst)
        before, after = self.without[self.worst], self.adapted[self.worst]
        rest = f"{after:.3g}{unit} with it" if math.isfinite(after) else "a run that ends early with it"
        return f"the rms error of {self.worst} is {before:.3g}{unit} without adaptation, {rest}"

    @property
    def stuck(self) -> str:
        """Why the pair shows nothing: commands stand at a limit in both runs; empty where it shows something."""
        if self.at_limit < MOSTLY:
            return ""
        share = f"{100 * self.at_limit:.3g} %"
        return f"not informative: the command stands at a limit in {share} of the cycles, where no adaptation can act"

    @property
    def passes(self) -> bool:
        """Whether adaptation makes no coordinate worse by more than a fifth and by a thousandth of its range."""
        return not self._beyond(WORSE, SLIGHT)

    @property
    def lowers(self) -> bool:
        """Whether adaptation makes no coordinate worse by more than a fifth, however small its errors are."""
        return not self._beyond(WORSE, _ROUNDING)

    @property
    def lower(self) -> bool:
        """Whether the errors are smaller with adaptation, as a sum of squares of their shares of the ranges, and `passes`."""
        sums = [sum((e[n] / max(self.ranges[n], 1e-300)) ** 2 for n in e) for e in (self.without, self.adapted)]
        return self.passes and sums[1] < sums[0]

    @property
    def fails(self) -> bool:
        """Whether it makes one worse by a factor of two and a hundredth of its range, or by ten times and a thousandth."""
        return self._beyond(MUCH_WORSE, CLEAR) or self._beyond(FAR_WORSE, SLIGHT)

    def _beyond(self, ratio: float, share: float) -> bool:
        return any(not (self.ratio(n) <= ratio or self.added(n) <= share) for n in self.without)


def errors_of(problem: Problem, runs: Sequence[Run], names: frozenset[str] | None = None) -> ErrorPair:
    """Return the errors of two runs, without adaptation and with it, from `measure_from` on; of some coordinates, or of all."""
    before, after = (
        {
            name: value if math.isfinite(value) else math.inf
            for name, value in rms_error(problem, run).items()
            if names is None or name in names
        }
        for run in runs
    )
    return ErrorPair(before, after, _ranges(problem, runs[0]), followed_units(problem.plant))


def _ranges(problem: Problem, run: Run) -> dict[str, float]:
    """Range of the reference, or the largest error where that is larger."""
    errors, motion = run["true_error"], run[judged_motion(run.layout)]
    places = [problem.plant.output.elements.index(name) for name in problem.judged_names]
    spans = np.ptp(errors + motion[:, places], axis=0)
    largest = np.abs(measured_errors(problem, run)).max(axis=0)
    rounding = _ROUNDING * np.abs(motion[:, places]).max(axis=0)  # of a set-point that is held without an error
    return {n: float(max(sizes)) for n, *sizes in zip(problem.judged_names, spans, largest, rounding, strict=True)}
