"""Short runs of a controller with adaptation and without, on the plant of a problem and on the controller's own model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import cached_property

from fpirhc.controllers.base import Controller
from fpirhc.describe import identity
from fpirhc.simulation.error_pair import ErrorPair, errors_of
from fpirhc.simulation.model_as_plant import ModelAsPlant, shortened
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.symbolic.latest import Latest
from fpirhc.task.problem import Problem


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


def loop_of(problem: Problem, controller: Controller) -> Simulator:
    """Return the closed loop for runs of any duration; it is the same one for problems that differ in their times alone."""
    values = [getattr(problem, field.name) for field in fields(Problem) if field.name not in _TIMES]
    same = tuple(None if isinstance(value, Mapping) and not value else value for value in values)
    build = lambda: simulator(problem, controller, compiled=False)  # noqa: E731
    loop = _LOOPS.of(same, (identity(controller),), build)
    return build() if loop.remembers else loop


_LOOPS: Latest[Simulator] = Latest(8)
_TIMES = {"duration", "measure_from"}  # of a problem, which are no part of its loop


class Trials:
    """Runs beside one controller without adaptation, whose own runs are made once. A plant outside is not run."""

    def __init__(self, problem: Problem, bare: Controller, *, cycles: int, goes_on: bool = False) -> None:
        """Take the problem and the controller without adaptation.

        Args:
            problem: of all runs.
            bare: the controller without adaptation.
            cycles: largest number of cycles of a run.
            goes_on: whether a run with more error, which may be one of the start alone, is made again with so many cycles where
                errors count, unless they count in the short one.

        Raises:
            FpirhcError: every error that the controller raises about the problem.
        """
        self.problem = shortened(problem, cycles)
        end = min(problem.duration, problem.measure_from + cycles * problem.period)
        later = goes_on and 2 * problem.measure_from > cycles * problem.period
        self._later = replace(problem, duration=end) if later else None
        self._model = ModelAsPlant(self.problem, seed=0)
        self._bare = loop_of(self.problem, bare)

    @cached_property
    def _plain(self) -> Run:
        return self._bare.run(seed=0, variant=self.problem)

    @cached_property
    def _plain_later(self) -> Run:
        return self._bare.run(seed=0, variant=self._later)

    def errors(self, controller: Controller) -> tuple[ErrorPair | None, ErrorPair]:
        """Return the errors on the plant, None where it is outside, and those on the model; of coordinates that the cost weighs.

        Raises:
            FpirhcError: every error that the controller raises about the problem.
        """
        loop = loop_of(self.problem, controller)
        names = weighed(self.problem, loop.controller)
        model = self._model.behind(loop.controller.deformation)
        null = errors_of(model.problem, (model.run(self._bare), model.run(loop)), names)
        if self.problem.foreign is not None:
            return None, null
        real = errors_of(self.problem, (self._plain, loop.run(seed=0, variant=self.problem)), names)
        if self._later is not None and not real.passes:
            real = errors_of(self._later, (self._plain_later, loop.run(seed=0, variant=self._later)), names)
        return real, null
