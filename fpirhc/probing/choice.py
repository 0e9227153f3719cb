"""The plant as estimated, and which adaptation suits it: gains that it bears doubled, then trials on the plant itself.

The estimated plant is the model behind gains, dead times, lags and the recorded drift, as the reality of the problem. A mirror that
is right takes lateness for right and leaves it, so mirrors without dead time and lag are candidates too.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.reference_states import reference_states
from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation, default_pole, own_gain
from fpirhc.deformation.delayed import Paired
from fpirhc.deformation.filters import Filtered
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.errors import FpirhcError, require
from fpirhc.plant.parameter import outside
from fpirhc.plant.plant import Plant
from fpirhc.probing.identification import Estimates
from fpirhc.sensing.sensing import Sensor
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulator
from fpirhc.simulation.trials import behind_actuators, errors_of, shortened, weighed
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.symbolic.layout import Expression, Named
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.disturbance import Noise
from fpirhc.task.exogenous import Samples, Unknown
from fpirhc.task.problem import Problem
from fpirhc.task.reality import Reality

Progress = Callable[[str, int, int], None]  # of (what is done, how much of it, in all)
_SHARES, _POLES = 0.5 ** np.arange(1, 8), (0.0, 0.5, 0.8)  # of the deadbeat gain; of the filter
_STEPS, _OF_RANGE = 1.5, 0.02  # largest step of a command: times that of the controller alone, or of the input's range
_WORTH, _WORSE = 0.95, 1.03  # error that is worth an adaptation; largest one of any coordinate
LONGEST, _CYCLES = 2000, 300  # of a trial at most; of a run on the estimate, where the record is shorter
_STEP, _FARTHEST = 1.6, 6  # ratio of the gains of two trials, and how many at most
MARGIN, _LARGER = 1.4, 1.5  # times its gain that what is kept has to bear, and the ratio of the errors then
_SEEDS, _BEGUN, _CLEARLY = 3, 0.2, 0.97  # of these runs; share of a run that does not count; error worth a larger gain


class Choice:
    """The choice for one problem and controller."""

    def __init__(
        self, problem: Problem, bare: Controller, estimates: Estimates, noise: Mapping[str, float],
        chatter: Mapping[str, float], progress: Progress, own: Controller,
    ) -> None:  # fmt: skip
        self._given, self._estimates, self._progress, self._own = problem, estimates, progress, own.deformation
        moved = estimates.drift, noise
        self.problem = estimated_problem(problem, estimates.gains, *estimates.likely, *moved)
        known = estimates.ends.items()
        ends = [estimated_problem(problem, gains, [c + 1 for c in dead], lags, *moved) for (dead, lags), gains in known]
        real = shortened(problem, LONGEST)
        self._real, self._estimated, *self._ends = (Trials(one, bare, chatter) for one in (real, self.problem, *ends))
        self.results, self.notes = dict[str, Trial](), list[str]()
        self._places = dict[str, tuple[str, float]]()  # form, and by how many steps its gain is larger
        self.candidates = self._shortlist()

    def _forms(self, share: float, pole: float) -> dict[str, Deformation]:
        """The forms by name, with a share of the deadbeat gain: 1 / the largest eigenvalue of Lambda, or its inverse."""
        known, age = self._estimates, self._given.sensing.delay(self._given.plant, self._given.period)
        low, likely, high = known.dead[0], known.counted, known.dead[2]
        late, cycles, lag = bool(likely.any()), _one(likely), _one(known.lag[1])
        wrong = float(max((high - likely).max(), (likely - low).max(), 1.0))
        leak = _rounded(default_pole(min(max(1 / known.largest, 1.0), 1.99), wrong)) if late else None

        def mapped(largest: float, weights: tuple[tuple[float, ...], ...] | None = None) -> Deformation:
            one = Affine(gain=_rounded(-2 * (share / largest)), weights=weights)
            return Filtered(one, pole=pole) if pole else one

        one = mapped(known.largest)
        found: dict[str, Deformation] = {
            "ModelReferenced": ModelReferenced(one, cycles=cycles, lag=lag, pole=leak),
            "ModelReferenced(cycles=0, lag=0)": ModelReferenced(one, cycles=0.0, lag=0.0),
            "ModelReferenced(cycles=0)": ModelReferenced(one, cycles=0.0, lag=lag),
            # A model behind the same estimator shares its delay, and a desired response does not.
            "Paired" if late or age else "Affine": Paired(one, cycles=_one(likely + age)) if late or age else one,
        }
        if known.weights is not None:
            weighted = mapped(known.largest_weighted, known.weights)
            found["ModelReferenced(Affine(weights))"] = ModelReferenced(weighted, cycles=0.0, lag=0.0)
        return {name: one for k, (name, one) in enumerate(found.items()) if one not in list(found.values())[:k]}

    def _shortlist(self) -> dict[str, Deformation]:
        """What makes the error on the plant as estimated clearly less, by name of its form and gain, the best first."""
        found = dict[str, tuple[float, Deformation]]()
        with compiled_plans():
            for done, name in enumerate(names := self._forms(1.0, 0.0), 1):
                if one := self._best(name):
                    found[f"{name}, gain {own_gain(one[1])[1]:.4g}"] = one
                self._progress("gains on the plant as estimated", done, len(names))
        return {name: found[name][1] for name in sorted(found, key=lambda name: found[name][0])}

    def _best(self, name: str) -> tuple[float, Deformation] | None:
        """Error and deformation of a form, with the best of the filters whose commands are calm; None where none is worth it."""
        found = []
        for pole in _POLES:
            every = (self._forms(share, pole)[name] for share in _SHARES)
            # Doubled it makes the error no larger at any end of what the record allows, a cycle later.
            borne = (one for one in every if all(end.of(_times(one, 2), loud=True).error <= 1 for end in self._ends))
            if (one := next(borne, None)) and (trial := self._estimated.of(one)).passes:
                found.append((trial.error, one))
        return min(found, key=lambda pair: pair[0], default=None)

    def on_plant(self, seed: int) -> None:
        """Run the candidates, each with other gains as long as they help; the best one has to bear 1.4 times its gain."""
        starts = list(self.candidates)
        if self._own.adapts:
            self.candidates[own := f"{type(self._own).__name__}, as it is"] = self._own
            self._tried(own, 0, math.inf, seed)
        for done, form in enumerate(starts, 1):
            error, place = self._tried(form, 0, math.inf, seed), 0
            for step, share in ((1, _CLEARLY), (-1, math.inf)):
                while abs(place) < _FARTHEST and (less := self._tried(form, place + step, share * error, seed)) < error:
                    error, place = less, place + step
                if place:
                    break
            self._progress("candidates on the plant", done, len(starts))
        while name := self.best:
            larger, limit = _times(self.candidates[name], MARGIN), _LARGER * self.results[name].error
            more = [self._real.of(larger, other, loud=True) for other in range(seed, seed + _SEEDS)]
            if all(one.passes and one.error <= limit for one in more):
                if abs(self._places[name][1]) == _FARTHEST:
                    self.notes.append(f"{name} is at the edge of what was tried: a gain beyond it may do better")
                return
            self.notes.append(f"{name} is not kept: on the plant it does not bear {MARGIN:g} times its gain")
            form, at = self._places[name]
            lost = [n for n, (other, place) in self._places.items() if other == form and place >= at]
            self.results |= {n: replace(self.results[n], sound=False) for n in lost}
            if at > -_FARTHEST and (form, at - 0.5) not in self._places.values():
                self._tried(form, at - 0.5, math.inf, seed)

    @property
    def best(self) -> str | None:
        """The name of the best trial that passes; None where none does."""
        passing = {name: one.error for name, one in self.results.items() if one.passes}
        return min(passing, key=lambda name: passing[name], default=None)

    def _tried(self, form: str, place: float, least: float, seed: int) -> float:
        """The error with another gain; infinity where it does not pass, or is not below `least`, so that it does not count."""
        one = _times(self.candidates[form], _STEP**place) if place else self.candidates[form]
        outcome = self._real.of(one, seed)
        name = f"{form.partition(', gain ')[0]}, gain {own_gain(one)[1]:.4g}" if place else form
        if counts := outcome.error < least:
            self._places[name], self.candidates[name], self.results[name] = (form, place), one, outcome
        return outcome.error if counts and outcome.passes else math.inf


class Trials:
    """Runs of one problem, beside those of the controller alone."""

    def __init__(self, problem: Problem, bare: Controller, chatter: Mapping[str, float]) -> None:
        self._problem, self._bare, self._chatter, self._alone = problem, bare, chatter, dict[int, Run]()

    def of(self, one: Deformation, seed: int = 0, *, loud: bool = False) -> Trial:
        """Return what a run shows, where the gain is not refused; `loud`: whether steps of any size are calm."""
        if seed not in self._alone:
            self._alone[seed] = simulator(self._problem, self._bare, compiled=False).run(seed=seed)
        try:
            run = simulator(self._problem, self._bare.with_deformation(one), compiled=False).run(seed=seed)
        except FpirhcError:
            return Trial(math.inf, math.inf)
        plant, runs = self._problem.plant, (self._alone[seed], run)
        pair = errors_of(self._problem, runs, weighed(self._problem, self._bare))
        # Rms step of every command, the transient left out.
        before, own = (np.sqrt(np.mean(np.diff(r["command"][r.cycles // 10 :], axis=0) ** 2, axis=0)) for r in runs)
        lower, upper = self._problem.limits.input_bounds(plant)
        usual = np.maximum(_STEPS * before, _OF_RANGE * np.where(np.isfinite(upper - lower), upper - lower, 0.0))
        room = [self._chatter.get(name, max(one, 1e-300)) for name, one in zip(plant.inputs, usual, strict=True)]
        ratios = [pair.ratio(name) for name in pair.without]
        return Trial(math.sqrt(np.mean(np.square(ratios))), max(ratios), sound=loud or bool((own <= room).all()))


def _times(one: Deformation, factor: float) -> Deformation:
    return one.with_effective_gain(_rounded(factor * one.effective_gain()))


@dataclass(frozen=True)
class Trial:
    """A run on the plant."""

    error: float  # rms error over that of the controller alone, in the mean over the coordinates
    worst: float  # of any coordinate
    sound: bool = True  # whether commands keep the budget of chatter, and runs with a larger gain pass

    @property
    def passes(self) -> bool:
        """Whether it makes the error clearly less, and that of no coordinate more, and is sound."""
        return self.error <= _WORTH and self.worst <= _WORSE and self.sound


def _rounded(value: float) -> float:
    return float(f"{float(value):.3g}")


def _one(values: np.ndarray) -> float | tuple[float, ...]:
    rounded = tuple(map(_rounded, values))
    return rounded[0] if len(set(rounded)) == 1 else rounded


def estimated_problem(
    problem: Problem, gains: np.ndarray, dead: Sequence[float], lags: Sequence[float], drift: np.ndarray, noise: Mapping[str, float]
) -> Problem:  # fmt: skip
    """Return the problem whose reality has gains Lambda, a drift w by cycle that stays in the end, and noise of sensors."""
    own, period, (plant, signals) = problem.of_model, problem.period, _plant(problem.plant, gains)
    shortest = min((tau for tau in lags if tau > 0), default=math.inf)
    finer = own.integrator.finer(math.ceil(period / shortest)) if shortest < period else None
    duration, times = period * max(len(drift), min(own.cycles, _CYCLES)), period * np.arange(len(drift))
    courses = {s: Unknown(Samples(times, w)) for s, w in zip(signals, drift.T, strict=True)}
    start: Mapping[str, float] = own.start
    if not own.plant.equations.hidden:  # what is judged is what comes after the transient
        start = dict(zip(own.plant.state.elements, map(float, reference_states(own, 2)[:, 0]), strict=True))
    sizes = {n: size for n, size in noise.items() if size and n in own.sensing.measures(own.plant)}
    sensors = {**own.sensing.sensors, **{n: Sensor(noise=Noise(size)) for n, size in sizes.items()}}
    actuated = behind_actuators(plant, lags)
    added = [name for name in actuated.coordinates if name not in plant.coordinates]
    at_rest = [float(u) for u, lag in zip(own.inputs_before, lags, strict=True) if lag > 0]
    moving = Reality(actuated, integrator=finer, start=dict(zip(added, at_rest, strict=True)))
    late = DeadTime(inputs={name: c * period for name, c in zip(own.plant.inputs, dead, strict=True)})
    return replace(
        own, plant=problem.plant, start=start, reality=moving, dead_time=late, signals={**own.signals, **courses},
        disturbances={}, sensing=replace(own.sensing, sensors=sensors),
        duration=duration, measure_from=min(own.measure_from, _BEGUN * duration),
    )  # fmt: skip


def _plant(model: Plant, gains: np.ndarray) -> tuple[Plant, tuple[str, ...]]:
    """The plant without its lags, and the names of its drifts."""
    require(model.step is None, "an estimated plant in discrete time has no equations yet")
    direct = set(model.controlled_names) == set(model.coordinates)  # else what else the inputs move has to follow
    opaque = "the estimated plant of outputs of a model that is not affine in its inputs has no equations yet"
    require(direct or not model.equations.inverse_opaque, opaque)
    signals = tuple(f"drift_{name}" for name in model.controlled_names)
    known = {n: one if one.outside else replace(one, exact=one.approximate) for n, one in model.parameters.items()}

    def response(*arguments: Named) -> Mapping[str, Expression]:
        *derivatives, u, p = arguments
        x = ca.vertcat(*(derivatives[e.count("'")][e.rstrip("'")] for e in model.state.elements))
        inputs, parameters = (ca.vertcat(*(one[n] for n in names)) for one, names in ((u, model.inputs), (p, known)))
        answers = model.equations.controlled_response(x, inputs, parameters)
        wanted = ca.DM(gains) @ answers + ca.vertcat(*(p[name] for name in signals))
        if direct:
            return {name: wanted[i] for i, name in enumerate(model.controlled_names)}
        inputs = model.equations.inverse(x, wanted, parameters)
        own = Named(tuple(known), parameters, "parameter")
        return dict(model.response(*derivatives, Named(tuple(model.inputs), inputs, "input"), own))

    vars(response)["__signature__"] = inspect.signature(model.response)
    parameters = {**known, **{name: outside(0.0, "1") for name in signals}}
    return replace(model, parameters=parameters, response=response, inverse=None), signals
