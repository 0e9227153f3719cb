"""Trials of candidates on the plant itself, beside the controller alone: the best one is kept, or none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation.base import Deformation
from fpirhc.errors import FpirhcError
from fpirhc.probing.rule import DARING, Predicted, Rule, mean_ratio, steps_of
from fpirhc.simulation.model_as_plant import shortened
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulator
from fpirhc.simulation.trials import errors_of, weighed
from fpirhc.task.problem import Problem

MARGIN = 1.4  # times its gain that a candidate which prediction has not shown to be safe has to bear in a trial
_LONGEST = 2000  # cycles
_WORSE = 1.03  # largest ratio of any coordinate's error to that of the controller alone
_WORTH = 0.95
_LARGER = 1.5  # ratio of its errors with that gain and with its own
_SHARE = ", share "
_SEEDS = 3  # of the trials of the best candidate
_DARED = 0.9  # ratio of errors, from which a candidate that is stable at the estimate alone is kept


@dataclass(frozen=True)
class Trial:
    """A run on the plant."""

    error: float  # rms error over that of the controller alone, in the mean over the coordinates
    worst: float  # of any coordinate
    bears: bool = True  # False where a run with a larger gain, which a daring candidate has to bear, does not pass
    calm: bool = True  # whether the steps of its commands are within what is allowed

    @property
    def passes(self) -> bool:
        """Whether it makes the error clearly less, and that of no coordinate more, is calm, and bears what it has to."""
        return self.error <= _WORTH and self.worst <= _WORSE and self.bears and self.calm


def best(trials: Mapping[str, Trial]) -> str | None:
    """Return the name of the best trial that passes, a daring one where it is clearly better; None where none does."""
    factors = {name: 1 / _DARED if name.startswith(DARING) else 1.0 for name in trials}
    passing = {name: factors[name] * one.error for name, one in trials.items() if one.passes}
    return min(passing, key=lambda name: passing[name]) if passing else None


class OnPlant:
    """The trials of one problem and controller, whose own run is made once for every seed."""

    def __init__(
        self, problem: Problem, controller: Controller, allowed: Callable[[Run], np.ndarray] | None = None
    ) -> None:
        """Run nothing yet.

        `allowed`: function of the run of the controller alone -> largest rms step of every input; None: any.
        """
        self._problem, self._bare = shortened(problem, _LONGEST), without_deformation(controller)
        self._names, self._allowed = weighed(problem, controller), allowed
        self._alone: dict[int, Run] = {}

    def trial(self, deformation: Deformation, seed: int, *, loud: bool = False) -> Trial | str:
        """Return the trial of a candidate; of one that the loop refuses, the reason.

        `loud`: whether steps of any size are calm.
        """
        alone = self._run_alone(seed)
        try:
            run = self._run(self._bare.with_deformation(deformation), seed)
        except FpirhcError as error:
            return str(error)
        pair = errors_of(self._problem, (alone, run), self._names)
        calm = loud or self._allowed is None or bool((steps_of(run) <= self._allowed(alone)).all())
        ratio = mean_ratio(self._problem, alone, run, self._names)
        return Trial(ratio, max(pair.ratio(n) for n in pair.without), calm=calm)

    def walk(self, rule: Rule, shortlist: dict[str, Predicted], notes: list[str], seed: int) -> dict[str, Trial]:
        """Return trials of the shortlist, then of the shares beside the best one, which are added to it, until there are none.

        The best one is run with other seeds too, and counts with its largest errors: what rings at times may have been lucky.
        """
        results: dict[str, Trial] = {}
        new, proven, again = dict(shortlist), set(), set()
        while True:
            outcomes = {name: self.trial(one.deformation, seed) for name, one in new.items()}
            notes += [f"{name} is not tried: {one}" for name, one in outcomes.items() if isinstance(one, str)]
            results |= {name: one for name, one in outcomes.items() if isinstance(one, Trial)}
            name, new = best(results), {}
            if name is None:
                return results
            chosen = shortlist[name]
            if _walked(name) and name not in proven:  # before a larger share is tried
                proven.add(name)
                if not self._bears_more(chosen.deformation, results[name], seed):
                    notes.append(f"{name} is not kept: on the plant it does not bear {MARGIN:g} times its gain")
                    lost = [n for n in results if _walked(n) and shortlist[n].setting.is_larger(chosen.setting)]
                    results |= {n: replace(results[n], bears=False) for n in (name, *lost)}
                continue
            known = [one.deformation for one in shortlist.values()]
            beside = rule.beside(chosen, shortlist.values())
            titled = {f"{name.partition(',')[0]}{_SHARE}{share:g}": one for share, one in beside.items()}
            new = {title: one for title, one in titled.items() if one.deformation not in known}
            # An error falls with the share until the loop is lost, so a smaller one is tried where no larger one is better.
            new = {title: one for title, one in new.items() if one.setting.is_larger(chosen.setting)} or new
            shortlist |= new
            if not new and name in again:
                return results
            if not new:
                again.add(name)
                results[name] = self._with_other_seeds(chosen.deformation, results[name], seed)

    def _with_other_seeds(self, chosen: Deformation, first: Trial, seed: int) -> Trial:
        """The largest errors of a trial of one candidate, and of two with other seeds."""
        others = [self.trial(chosen, other) for other in self._seeds(seed)[1:]]
        trials = [first, *(one for one in others if isinstance(one, Trial))]
        error, worst = max(one.error for one in trials), max(one.worst for one in trials)
        return replace(first, error=error, worst=worst, calm=all(one.calm for one in trials))

    def _bears_more(self, chosen: Deformation, own: Trial, seed: int) -> bool:
        """Whether trials with a larger gain pass, and have no error that is much larger: else the limit is near."""
        louder = chosen.with_effective_gain(MARGIN * chosen.effective_gain())
        outcomes = (self.trial(louder, other, loud=True) for other in self._seeds(seed))
        return all(isinstance(one, Trial) and one.passes and one.error <= _LARGER * own.error for one in outcomes)

    def _seeds(self, seed: int) -> list[int]:
        """Those of the runs that judge a candidate; one alone where the controller's own run is the same with another."""
        first, second = (self._run_alone(one).log for one in (seed, seed + 1))
        alike = first.shape == second.shape and np.array_equal(first, second, equal_nan=True)
        return [seed] if alike else list(range(seed, seed + _SEEDS))

    def _run_alone(self, seed: int) -> Run:
        if seed not in self._alone:
            self._alone[seed] = self._run(self._bare, seed)
        return self._alone[seed]

    def _run(self, controller: Controller, seed: int) -> Run:
        return simulator(self._problem, controller, compiled=False).run(seed=seed)


def _walked(name: str) -> bool:
    """Whether a candidate is there because of trials: prediction has not shown that it bears a larger gain."""
    return name.startswith(DARING) or _SHARE in name
