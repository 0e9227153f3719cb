"""Trials on the plant itself: the best candidate is kept, or none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation.base import Deformation
from fpirhc.errors import FpirhcError
from fpirhc.probing.rule import mean_ratio
from fpirhc.simulation.error_pair import errors_of
from fpirhc.simulation.model_as_plant import shortened
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulator
from fpirhc.simulation.trials import weighed
from fpirhc.task.problem import Problem

LONGEST = 2000  # cycles
_WORSE = 1.03  # largest ratio of any coordinate's error to that of the controller alone
_WORTH = 0.95


@dataclass(frozen=True)
class Trial:
    """A run on the plant.

    Args:
        error: rms error over that of the controller alone, in the mean over the coordinates.
        worst: of any coordinate.
    """

    error: float
    worst: float

    @property
    def passes(self) -> bool:
        """Whether it makes the error clearly less, and that of no coordinate more."""
        return self.error <= _WORTH and self.worst <= _WORSE


def tried(
    problem: Problem, controller: Controller, candidates: Mapping[str, Deformation], *, seed: int
) -> dict[str, Trial | str]:
    """Return the trial of every candidate, beside one of the controller alone; of one that the loop refuses, the reason.

    Args:
        problem: of which the first 2000 cycles are run.
        controller: with or without a deformation.
        candidates: by name.
        seed: of the runs.
    """
    short, bare, names = shortened(problem, LONGEST), without_deformation(controller), weighed(problem, controller)

    def run(one: Controller) -> Run:
        return simulator(short, one, compiled=False).run(seed=seed)

    def trial(deformation: Deformation) -> Trial | str:
        try:
            again = run(bare.with_deformation(deformation))
        except FpirhcError as error:
            return str(error)
        pair = errors_of(short, (alone, again), names)
        return Trial(mean_ratio(short, alone, again, names), max(pair.ratio(n) for n in pair.without))

    alone = run(bare)
    return {name: trial(deformation) for name, deformation in candidates.items()}


def best(trials: Mapping[str, Trial]) -> str | None:
    """Return the name of the best trial that passes; None where none does."""
    passing = {name: one.error for name, one in trials.items() if one.passes}
    return min(passing, key=lambda name: passing[name]) if passing else None
