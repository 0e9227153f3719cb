"""The models' own runs of one review: controllers that differ in their deformation alone share one."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved, without_deformation
from fpirhc.describe import identity
from fpirhc.errors import FpirhcError
from fpirhc.review.prediction import NominalRun, nominal_run
from fpirhc.simulation.model_as_plant import shortened
from fpirhc.task.problem import Problem

CYCLES = 2000  # of a run

Kept = TypeVar("Kept")


@dataclass(frozen=True, eq=False)
class NominalRuns:
    """Runs of a problem's models, each made when it is first asked for.

    Args:
        problem: the problem; its runs are shortened to at most `CYCLES` cycles.
    """

    problem: Problem
    _known: dict[Hashable, NominalRun | str] = field(default_factory=dict, init=False)
    _others: dict[Hashable, object] = field(default_factory=dict, init=False)

    def of(self, controller: Controller) -> NominalRun | str:
        """Return the nominal run with the controller's deformation, or the reason why there is none."""
        try:
            bare = without_deformation(resolved(self.problem, controller))
        except FpirhcError as error:
            return str(error)
        name = identity(bare)
        if name not in self._known:
            self._known[name] = self._run(controller)
        run = self._known[name]
        return run if isinstance(run, str) else replace(run, controller=controller)

    def once(self, name: Hashable, make: Callable[[], Kept]) -> Kept:
        """Return what `make` returns, made when this name is first asked for."""
        if name not in self._others:
            self._others[name] = make()
        return cast("Kept", self._others[name])

    def _run(self, controller: Controller) -> NominalRun | str:
        try:
            return nominal_run(shortened(self.problem, CYCLES), controller, compiled=False)
        except FpirhcError as error:
            return str(error)
