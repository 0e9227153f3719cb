"""The plant as estimated, and which adaptation suits it: gains that its review admits, then trials on the plant itself.

The estimated plant is the model behind gains, dead times, lags and the recorded drift, as the reality of the problem. A mirror that
is right takes lateness for right and leaves it, so mirrors without dead time and lag are candidates too.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.built import any_gain
from fpirhc.controllers.reference_states import reference_states
from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.leaky import default_pole
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.deformation.wrappers.delayed import Paired
from fpirhc.deformation.wrappers.filtered import Filtered
from fpirhc.errors import FpirhcError, require
from fpirhc.plant.chain import require_rates, response_names
from fpirhc.plant.parameter import outside
from fpirhc.plant.plant import Plant
from fpirhc.probing.identification import Estimates
from fpirhc.review.experiments import Bench, Case
from fpirhc.review.questions import Verdict, gain_by_run
from fpirhc.sensing.sensing import Sensor
from fpirhc.simulation.model_as_plant import behind_actuators, shortened
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulator
from fpirhc.simulation.trials import errors_of, weighed
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.symbolic.layout import Expression, Named
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.disturbance import Noise
from fpirhc.task.exogenous import Samples, Unknown
from fpirhc.task.problem import Problem
from fpirhc.task.reality import Reality

_ASKED = 0.5, 0.1  # shares of the deadbeat gain that a review is asked about; it tries a half to four times as much
_POLES = (0.0, 0.5, 0.8)  # of the filter
_STEPS, _OF_RANGE = 1.5, 0.02  # largest step of a command: times that of the controller alone, or of the input's range
_WORTH, _WORSE = 0.95, 1.03  # error that is worth an adaptation; largest one of any coordinate
_LONGEST = 2000  # cycles of a trial
_STEP, _CLEARLY = 1.6, 0.97  # ratio of the gains of two trials; of their errors, from which the larger one counts
MARGIN, _LARGER = 1.4, 1.5  # times its gain that what is kept has to bear, and the ratio of the errors then
_SEEDS, _BEGUN = 3, 0.2  # of these runs; share of a run from which errors count
_CYCLES = 300  # of a run, where the problem has as many and the record is shorter


def forms(estimates: Estimates, share: float, pole: float) -> dict[str, Deformation]:
    """Return the forms by name, with a share of the deadbeat gain: 1 / the largest eigenvalue of Lambda, or its inverse."""
    low, value, high = estimates.dead
    likely = np.where(high > low, np.ceil((low + high) / 2), value)
    late, cycles, lag = bool(likely.any()), _one(likely), _one(estimates.lag[1])
    wrong = float(max((high - likely).max(), (likely - low).max(), 1.0))
    leak = default_pole(min(max(1 / estimates.largest, 1.0), 1.99), wrong) if late else None
    one = _map(share / estimates.largest, pole)
    found: dict[str, Deformation] = {
        "referenced": ModelReferenced(one, cycles=cycles, lag=lag, pole=None if leak is None else _rounded(leak)),
        "prompt": ModelReferenced(one, cycles=0.0, lag=0.0),
        "lagging": ModelReferenced(one, cycles=0.0, lag=lag),
        "plain": Paired(one, cycles=cycles) if late else one,
    }
    if estimates.weights is not None:
        weighted = _map(share / estimates.largest_weighted, pole, estimates.weights)
        found["matrix"] = ModelReferenced(weighted, cycles=0.0, lag=0.0)
    return {name: one for k, (name, one) in enumerate(found.items()) if one not in list(found.values())[:k]}


def _map(gain: float, pole: float, weights: tuple[tuple[float, ...], ...] | None = None) -> Deformation:
    one = Affine(gain=_rounded(-2 * gain), weights=weights)
    return Filtered(one, pole=pole) if pole else one


class Choice:
    """The choice for one problem and controller."""

    def __init__(self, problem: Problem, bare: Controller, estimates: Estimates, chatter: Mapping[str, float]) -> None:
        """Build the plants that the record allows, a cycle later, and run the controller alone on the estimate."""
        self._given, self._bare, self._estimates = problem, bare, estimates
        self._names, self._chatter = weighed(problem, bare), chatter
        middle, noise = (estimates.dead[1], estimates.lag[1]), [one.noise for one in estimates.channels]
        self.problem = estimated_problem(problem, estimates.gains, *middle, estimates.drift, noise)
        self._alone = _run(self.problem, bare)
        ends = {(one.cycles, one.lags): one for one in estimates.ends}.values()
        plants = [estimated_problem(problem, e.gains, [c + 1 for c in e.cycles], e.lags) for e in ends]
        self._plants = [(plant, dict[object, Bench]()) for plant in plants]

    def shortlist(self) -> dict[str, Deformation]:
        """Return what makes the error on the plant as estimated clearly less, by name of its form, the best first."""
        with compiled_plans(), any_gain():
            found = {name: one for name in forms(self._estimates, 1.0, 0.0) if (one := self._best(name))}
        return {name: found[name][1] for name in sorted(found, key=lambda name: found[name][0])}

    def _best(self, name: str) -> tuple[float, Deformation] | None:
        """Error and deformation of a form, with the best of the filters whose commands are calm; None where none is worth it."""
        found = []
        for pole in _POLES:
            asked = (forms(self._estimates, share, pole)[name] for share in _ASKED)
            one = next((_times(one, times) for one in asked if (times := self._admitted(one))), None)
            if one is not None:
                run = _run(self.problem, self._bare.with_deformation(one))
                found.append((self.compared(self.problem, self._alone, run), one))
        return min(((trial.error, one) for trial, one in found if trial.passes), key=lambda pair: pair[0], default=None)

    def _admitted(self, one: Deformation) -> float:
        """Half of the largest gain that comes back on every plant, as a multiple; 0 where there is none."""
        admitted = math.inf
        for plant, known in self._plants:
            try:
                bench = Bench(plant, self._bare.with_deformation(one))
                case = Case(bench, known=known)
                if case.plain.back.left > 1:  # the controller alone does not come back either
                    continue
                fact = gain_by_run(case)
            except FpirhcError:  # it cannot be composed
                return 0.0
            best = max(fact.numbers.get("recommended_times", float(fact.verdict == Verdict.CAUTION)), 0.0)  # it works
            admitted = min(admitted, best if fact.verdict == Verdict.YES else best / 2)
        return admitted if math.isfinite(admitted) else 0.0

    def compared(self, problem: Problem, alone: Run, run: Run, *, loud: bool = False) -> Trial:
        """Return what a run shows beside that of the controller alone; `loud`: whether steps of any size are calm."""
        pair, sent = errors_of(problem, (alone, run), self._names), (run["command"], alone["command"])
        # Rms step of every command, the transient left out.
        own, before = (np.sqrt(np.mean(np.diff(c[len(c) // 10 :], axis=0) ** 2, axis=0)) for c in sent)
        plant = self._given.plant
        lower, upper = self._given.limits.input_bounds(plant)
        width = np.where(np.isfinite(upper - lower), upper - lower, 0.0)
        usual = np.maximum(_STEPS * before, _OF_RANGE * width)
        room = [self._chatter.get(name, max(one, 1e-300)) for name, one in zip(plant.inputs, usual, strict=True)]
        ratios = [pair.ratio(name) for name in pair.without]
        return Trial(math.sqrt(np.mean(np.square(ratios))), max(ratios), sound=loud or bool((own <= room).all()))

    def tried(self, shortlist: dict[str, Deformation], notes: list[str], seed: int) -> dict[str, Trial]:
        """Return trials of the shortlist and of other gains of the best one, which has to bear 1.4 times its gain."""
        task, alone, results = shortened(self._given, _LONGEST), dict[int, Run](), dict[str, Trial]()
        places = {name: (name, 0) for name in shortlist}  # form, and by how many steps its gain is larger

        def trial(one: Deformation, seed: int, *, loud: bool = False) -> Trial | str:
            if seed not in alone:
                alone[seed] = _run(task, self._bare, seed)
            try:
                return self.compared(task, alone[seed], _run(task, self._bare.with_deformation(one), seed), loud=loud)
            except FpirhcError as error:
                return str(error)

        waiting, needed = list(shortlist), math.inf
        while True:
            outcomes = {name: trial(shortlist[name], seed) for name in waiting}
            notes += [f"{name} is not tried: {one}" for name, one in outcomes.items() if isinstance(one, str)]
            results |= {n: one for n, one in outcomes.items() if isinstance(one, Trial) and one.error <= needed}
            name = best(results)
            if name is None:
                return results
            form, place = places[name]
            beside = next((k for k in (place + 1, place - 1) if (form, k) not in places.values()), None)
            if beside is not None:
                needed = _CLEARLY * results[name].error if beside > place else math.inf
                waiting = [f"{form}, {_STEP**beside:.3g} times its gain"]
                places[waiting[0]] = form, beside
                shortlist[waiting[0]] = _times(shortlist[form], _STEP**beside)
                continue
            more = [trial(_times(shortlist[name], MARGIN), other, loud=True) for other in range(seed, seed + _SEEDS)]
            if all(isinstance(m, Trial) and m.passes and m.error <= _LARGER * results[name].error for m in more):
                return results
            notes.append(f"{name} is not kept: on the plant it does not bear {MARGIN:g} times its gain")
            lost = [n for n in results if places[n][0] == form and places[n][1] >= place]
            results, waiting = results | {n: replace(results[n], sound=False) for n in lost}, []


def _times(one: Deformation, factor: float) -> Deformation:
    return one.with_effective_gain(_rounded(factor * one.effective_gain()))


def _run(problem: Problem, controller: Controller, seed: int = 0) -> Run:
    return simulator(problem, controller, compiled=False).run(seed=seed)


@dataclass(frozen=True)
class Trial:
    """A run on the plant."""

    error: float  # rms error over that of the controller alone, in the mean over the coordinates
    worst: float  # of any coordinate
    sound: bool = (
        True  # whether commands keep the budget of chatter, and runs with a larger gain pass where there are some
    )

    @property
    def passes(self) -> bool:
        """Whether it makes the error clearly less, and that of no coordinate more, and is sound."""
        return self.error <= _WORTH and self.worst <= _WORSE and self.sound


def best(trials: Mapping[str, Trial]) -> str | None:
    """Return the name of the best trial that passes; None where none does."""
    return min((name for name, one in trials.items() if one.passes), key=lambda name: trials[name].error, default=None)


def _rounded(value: float) -> float:
    return float(f"{float(value):.3g}")


def _one(values: np.ndarray) -> float | tuple[float, ...]:
    rounded = tuple(map(_rounded, values))
    return rounded[0] if len(set(rounded)) == 1 else rounded


def estimated_problem(
    problem: Problem, gains: np.ndarray, cycles: Sequence[float], lags: Sequence[float],
    drift: np.ndarray | None = None, noise: Sequence[float] = (),
) -> Problem:  # fmt: skip
    """Return the problem whose reality has gains Lambda, a drift w by cycle that stays in the end, and noise of the response."""
    plant, signals = _plant(problem.plant, gains, drifts=drift is not None)
    own, period = problem.of_model, problem.period
    shortest = min((tau for tau in lags if tau > 0), default=math.inf)
    finer = own.integrator.finer(math.ceil(period / shortest)) if shortest < period else None
    duration, begin, courses = own.duration, own.measure_from, {}
    if drift is not None:
        duration, times = period * max(len(drift), min(own.cycles, _CYCLES)), period * np.arange(len(drift))
        begin = min(begin, _BEGUN * duration)
        courses = {s: Unknown(Samples(times, w)) for s, w in zip(signals, drift.T, strict=True)}
    start: Mapping[str, float] = own.start
    if not own.plant.equations.hidden:  # what is judged is what comes after the transient
        start = dict(zip(own.plant.state.elements, map(float, reference_states(own, 2)[:, 0]), strict=True))
    sensing = own.sensing
    if noise and sensing.estimator.measures_all and sensing.observer is None:  # the response itself is measured
        sizes = zip(response_names(own.plant), noise, strict=True)
        noisy = {name: Sensor(noise=Noise(size)) for name, size in sizes if size}
        sensing = replace(sensing, sensors={**sensing.sensors, **noisy})
    actuated = behind_actuators(plant, lags)
    added = [name for name in actuated.coordinates if name not in plant.coordinates]
    at_rest = [float(u) for u, lag in zip(own.inputs_before, lags, strict=True) if lag > 0]
    return replace(
        own,
        plant=problem.plant,
        start=start,
        reality=Reality(actuated, integrator=finer, start=dict(zip(added, at_rest, strict=True))),
        dead_time=DeadTime(inputs={name: c * period for name, c in zip(own.plant.inputs, cycles, strict=True)}),
        signals={**own.signals, **courses},
        disturbances={},
        sensing=sensing,
        duration=duration,
        measure_from=begin,
    )


def _plant(model: Plant, gains: np.ndarray, *, drifts: bool) -> tuple[Plant, tuple[str, ...]]:
    """The plant without its lags, and the names of its drifts."""
    without = "the estimated plant of a {} has no equations yet"
    require_rates(model, without.format("map"))
    direct = set(model.controlled_names) == set(model.coordinates)  # else what else the inputs move has to follow
    require(
        direct or not model.equations.inverse_opaque,
        without.format("plant of outputs of a model that is not affine in its inputs,"),
    )
    signals = tuple(f"drift_{name}" for name in model.controlled_names) if drifts else ()
    known = {n: one if one.outside else replace(one, exact=one.approximate) for n, one in model.parameters.items()}
    courses = {name: outside(0.0, "1") for name in signals}

    def response(*arguments: Named) -> Mapping[str, Expression]:
        *derivatives, u, p = arguments
        x = ca.vertcat(*(derivatives[e.count("'")][e.rstrip("'")] for e in model.state.elements))
        inputs, parameters = (ca.vertcat(*(one[n] for n in names)) for one, names in ((u, model.inputs), (p, known)))
        answers = model.equations.controlled_response(x, inputs, parameters)
        wanted = ca.DM(gains) @ answers + (ca.vertcat(*(p[name] for name in signals)) if signals else 0)
        if direct:
            return {name: wanted[i] for i, name in enumerate(model.controlled_names)}
        inputs = model.equations.inverse(x, wanted, parameters)
        own = Named(tuple(known), parameters, "parameter")
        return dict(model.response(*derivatives, Named(tuple(model.inputs), inputs, "input"), own))

    vars(response)["__signature__"] = inspect.signature(model.response)
    plant = replace(model, parameters={**known, **courses}, response=response, inverse=None)
    return plant, signals
