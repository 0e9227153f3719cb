"""Errors of a controller without adaptation and with it, from short runs on the plant and on its own model, and a warning of harm.

A controller is warned of where adaptation makes the first errors larger by far, or where it makes one on the model, with nothing to
adapt, that is larger than that of the wrong model without adaptation. A plant outside is not run for that.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import name_in_task, without_deformation
from fpirhc.errors import FpirhcError, HarmfulAdaptation
from fpirhc.fields.user_code import users_level
from fpirhc.plant.motion import followed_units, with_space
from fpirhc.simulation.metrics import by_name
from fpirhc.simulation.metrics.shipped import at_limit, rms_error
from fpirhc.simulation.model_as_plant import ModelAsPlant, loop_of, shortened
from fpirhc.simulation.run import Run, judged_motion
from fpirhc.symbolic.evaluate import Latest
from fpirhc.task.problem import Problem

WORSE, MUCH_WORSE, FAR_WORSE = 1.2, 2.0, 10.0  # ratio of the errors
_ROUNDING = 1e-9  # share of the coordinate's range
MOSTLY = 0.5  # share of the cycles at a limit, from which a run shows nothing
SLIGHT, CLEAR = 1e-3, 1e-2  # added error as a share of the coordinate's range


@dataclass(frozen=True, eq=False)
class ErrorPair:
    """Errors of two runs on the same plant."""

    # rms tracking error by judged coordinate without adaptation, in the unit of the coordinate; infinite where the run
    # ended early
    without: Mapping[str, float]
    adapted: Mapping[str, float]  # the same with the deformation
    # range of the reference, or the largest error of the run without adaptation where that is larger, by coordinate
    ranges: Mapping[str, float]
    units: Mapping[str, str]  # of the coordinates
    # share of the cycles in which a command stands at a limit, of the run where it is smaller; NaN where one ended before
    # errors count
    at_limit: float = 0.0

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
    def sentence(self) -> str:
        """Both errors of the worst coordinate, where a run may have ended early."""
        unit = with_space(self.units[self.worst])
        before, after = self.without[self.worst], self.adapted[self.worst]
        if not math.isfinite(before):
            other = f"with it the rms error of {self.worst} is {after:.3g}{unit}"
            return f"the run without adaptation ends early, and {other if math.isfinite(after) else 'so does the one with it'}"
        rest = f"{after:.3g}{unit} with it" if math.isfinite(after) else "a run that ends early with it"
        return f"the rms error of {self.worst} is {before:.3g}{unit} without adaptation, {rest}"

    @property
    def stuck(self) -> str:
        """Why the pair shows nothing: commands stand at a limit in both runs; empty where it shows something."""
        if not self.at_limit >= MOSTLY:  # NaN is informative
            return ""
        share = f"{100 * self.at_limit:.3g} %"
        return f"not informative: the command stands at a limit in {share} of the cycles, where no adaptation can act"

    @property
    def passes(self) -> bool:
        """Whether adaptation makes no coordinate worse by more than a fifth and by a thousandth of its range."""
        return not self._beyond(WORSE, SLIGHT)

    @property
    def fails(self) -> bool:
        """Whether it makes one worse by a factor of two and a hundredth of its range, or by ten times and a thousandth.

        Where the run without adaptation ends early there is nothing that it makes worse.
        """
        known = all(map(math.isfinite, self.without.values()))
        return known and (self._beyond(MUCH_WORSE, CLEAR) or self._beyond(FAR_WORSE, SLIGHT))

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
    stuck = float(np.min([at_limit(problem, run) for run in runs]))  # NaN where one of them is
    return ErrorPair(before, after, _ranges(problem, runs[0]), followed_units(problem.plant), stuck)


def _ranges(problem: Problem, run: Run) -> dict[str, float]:
    """Range of the reference, or the largest error of the whole run where that is larger; its size where both are rounding."""
    errors, motion = run["true_error"], run[judged_motion(run.layout)]
    places = [problem.plant.output.elements.index(name) for name in problem.judged_names]
    if not run.cycles:
        return dict.fromkeys(problem.judged_names, 0.0)
    reference = errors + motion[:, places]
    sizes = np.fmax(np.ptp(reference, axis=0), np.abs(errors).max(axis=0))
    largest = np.abs(reference).max(axis=0)
    sizes = np.where(sizes > _ROUNDING * largest, sizes, largest)
    return by_name(problem.judged_names, np.where(np.isfinite(sizes), sizes, 0.0))


def weighed(problem: Problem, controller: Controller) -> frozenset[str] | None:
    """Return the judged coordinates whose errors, or whose derivatives' errors, the plan's cost weighs.

    None stands for all of them: the controller does not plan, the cost does not say, or it weighs no judged coordinate.
    """
    planner = controller.planner
    cost = (planner.cost or problem.cost) if planner else None
    weights = None if cost is None else cost.tracked
    if weights is None:
        return None
    names = {state.rstrip("'") for state in weights}
    return frozenset(n for n in problem.judged_names if n in names) or None


def harm_in(real: ErrorPair | None, null: ErrorPair) -> str:
    """Return what runs on the plant (None: it is outside) and on the model show against adaptation; empty without harm."""
    if real is not None and not real.passes:
        return f"with the wrong model {real.sentence}"
    if not null.passes and (real is None or null.adapted[null.worst] > real.without[null.worst]):
        return f"with a right model {null.sentence}"
    return ""


def experiment(problem: Problem, controller: Controller, cycles: int) -> tuple[ErrorPair | None, ErrorPair]:
    """Return the errors of runs of so many cycles, without adaptation and with it: on the plant, and on the controller's model.

    They are of the coordinates that its cost weighs. A plant outside is not run: it has None.

    Raises:
        FpirhcError: every error that the controller raises about the problem.
    """
    short = shortened(problem, cycles)
    loops = loop_of(short, without_deformation(controller)), loop_of(short, controller)
    names = weighed(short, loops[1].controller)
    null = errors_of(*ModelAsPlant(short, seed=0).pair(loops), names)
    if short.foreign:
        return None, null
    return errors_of(short, [loop.run(seed=0, variant=short) for loop in loops], names), null


CYCLES = 300  # of a run
_REASONS: Latest[list[str]] = Latest(8)  # the same values run alike
_REMEDY = (
    "Use ModelReferenced(map), which leaves an exact model alone, or ask fpirhc review. To silence this, and spare the runs: "
    'warnings.simplefilter("ignore", fpirhc.HarmfulAdaptation)'
)


def warn_of_harm(problem: Problem, controller: Controller) -> None:
    """Warn once where adaptation does harm; nothing is run where the warning is ignored, or nothing adapts a fixed model."""
    if not controller.deformation.adapts or controller.learns or _ignored():
        return
    try:
        reasons = _REASONS.of((problem, controller), (), lambda: _reasons(problem, controller))
    except FpirhcError:  # what the runs cannot do says nothing about the controller
        return
    if reasons:
        what = ", ".join(part for part in (problem.name, name_in_task(controller)) if part)
        text = f"{what}: adaptation does harm, by runs of {CYCLES} cycles: {'; '.join(reasons)}. {_REMEDY}"
        warnings.warn(text, HarmfulAdaptation, stacklevel=users_level())


@contextmanager
def without_warning() -> Iterator[None]:
    """Ignore the warning, for steppers of controllers that are judged anyway."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HarmfulAdaptation)
        yield


def _ignored() -> bool:
    """Whether the first filter for the warning ignores it, whatever its text and place."""
    for action, message, category, module, _ in warnings.filters:
        if issubclass(HarmfulAdaptation, category) and message is None and module is None:
            return action == "ignore"
    return False


def _reasons(problem: Problem, controller: Controller) -> list[str]:
    real, null = experiment(problem, controller, CYCLES)
    reasons = [] if real is None or not real.fails else [f"on the plant {real.sentence}"]
    if null.fails and (real is None or null.adapted[null.worst] > real.without[null.worst]):
        reasons.append(f"on its own model, with nothing to adapt {null.sentence}")
    return reasons
