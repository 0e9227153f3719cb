"""Which adaptation suits a plant as estimated: candidates run on it, and come back from a push at the ends of the likelihood.

Gains are shares g of the deadbeat gain: 1 / the largest eigenvalue of Lambda, or the inverse of Lambda where responses are coupled.
A mirror that is right takes lateness for right and leaves it, so mirrors without dead time and lag are candidates too, and one with
three times the lag, which stands for everything slow.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import any_gain, checked
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.leaky import default_pole
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.deformation.wrappers.delayed import Paired
from fpirhc.deformation.wrappers.filtered import Filtered
from fpirhc.errors import FpirhcError
from fpirhc.probing.estimated import estimated_problem, gain_name
from fpirhc.probing.identification import End, Estimates
from fpirhc.review.experiments import PLACES, Bench
from fpirhc.simulation.run import Run
from fpirhc.simulation.trials import errors_of, weighed
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.task.problem import Problem

DARING = ("prompt", "lagging")
"""Candidates that come back at the estimate alone, or begin with the least share: trials have to show them.

The first believes no lateness, the second a lag and no dead time. They are offered whatever the estimate says of them, and trials
go on from there.
"""
SHARES = (0.05, 0.1, 0.16, 0.25, 0.4, 0.65, 1.0)
_POLES = (0.0, 0.5, 0.8)  # of the filter
_FIRST = 0.2  # share with which loops are built
_LARGEST_PRODUCT = 1.99
_STEPS, _OF_RANGE = 1.5, 0.02  # largest step of a command: times that of the controller alone, or of the input's range
_WORTH = 0.95  # error that is worth an adaptation
_FINE = 1.05  # ratio of two shares, between which no other is tried
_LEFT, _CALM = 0.5, 2.0  # of a push at an end; steps there over the largest that are allowed
_TRIED = 8  # candidates of a form that are asked at the ends


@dataclass(frozen=True)
class Form:
    """What candidates share that differ in their gain alone.

    Args:
        referenced: whether it is model-referenced; else the plain one.
        cycles: believed dead time of every input.
        lags: believed lag of every input.
        wrong: cycles by which the dead time may be wrong.
        pole: of the filter; 0: none.
        weighted: whether the gain is a matrix, a share of the inverse of Lambda.
    """

    referenced: bool
    cycles: tuple[float, ...]
    lags: tuple[float, ...]
    wrong: float = 0.0
    pole: float = 0.0
    weighted: bool = False

    def deformation(self, estimates: Estimates, share: float) -> Deformation:
        """Return the deformation with A_c = -2 share / (largest eigenvalue); gains are rounded to three digits."""
        largest = estimates.largest_weighted if self.weighted else estimates.largest
        chosen: Deformation = Affine(
            gain=_rounded(-2 * share / largest), weights=estimates.weights if self.weighted else None
        )
        if self.pole:
            chosen = Filtered(chosen, pole=self.pole)
        cycles, lag = _one(self.cycles), _one(tuple(_rounded(tau) for tau in self.lags))
        late = max(self.cycles) > 0
        if not self.referenced:
            return Paired(chosen, cycles=cycles) if late else chosen
        leak = default_pole(min(max(1 / largest, 1.0), _LARGEST_PRODUCT), self.wrong) if late else None
        return ModelReferenced(chosen, cycles=cycles, lag=lag, pole=None if leak is None else _rounded(float(leak)))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A form and a share on the estimated plant.

    Args:
        error: rms tracking error over that of the controller alone, in the mean over the coordinates.
        steps: rms step of the command over the largest that is allowed.
    """

    form: Form
    share: float
    deformation: Deformation
    error: float = math.inf
    steps: float = math.inf

    def is_larger(self, other: Candidate) -> bool:
        """Whether it differs from the other one by a larger share alone."""
        return self.form == other.form and self.share > other.share


@dataclass(frozen=True, eq=False)
class Case:
    """An end of the likelihood, commands that are later still, and gains that are larger by a factor."""

    end: End
    factor: float
    later: float = 0.0
    slower: float = 1.0

    @property
    def place(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Dead time in cycles and lag of every input."""
        return tuple(c + self.later for c in self.end.cycles), tuple(self.slower * tau for tau in self.end.lags)


class Choice:
    """The choice for one problem and controller."""

    def __init__(
        self,
        problem: Problem,
        controller: Controller,
        estimates: Estimates,
        chatter: float | Mapping[str, float] | None,
    ) -> None:
        """Build the estimated plant and run the controller alone on it."""
        self.bare, self.estimates = without_deformation(controller), estimates
        self._given, self._names, self._chatter = problem, weighed(problem, controller), chatter
        self._benches: dict[object, Bench] = {}
        self._known: dict[object, bool] = {}
        noise = [one.noise for one in estimates.channels]
        middle = estimates.dead[1], estimates.lag[1]
        self.problem = estimated_problem(problem, estimates.gains, *middle, estimates.drift, noise)
        self._alone = self._bench(self.problem, None, "alone").nominal
        self._room = self.allowed(self._alone)

    def shortlist(self) -> dict[str, Candidate]:
        """Return the candidates by name, cautious first; none where nothing safe makes the error clearly less."""
        with compiled_plans():
            calm = {name: self._calm(form) for name, form in self._forms().items()}
            chosen = {name: self._first(some, self._near) for name, some in calm.items()}
            every = sorted((one for some in calm.values() for one in some), key=lambda one: one.error)
            chosen = {"cautious": self._first(every, (*self._far, *self._near)), **chosen}
            for name in DARING:
                if chosen.get(name) is None and name in calm:
                    chosen[name] = self._first(calm[name], self._middle) or self._least(self._forms()[name])
        different: dict[str, Candidate] = {}
        for name, one in chosen.items():
            if one is not None and all(one.deformation != other.deformation for other in different.values()):
                different[name] = one
        return different

    def beside(self, one: Candidate, tried: Iterable[Candidate]) -> dict[float, Candidate]:
        """Return by share the next smaller and the next larger share of the same form, which trials have to show.

        They are those of the list. Where the next larger one is tried already, it is their geometric mean, down to a ratio of 1.05:
        an error falls with the share until the loop is lost, so the best one is near that limit.
        """
        known = {other.share for other in tried if other.form == one.form}
        every = {*SHARES, *known}
        smaller = max((share for share in every if share < one.share), default=one.share)
        larger = min((share for share in every if share > one.share), default=one.share)
        if larger in known and larger / one.share > _FINE:
            larger = float(f"{math.sqrt(larger * one.share):.2g}")
        found = [self._candidate(one.form, share) for share in {smaller, larger} - {one.share, *known}]
        return {other.share: other for other in found if self._accepted(other)}

    def _candidate(self, form: Form, share: float) -> Candidate:
        return Candidate(form, share, form.deformation(self.estimates, share))

    def _calm(self, form: Form) -> list[Candidate]:
        """Shares and filters of a form that are worth it and calm on the estimated plant, best first."""
        found = []
        for pole in _POLES:
            filtered = replace(form, pole=pole)
            for share in SHARES:
                one = self._candidate(filtered, share)
                with any_gain():  # a run judges it
                    run = self._bench(self.problem, one, "middle").nominal
                if run.stop is not None:
                    break  # larger ones are lost too
                error, steps = mean_ratio(self.problem, self._alone, run, self._names), steps_of(run)
                found.append(replace(one, error=error, steps=float((steps / self._room).max())))
        return sorted((one for one in found if one.steps <= 1 and one.error < _WORTH), key=lambda one: one.error)

    def _first(self, some: Iterable[Candidate], cases: Iterable[Case]) -> Candidate | None:
        """The first one that comes back in every case."""
        accepted = [one for one in some if self._accepted(one)][:_TRIED]
        return next((one for one in accepted if all(self._returns(one, case) for case in cases)), None)

    def _least(self, form: Form) -> Candidate | None:
        one = self._candidate(form, SHARES[0])
        return one if self._accepted(one) else None

    def _accepted(self, one: Candidate) -> bool:
        """Whether the loop of the problem takes its gain, which it judges by the model."""
        try:
            checked(self._given, self.bare.with_deformation(one.deformation))
        except FpirhcError:
            return False
        return True

    def _returns(self, one: Candidate | None, case: Case) -> bool:
        """Whether the loop comes back from a push, calmly; true where the controller alone does not."""
        key = one and (one.form, one.share), case.place, case.factor
        if key not in self._known:
            self._known[key] = self._pushed(one, case) or (one is not None and not self._returns(None, case))
        return self._known[key]

    def _pushed(self, one: Candidate | None, case: Case) -> bool:
        if case.place not in self._benches:
            problem = estimated_problem(self._given, self.estimates.gains, *case.place)
            self._benches[case.place] = Bench(problem, self.bare)
        problem = self._benches[case.place].problem
        names, exact = list(problem.real_plant.parameters), problem.real_plant.exact.copy()
        for (i, j), gain in np.ndenumerate(case.factor * case.end.gains):
            exact[names.index(gain_name(i, j))] = gain
        try:
            with any_gain():
                bench = self._bench(problem, one, case.place)
                base = bench.run(exact=exact)
                if base.stop is not None or (steps_of(base) > _CALM * self._room).any():
                    return False
                return bench.pushed(PLACES[0], base=base, exact=exact)[0].left <= _LEFT
        except FpirhcError:  # it cannot be composed
            return False

    def _bench(self, problem: Problem, one: Candidate | None, where: object) -> Bench:
        """The loop with a candidate, which those of one form share."""
        form = None if one is None else one.form
        if (where, form) not in self._benches:
            adapted = None if form is None else self.bare.with_deformation(form.deformation(self.estimates, _FIRST))
            self._benches[where, form] = Bench.of(problem, adapted or self.bare)
        bench = self._benches[where, form]
        return bench if one is None else bench.at_gain(one.share / _FIRST)

    @cached_property
    def _middle(self) -> tuple[Case, ...]:
        """A gain margin of 1.4 to both sides of the estimate alone, and a command that is a cycle later."""
        best = self.estimates.ends[0]
        return Case(best, 1.4), Case(best, 0.6), Case(best, 1.0, later=1)

    @cached_property
    def _near(self) -> tuple[Case, ...]:
        """A gain margin of 1.4 to both sides at every end of the likelihood, and a command a cycle later.

        An end has its own gains: a longer lag with a larger gain says much the same of a record as a shorter one with a smaller.
        """
        ends = {(one.cycles, one.lags): one for one in reversed(self.estimates.ends)}.values()
        return *self._middle[2:], *(Case(one, factor) for factor in (1.4, 0.6) for one in ends)

    @cached_property
    def _far(self) -> tuple[Case, ...]:
        """Twice the gain, and a plant slower by half, because a lag is only a picture of what is slow; a command a cycle later."""
        best, dead, lag = self.estimates.ends[0], self.estimates.dead[2], self.estimates.lag[2]
        slow = np.maximum(lag, 0.25 * self._given.period)
        wide = replace(best, cycles=tuple(dead.tolist()), lags=tuple(slow.tolist()))
        return Case(wide, 2.0, slower=1.5), Case(wide, 1.4, later=1, slower=1.5)

    def _forms(self) -> dict[str, Form]:
        """Forms by name, each once."""
        low, value, high = self.estimates.dead
        likely = np.where(high > low, np.ceil((low + high) / 2), value)
        wrong = float(max((high - likely).max(), (likely - low).max(), 1.0)) if likely.any() else 0.0
        cycles, never = tuple(likely.tolist()), (0.0,) * len(value)
        least, lag, most = (tuple(one.tolist()) for one in self.estimates.lag)
        forms = {
            "referenced": Form(True, cycles, lag, wrong),
            "mirrored": Form(True, cycles, most, wrong),
            "prompt": Form(True, never, never),
            "lagging": Form(True, never, lag),
            "plain": Form(False, cycles, never),
        }
        if any(tau > 0.5 * self._given.period for tau in least):
            forms["long lag"] = Form(True, cycles, tuple(3 * tau for tau in most), 1.0 if likely.any() else 0.0)
        if self.estimates.weights is not None:
            forms |= {"matrix": replace(forms["prompt"], weighted=True)}
            forms |= {"late matrix": replace(forms["referenced"], weighted=True)} if any(cycles) or any(lag) else {}
        return {name: one for k, (name, one) in enumerate(forms.items()) if one not in list(forms.values())[:k]}

    def allowed(self, alone: Run) -> np.ndarray:
        """Return the largest rms step of every input, beside a run of the controller alone."""
        plant, chatter = self._given.plant, self._chatter
        lower, upper = self._given.limits.input_bounds(plant)
        width = np.where(np.isfinite(upper - lower), upper - lower, 0.0)
        usual = np.maximum(_STEPS * steps_of(alone), _OF_RANGE * width)
        if chatter is None:
            return np.asarray(np.maximum(usual, 1e-300))
        limits = chatter if isinstance(chatter, Mapping) else dict.fromkeys(plant.inputs, chatter)
        return np.array([float(limits.get(name, own)) for name, own in zip(plant.inputs, usual, strict=True)])


def mean_ratio(problem: Problem, alone: Run, run: Run, names: frozenset[str] | None) -> float:
    """Return the rms over the coordinates of their errors over those of the controller alone."""
    pair = errors_of(problem, (alone, run), names)
    return float(np.sqrt(np.mean([pair.ratio(name) ** 2 for name in pair.without])))


def steps_of(run: Run) -> np.ndarray:
    """Return the rms step of every command, the transient left out."""
    command = np.asarray(run["command"])
    return np.sqrt(np.mean(np.diff(command[len(command) // 10 :], axis=0) ** 2, axis=0))


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


def _one(values: tuple[float, ...]) -> float | tuple[float, ...]:
    return values[0] if len(set(values)) == 1 else values
