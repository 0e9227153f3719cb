"""Which adaptation suits a plant as estimated: candidates run on it, and come back from a push at the ends of the likelihood.

Gains are shares g of the deadbeat gain: 1 / the largest eigenvalue of Lambda, or the inverse of Lambda where responses are coupled.
A mirror that is right takes lateness for right and leaves it, so mirrors without dead time and lag are candidates too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

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
from fpirhc.simulation.trials import ErrorPair, errors_of, weighed
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.task.problem import Problem

DARING = ("prompt", "lagging")
"""Candidates that come back at the estimate alone, or begin with the least share: trials have to show them."""
SHARES = (0.05, 0.1, 0.16, 0.25, 0.4, 0.65, 1.0)
_POLES = (0.0, 0.5, 0.8)  # of the filter
_FIRST = 0.2  # share with which loops are built
_LARGEST_PRODUCT = 1.99
_STEPS, _OF_RANGE = 1.5, 0.02  # largest step of a command: times that of the controller alone, or of the input's range
_WORTH = 0.95  # error that is worth an adaptation
_FINE = 1.05  # ratio of two shares, between which no other is tried
_LEFT, _CALM = 0.5, 2.0  # of a push at an end; steps there over the largest that are allowed
Case = tuple[End, float]
"""An end of the likelihood, and the factor of its gains."""


@dataclass(frozen=True)
class Form:
    """What candidates share that differ in their gain alone."""

    referenced: bool  # whether it is model-referenced; else the plain one
    cycles: tuple[float, ...]  # believed dead time of every input
    lags: tuple[float, ...]  # believed lag of every input
    wrong: float = 0.0  # cycles by which the dead time may be wrong
    pole: float = 0.0  # of the filter; 0: none
    weighted: bool = False  # whether the gain is a matrix, a share of the inverse of Lambda

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
    """A form and a share on the estimated plant."""

    form: Form
    share: float
    deformation: Deformation
    error: float = math.inf  # rms tracking error over that of the controller alone, in the mean over the coordinates
    steps: float = math.inf  # rms step of the command over the largest that is allowed


class Choice:
    """The choice for one problem and controller."""

    def __init__(
        self, problem: Problem, controller: Controller, estimates: Estimates, chatter: Mapping[str, float] | None
    ) -> None:
        """Build the estimated plant and run the controller alone on it."""
        self.bare, self.estimates = without_deformation(controller), estimates
        self._given, self._names, self._chatter = problem, weighed(problem, controller), chatter
        self._benches: dict[object, Bench] = {}
        self._known: dict[object, bool] = {}
        noise = [one.noise for one in estimates.channels]
        middle = estimates.dead[1], estimates.lag[1]
        self.problem = estimated_problem(problem, estimates.gains, *middle, estimates.drift, noise)
        self._alone = self._bench(None).nominal
        self._room = self.allowed(self._alone)

    def shortlist(self) -> dict[str, Candidate]:
        """Return the candidates by name, cautious first; none where nothing safe makes the error clearly less.

        All come back with a command that is a cycle later and gains of 0.6 and 1.4 times those at every end of the likelihood: a
        longer lag with a larger gain says much the same of a record as a shorter one with a smaller. The cautious one also bears
        twice the gain on a plant that is slower by half, because a lag is only a picture of what is slow.
        """
        ends, most = self.estimates.ends, np.maximum(self.estimates.lag[2], 0.25 * self._given.period)
        later, dead = ends[0].later(), tuple(self.estimates.dead[2].tolist())
        slow = replace(ends[0], cycles=dead, lags=tuple((1.5 * most).tolist()))
        middle: list[Case] = [(ends[0], 1.4), (ends[0], 0.6), (later, 1.0)]
        near: list[Case] = [(later, 1.0), *((one, factor) for factor in (1.4, 0.6) for one in ends)]
        far: list[Case] = [(slow, 2.0), (slow.later(), 1.4)]
        forms = self.forms()
        with compiled_plans():
            calm = {name: self._calm(form) for name, form in forms.items()}
            every = sorted((one for some in calm.values() for one in some), key=lambda one: one.error)
            chosen = {"cautious": self._first(every, far + near)}
            chosen |= {name: self._first(some, near) for name, some in calm.items()}
            for name in DARING:
                if name in forms and chosen[name] is None:
                    least = self._candidate(forms[name], SHARES[0])
                    chosen[name] = self._first(calm[name], middle) or self._first([least], [])
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
                with any_gain():  # a run judges it
                    run = self._bench(filtered).at_gain(share / _FIRST).nominal
                if run.stop is not None:
                    break  # larger ones are lost too
                error = mean_ratio(errors_of(self.problem, (self._alone, run), self._names))
                steps = float((steps_of(run) / self._room).max())
                found.append(replace(self._candidate(filtered, share), error=error, steps=steps))
        return sorted((one for one in found if one.steps <= 1 and one.error < _WORTH), key=lambda one: one.error)

    def _first(self, some: Iterable[Candidate], cases: Iterable[Case]) -> Candidate | None:
        """The first one that comes back in every case."""
        return next((one for one in some if self._accepted(one) and all(self._returns(one, *c) for c in cases)), None)

    def _accepted(self, one: Candidate) -> bool:
        """Whether the loop of the problem takes its gain, which it judges by the model."""
        try:
            checked(self._given, self.bare.with_deformation(one.deformation))
        except FpirhcError:
            return False
        return True

    def _returns(self, one: Candidate | None, end: End, factor: float) -> bool:
        """Whether the loop comes back from a push, calmly; true where the controller alone does not."""
        key = one and (one.form, one.share), end.cycles, end.lags, factor
        if key not in self._known:
            back = self._pushed(one, end, factor)
            self._known[key] = back or (one is not None and not self._returns(None, end, factor))
        return self._known[key]

    def _pushed(self, one: Candidate | None, end: End, factor: float) -> bool:
        try:
            with any_gain():
                bench = self._bench(one.form if one else None, (end.cycles, end.lags))
                plant = bench.problem.real_plant
                names, exact = list(plant.parameters), plant.exact.copy()
                for (i, j), gain in np.ndenumerate(factor * end.gains):
                    exact[names.index(gain_name(i, j))] = gain
                bench = bench if one is None else bench.at_gain(one.share / _FIRST)
                base = bench.run(exact=exact)
                if base.stop is not None or (steps_of(base) > _CALM * self._room).any():
                    return False
                return bench.pushed(PLACES[0], base=base, exact=exact)[0].left <= _LEFT
        except FpirhcError:  # it cannot be composed
            return False

    def _bench(self, form: Form | None, place: tuple[tuple[float, ...], tuple[float, ...]] | None = None) -> Bench:
        """The loop with the first share of a form, at dead times and lags; None: those of the estimate, with drift and noise."""
        if (form, place) not in self._benches:
            if form is not None:
                adapted = self.bare.with_deformation(form.deformation(self.estimates, _FIRST))
                bench = Bench.of(self._bench(None, place).problem, adapted)
            elif place is not None:
                bench = Bench(estimated_problem(self._given, self.estimates.gains, *place), self.bare)
            else:
                bench = Bench(self.problem, self.bare)
            self._benches[form, place] = bench
        return self._benches[form, place]

    def forms(self) -> dict[str, Form]:
        """Return the forms by name, each once."""
        low, value, high = self.estimates.dead
        likely = np.where(high > low, np.ceil((low + high) / 2), value)
        wrong = float(max((high - likely).max(), (likely - low).max(), 1.0)) if likely.any() else 0.0
        cycles, never = tuple(likely.tolist()), (0.0,) * len(value)
        lag = tuple(self.estimates.lag[1].tolist())
        forms = {
            "referenced": Form(True, cycles, lag, wrong),
            "prompt": Form(True, never, never),
            "lagging": Form(True, never, lag),
            "plain": Form(False, cycles, never),
        }
        if self.estimates.weights is not None:
            forms["matrix"] = replace(forms["prompt"], weighted=True)
        return {name: one for k, (name, one) in enumerate(forms.items()) if one not in list(forms.values())[:k]}

    def allowed(self, alone: Run) -> np.ndarray:
        """Return the largest rms step of every input, beside a run of the controller alone."""
        plant, chatter = self._given.plant, self._chatter
        lower, upper = self._given.limits.input_bounds(plant)
        width = np.where(np.isfinite(upper - lower), upper - lower, 0.0)
        usual = np.maximum(_STEPS * steps_of(alone), _OF_RANGE * width)
        limits = chatter or {}
        return np.array([limits.get(n, max(own, 1e-300)) for n, own in zip(plant.inputs, usual, strict=True)])


def mean_ratio(pair: ErrorPair) -> float:
    """Return the rms over the coordinates of their errors over those of the controller alone."""
    return float(np.sqrt(np.mean([pair.ratio(name) ** 2 for name in pair.without])))


def steps_of(run: Run) -> np.ndarray:
    """Return the rms step of every command, the transient left out."""
    command = np.asarray(run["command"])
    return np.sqrt(np.mean(np.diff(command[len(command) // 10 :], axis=0) ** 2, axis=0))


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


def _one(values: tuple[float, ...]) -> float | tuple[float, ...]:
    return values[0] if len(set(values)) == 1 else values
