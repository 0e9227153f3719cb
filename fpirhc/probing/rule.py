"""Which adaptation suits a plant as estimated: candidates run on it, and keep margins at the ends of what the record allows.

Gains are shares g of the deadbeat gain: 1 / the largest eigenvalue of Lambda, or the inverse of Lambda where responses are coupled.
A mirror that is right takes lateness for right and leaves it, so mirrors without dead time and lag are candidates too, and one with
three times the lag, which stands for everything slow. Of the safe settings within a tenth of the least error the calmest is bold.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import checked
from fpirhc.controllers.contract import without_deformation
from fpirhc.controllers.reference_states import reference_states
from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.leaky import default_pole
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.deformation.wrappers.delayed import Paired
from fpirhc.deformation.wrappers.filtered import Filtered
from fpirhc.errors import FpirhcError, NotSupported
from fpirhc.plant.chain import require_rates
from fpirhc.plant.parameter import Parameter, outside
from fpirhc.plant.plant import Plant
from fpirhc.probing.identification import End, Estimates
from fpirhc.sensing.base import response_names
from fpirhc.sensing.sensing import Sensing, Sensor
from fpirhc.simulation.linearise.asked_loop import AskedLoop
from fpirhc.simulation.linearise.linear_map import linear
from fpirhc.simulation.linearise.linearisation import Linearisation
from fpirhc.simulation.model_as_plant import behind_actuators
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.simulation.trials import errors_of, weighed
from fpirhc.symbolic.layout import Expression, Named
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.disturbance import Noise
from fpirhc.task.exogenous import Samples, Unknown
from fpirhc.task.problem import Problem
from fpirhc.task.reality import Reality

_BEGUN = 0.2  # share of a run from which errors count
_CYCLES = 300  # of a run, where the problem has as many and the record is shorter


def estimated_problem(
    problem: Problem,
    gains: np.ndarray,
    cycles: Sequence[float],
    lags: Sequence[float],
    drift: np.ndarray | None = None,
    noise: Sequence[float] = (),
) -> Problem:
    """Return the problem with the estimated plant as its reality.

    Args:
        gains: Lambda, shape (n, n).
        drift: w by cycle, shape (cycles, n), which ends with its last value; None: there is none.
        noise: rms of the measured response, by controlled coordinate; empty: there is none.
    """
    plant, signals = _plant(problem.plant, gains, drifts=drift is not None)
    own, period = problem.of_model, problem.period
    shortest = min((tau for tau in lags if tau > 0), default=math.inf)
    finer = own.integrator.finer(math.ceil(period / shortest)) if shortest < period else None
    duration, begin, courses = own.duration, own.measure_from, {}
    if drift is not None:
        duration, times = period * max(len(drift), min(own.cycles, _CYCLES)), period * np.arange(len(drift))
        begin = min(begin, _BEGUN * duration)
        courses = {s: Unknown(Samples(times, w)) for s, w in zip(signals, drift.T, strict=True)}
    actuated = behind_actuators(plant, lags)
    added = [name for name in actuated.coordinates if name not in plant.coordinates]
    at_rest = [float(u) for u, lag in zip(own.inputs_before, lags, strict=True) if lag > 0]
    return replace(
        own,
        plant=problem.plant,
        start=_start(own),
        reality=Reality(actuated, integrator=finer, start=dict(zip(added, at_rest, strict=True))),
        dead_time=DeadTime(inputs={name: c * period for name, c in zip(own.plant.inputs, cycles, strict=True)}),
        signals={**own.signals, **courses},
        disturbances={},
        sensing=_noisy(own, noise),
        duration=duration,
        measure_from=begin,
    )


def _start(own: Problem) -> Mapping[str, float]:
    """A start on the reference, where it gives the whole state: what is judged is what comes after the transient."""
    if not own.plant.equations.known_on_reference:
        return own.start
    return dict(zip(own.plant.state.elements, map(float, reference_states(own, 2)[:, 0]), strict=True))


def _noisy(own: Problem, noise: Sequence[float]) -> Sensing:
    """The sensing with the noise of the response, where the response itself is measured."""
    sensing, names = own.sensing, response_names(own.plant)
    if not (noise and sensing.estimator.shows_response and sensing.observer is None):
        return sensing
    noisy = {name: Sensor(noise=Noise(size)) for name, size in zip(names, noise, strict=True) if size}
    return replace(sensing, sensors={**sensing.sensors, **noisy})


def gain_name(row: int, column: int) -> str:
    """Return the name of the parameter lambda_ij of an estimated plant."""
    return f"lambda_{row + 1}{column + 1}"


def _plant(model: Plant, gains: np.ndarray, *, drifts: bool) -> tuple[Plant, tuple[str, ...]]:
    """The plant without its lags, and the names of its drifts."""
    without = "the estimated plant of a {} has no equations yet"
    require_rates(model, without.format("map"))
    direct = set(model.controlled_names) == set(model.coordinates)  # else what else the inputs move has to follow
    if model.equations.inverse_opaque and not direct:
        raise NotSupported(without.format("plant of outputs of a model that is not affine in its inputs,"))
    count = len(model.controlled_names)
    signals = tuple(f"drift_{name}" for name in model.controlled_names) if drifts else ()
    known = {n: one if one.outside else replace(one, exact=one.approximate) for n, one in model.parameters.items()}
    added = {gain_name(i, j): Parameter(float(g), float(g), "1") for (i, j), g in np.ndenumerate(gains)}
    courses = {name: outside(0.0, "1") for name in signals}

    def response(*arguments: Named) -> Mapping[str, Expression]:
        *derivatives, u, p = arguments
        x = ca.vertcat(*(derivatives[e.count("'")][e.rstrip("'")] for e in model.state.elements))
        inputs, parameters = (ca.vertcat(*(one[n] for n in names)) for one, names in ((u, model.inputs), (p, known)))
        answers = model.equations.controlled_response(x, inputs, parameters)
        matrix = ca.blockcat([[p[gain_name(i, j)] for j in range(count)] for i in range(count)])
        wanted = matrix @ answers + (ca.vertcat(*(p[name] for name in signals)) if signals else 0)
        if direct:
            return {name: wanted[i] for i, name in enumerate(model.controlled_names)}
        inputs = model.equations.inverse(x, wanted, parameters)
        own = Named(tuple(known), parameters, "parameter")
        return dict(model.response(*derivatives, Named(tuple(model.inputs), inputs, "input"), own))

    vars(response)["__signature__"] = inspect.signature(model.response)
    plant = replace(model, parameters={**known, **added, **courses}, response=response, inverse=None)
    return plant, signals


DARING = ("daring", "prompt", "lagging")
"""Candidates that keep their margins at the estimate alone, or begin with the least share: trials have to show them.

The second believes no lateness, the third a lag and no dead time. With the least share the second is offered whatever the estimate
says of it, and trials go on from there.
"""

SHARES = (0.05, 0.1, 0.16, 0.25, 0.4, 0.65, 1.0)
_RINGING = (4.0, 1.0)  # g / (1 - pole) of the filters
_FIRST, _LONG = 0.2, 0.2  # shares with which forms are compared, and of the candidate with a long lag
_FORMS = 2  # model-referenced ones that are searched in full, beside the plain one
_LARGEST_PRODUCT = 1.99
_STEPS, _OF_RANGE = 1.5, 0.02  # largest step of a command: times that of the controller alone, or of the input's range
_NEAR, _WORTH = 1.1, 0.95  # errors that count as equal, and one that is worth an adaptation
_FINE = 1.05  # ratio of two shares, between which no other is tried


@dataclass(frozen=True)
class Setting:
    """A candidate.

    Args:
        referenced: whether the form is model-referenced; else the plain one.
        share: g, of the deadbeat gain.
        pole: of the filter; 0: none.
        cycles: believed dead time of every input.
        lags: believed lag of every input.
        wrong: cycles by which the dead time may be wrong.
        weighted: whether the gain is a matrix, a share of the inverse of Lambda.
    """

    referenced: bool
    share: float
    pole: float
    cycles: tuple[float, ...]
    lags: tuple[float, ...]
    wrong: float
    weighted: bool = False

    def deformation(self, estimates: Estimates) -> Deformation:
        """Return the deformation, with gains rounded to three digits."""
        chosen: Deformation = Affine(gain=self.gain(estimates), weights=estimates.weights if self.weighted else None)
        largest = self._largest(estimates)
        if self.pole:
            chosen = Filtered(chosen, pole=_rounded(self.pole))
        cycles, lag = _one(self.cycles), _one(tuple(_rounded(tau) for tau in self.lags))
        late = max(self.cycles) > 0
        if not self.referenced:
            return Paired(chosen, cycles=cycles) if late else chosen
        leak = default_pole(min(max(1 / largest, 1.0), _LARGEST_PRODUCT), self.wrong) if late else None
        return ModelReferenced(chosen, cycles=cycles, lag=lag, pole=None if leak is None else _rounded(float(leak)))

    def gain(self, estimates: Estimates) -> float:
        """Return A_c = -2 a of the map, where a is the share of the inverse of the largest eigenvalue."""
        return _rounded(-2 * self.share / self._largest(estimates))

    def _largest(self, estimates: Estimates) -> float:
        return estimates.largest_weighted if self.weighted else estimates.largest

    @property
    def prompt(self) -> bool:
        """Whether it is model-referenced, and its mirror believes that the plant answers at once."""
        return self.referenced and not (any(self.cycles) or any(self.lags) or self.weighted)

    def with_share(self, share: float) -> Setting:
        """Return the same form with another share, whose filter rings alike."""
        return replace(self, share=share, pole=max(1 - share * (1 - self.pole) / self.share, 0.0) if self.pole else 0.0)

    @property
    def form(self) -> Setting:
        """What it shares with those that differ in their share alone."""
        return replace(self, share=0.0, pole=_rounded(self.share / (1 - self.pole)) if self.pole else 0.0)

    def is_larger(self, other: Setting) -> bool:
        """Whether it differs from the other one by a larger share alone."""
        return self.form == other.form and self.share > other.share

    @property
    def paths(self) -> tuple[str, str]:
        """Where gain and filter pole stand in a controller with this deformation."""
        wrapped = self.referenced or max(self.cycles) > 0
        return (
            ("deformation.map.map.gain", "deformation.map.pole")
            if wrapped
            else ("deformation.map.gain", "deformation.pole")
        )


@dataclass(frozen=True, eq=False)
class Predicted:
    """A setting on the estimated plant.

    Args:
        error: rms tracking error over that of the controller alone, in the mean over the coordinates.
        steps: rms step of the command over the largest that is allowed.
    """

    setting: Setting
    deformation: Deformation
    error: float
    steps: float


class Rule:
    """The choice for one problem and controller."""

    def __init__(
        self,
        problem: Problem,
        controller: Controller,
        estimates: Estimates,
        chatter: float | Mapping[str, float] | None,
    ) -> None:
        """Build the estimated plant and run the controller alone on it."""
        self.bare, self.estimates, self._names = (
            without_deformation(controller),
            estimates,
            weighed(problem, controller),
        )
        self._given = problem
        self._margins = Margins(problem, self.bare, estimates)
        self._simulators: dict[Setting, Simulator] = {}
        self._predictions: dict[Setting, Predicted] = {}
        noise = [one.noise for one in estimates.channels]
        middle = estimates.dead[1], estimates.lag[1]
        self.problem = estimated_problem(problem, estimates.gains, *middle, estimates.drift, noise)
        self._alone = simulator(self.problem, self.bare, compiled=False).run(seed=0)
        self._chatter = chatter
        self._room = self.allowed(self._alone)
        self.stable = self._alone.stop is None

    def shortlist(self) -> dict[str, Predicted]:
        """Return the candidates by name, cautious first; none where nothing safe makes the error clearly less."""
        forms = sorted((self._predicted(form) for form in self._forms()), key=lambda one: one.error)
        # A small gain delays the desired response in the plain form: it is searched whatever its error is there.
        mirrored, plain = ([one for one in forms if one.setting.referenced is kind] for kind in (True, False))
        searched = mirrored[:_FORMS] + plain[:1]
        if self.estimates.weights is not None:
            alike = [replace(one[0].setting, weighted=True) for one in (mirrored, plain) if one]
            searched += [self._predicted(form) for form in alike]
        settings = [self._predicted(s) for one in searched for s in _around(one.setting)]
        calm = sorted((one for one in settings if one.steps <= 1 and one.error < _WORTH), key=lambda one: one.error)
        safe: list[Predicted] = []
        for one in calm:
            if safe and one.error > _NEAR * safe[0].error:
                break
            if self._safe(one):
                safe.append(one)
        chosen = {
            "cautious": next(
                (
                    one
                    for one in _few_filters(calm)
                    if self._margins.safe(one.deformation, self._margins.far) and self._safe(one)
                ),
                None,
            ),
            "mirrored": self._first(filter(self._mirrors, calm)),
            "referenced": self._first(one for one in calm if one.setting.referenced),
            "plain": self._first(one for one in calm if not one.setting.referenced),
            "matrix": self._first(one for one in calm if one.setting.weighted),
            "long lag": self._long(),
            "bold": min(safe, key=lambda one: one.steps, default=None),
            DARING[0]: next(filter(self._daring, _few_filters(calm)), None),
            DARING[2]: next(filter(self._daring, _few_filters(filter(self._lags, calm))), None),
            DARING[1]: next(filter(self._daring, _few_filters(one for one in calm if one.setting.prompt)), self._least),
        }
        different: dict[str, Predicted] = {}
        for name, candidate in chosen.items():
            if candidate is not None and all(candidate.deformation != one.deformation for one in different.values()):
                different[name] = candidate
        return different

    @property
    def _least(self) -> Predicted | None:
        """Without lateness, with the least share, unless it is known to be too loud."""
        nothing = (0.0,) * len(self.estimates.channels)
        one = self._predicted(Setting(True, SHARES[0], 0.0, nothing, nothing, 0.0))
        return one if self._accepted(one) and not 1 < one.steps < math.inf else None

    def beside(self, one: Predicted, tried: Iterable[Predicted]) -> dict[float, Predicted]:
        """Return by share the next smaller and the next larger share of the same form, which trials have to show.

        They are those of the list. Where the next larger one is tried already, it is their geometric mean, down to a ratio of 1.05:
        an error falls with the share until the loop is lost, so the best one is near that limit.
        """
        known = {other.setting.share for other in tried if other.setting.form == one.setting.form}
        neighbours = [self._predicted(one.setting.with_share(share)) for share in _between(one.setting.share, known)]
        return {other.setting.share: other for other in neighbours if self._accepted(other)}

    def _daring(self, one: Predicted) -> bool:
        """Whether it keeps its margins at the estimate alone."""
        return self._accepted(one) and self._margins.safe(one.deformation, self._margins.middle)

    def _first(self, settings: Iterable[Predicted]) -> Predicted | None:
        """The first safe one."""
        return next(filter(self._safe, _few_filters(settings)), None)

    def _safe(self, one: Predicted) -> bool:
        return self._accepted(one) and self._margins.safe(one.deformation)

    def _accepted(self, one: Predicted) -> bool:
        """Whether the loop of the problem takes its gain, which it judges by the model."""
        try:
            checked(self._given, self.bare.with_deformation(one.deformation))
        except FpirhcError:
            return False
        return True

    def _mirrors(self, one: Predicted) -> bool:
        """Whether the model is late and lags as the plant at most does."""
        return one.setting.referenced and one.setting.lags == tuple(self.estimates.lag[2])

    def _lags(self, one: Predicted) -> bool:
        """Whether the model lags as the plant does, and believes no dead time."""
        setting = one.setting
        return setting.referenced and not any(setting.cycles) and setting.lags == tuple(self.estimates.lag[1])

    def _forms(self) -> Iterator[Setting]:
        """Forms, dead times and lags, with the share in which they are compared."""
        low, value, high = self.estimates.dead
        cycles = np.where(high > low, np.ceil((low + high) / 2), value)
        wrong = float(max((high - cycles).max(), (cycles - low).max(), 1.0))
        lags = [np.zeros(len(value)), self.estimates.lag[1], self.estimates.lag[2], self._long_lag]
        ways = {tuple(map(float, c)): wrong if c.any() else 0.0 for c in (cycles, np.zeros(len(value)))}
        for way, unsure in ways.items():
            for lag in sorted({tuple(map(float, tau)) for tau in lags}):
                yield Setting(True, _FIRST, 0.0, way, lag, unsure)
            yield Setting(False, _FIRST, 0.0, way, (0.0,) * len(value), unsure)

    @property
    def _long_lag(self) -> np.ndarray:
        """Three times the greatest lag, where there is one at all."""
        low, value, high = self.estimates.lag
        return np.where(low > 0.5 * self._given.period, 3 * high, value)

    def _long(self) -> Predicted | None:
        lag = tuple(map(float, self._long_lag))
        if not any(self.estimates.lag[0] > 0.5 * self._given.period):
            return None
        cycles = tuple(map(float, np.ceil(self.estimates.dead[[0, 2]].mean(axis=0))))
        one = self._predicted(Setting(True, _LONG, 0.0, cycles, lag, 1.0))
        return one if one.error < 1 and self._safe(one) else None

    def _predicted(self, setting: Setting) -> Predicted:
        if setting not in self._predictions:
            self._predictions[setting] = self._prediction(setting)
        return self._predictions[setting]

    def _prediction(self, setting: Setting) -> Predicted:
        deformation = setting.deformation(self.estimates)
        nothing = Predicted(setting, deformation, math.inf, math.inf)
        try:
            run = self._run(setting)
        except FpirhcError:  # a gain that a loop refuses
            return nothing
        if run.stop is not None:
            return nothing
        return Predicted(
            setting,
            deformation,
            mean_ratio(self.problem, self._alone, run, self._names),
            float((steps_of(run) / self._room).max()),
        )

    def _run(self, setting: Setting) -> Run:
        """The run of a candidate; those of one form share a loop."""
        form = replace(setting, share=_FIRST, pole=0.5)
        if form not in self._simulators:
            controller = self.bare.with_deformation(form.deformation(self.estimates))
            self._simulators[form] = simulator(self.problem, controller, compiled=False, live=form.paths)
        gain, pole = form.paths
        numbers = {gain: setting.gain(self.estimates), pole: _rounded(setting.pole)}
        return self._simulators[form].run(seed=0, settings=numbers)

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


def _around(form: Setting) -> Iterator[Setting]:
    """The form with every share and filter."""
    for share in SHARES:
        for pole in {0.0, *(max(1 - share / ringing, 0.0) for ringing in _RINGING)}:
            yield replace(form, share=share, pole=pole)


def _few_filters(settings: Iterable[Predicted]) -> Iterator[Predicted]:
    """The best of those that differ in their filter alone, and the one without a filter; they are in the order of their errors."""
    passed = set()
    for one in settings:
        form = replace(one.setting, pole=0.0)
        if form not in passed or form == one.setting:
            passed.add(form)
            yield one


def _between(share: float, known: Iterable[float]) -> Iterator[float]:
    """The shares that are next to this one and not known."""
    smaller = max((other for other in {*SHARES, *known} if other < share), default=share)
    larger = min((other for other in {*SHARES, *known} if other > share), default=share)
    if larger in known and larger / share > _FINE:
        larger = float(f"{math.sqrt(larger * share):.2g}")
    yield from {smaller, larger} - {share, *known}


def steps_of(run: Run) -> np.ndarray:
    """Return the rms step of every command, the transient left out."""
    command = np.asarray(run["command"])
    return np.sqrt(np.mean(np.diff(command[len(command) // 10 :], axis=0) ** 2, axis=0))


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


def _one(values: tuple[float, ...]) -> float | tuple[float, ...]:
    return values[0] if len(set(values)) == 1 else values


_STABLE = 1 - 1e-7
_FEW = 20  # cycles of the run along which a loop is linearised, beyond those that it takes to warm up


@dataclass(frozen=True)
class Corner:
    """A dead time and a lag of every input."""

    cycles: tuple[float, ...]
    lags: tuple[float, ...]


@dataclass(frozen=True)
class Case:
    """A corner, and the gains of the plant there: those of an end of the likelihood, or the draw about them, times a factor."""

    corner: Corner
    end: End
    factor: float = 1.0
    drawn: bool = False

    @property
    def gains(self) -> np.ndarray:
        """Lambda."""
        return self.factor * (self.end.drawn if self.drawn else self.end.gains)


Cases: TypeAlias = tuple[Case, ...]


class Margins:
    """Those of one controller with any deformation."""

    def __init__(self, problem: Problem, bare: Controller, estimates: Estimates) -> None:
        """Take the problem, the controller alone, and what is known of the plant."""
        self._problem, self._bare, self._estimates = problem, bare, estimates
        self._problems: dict[Corner, Problem] = {}
        self._loops: dict[tuple[Corner, Deformation | None], _Loop] = {}
        self._judged: dict[tuple[Deformation, Cases], bool] = {}

    def safe(self, deformation: Deformation, within: Cases | None = None) -> bool:
        """Return whether the whole loop is stable in every case in which the controller alone is.

        Args:
            deformation: of the controller.
            within: the cases: `near` (the default), `far`, or `middle`.
        """
        cases = self.near if within is None else within
        if (deformation, cases) not in self._judged:
            self._judged[deformation, cases] = all(
                self._stable(deformation, case) for case in cases if self._stable(None, case)
            )
        return self._judged[deformation, cases]

    @cached_property
    def middle(self) -> Cases:
        """A gain margin of 1.4 to both sides of the estimate alone, and a command that is a cycle later."""
        best, (there, later) = self._estimates.ends[0], self._estimated()
        return Case(there, best, 1.4), Case(there, best, 0.6), Case(later, best)

    @cached_property
    def near(self) -> Cases:
        """A gain margin of 1.4 to both sides at every end of the likelihood, and for a draw there; and a command a cycle later.

        An end has its own gains: a longer lag with a larger gain says much the same of a record as a shorter one with a smaller.
        """
        ends = {Corner(one.cycles, one.lags): one for one in reversed(self._estimates.ends)}
        late = Corner(tuple(self._estimates.dead[2] + 1), tuple(self._estimates.lag[1]))
        cases = ((1.4, False), (0.6, False), (1.4, True))
        return Case(late, self._estimates.ends[0]), *(Case(c, one, *case) for case in cases for c, one in ends.items())

    @cached_property
    def far(self) -> Cases:
        """Twice the gain, and a plant slower by half, because a lag is only a picture of what is slow; a command a cycle later."""
        dead, slow = self._estimates.dead[2], 1.5 * np.maximum(self._estimates.lag[2], 0.25 * self._problem.period)
        there, later = (Corner(tuple(dead + more), tuple(slow)) for more in (0, 1))
        cases = ((later, 1.4), (there, 2.0))
        return tuple(Case(c, self._estimates.wide, factor, drawn) for c, factor in cases for drawn in (False, True))

    def _estimated(self) -> tuple[Corner, Corner]:
        """The estimate, and the same a cycle later."""
        dead, lag = self._estimates.dead[1], tuple(self._estimates.lag[1])
        return Corner(tuple(dead), lag), Corner(tuple(dead + 1), lag)

    def _stable(self, deformation: Deformation | None, case: Case) -> bool:
        gain = None if deformation is None else deformation.effective_gain()
        return self._loop(case.corner, deformation).radius(gain, case.gains) < _STABLE

    def _loop(self, corner: Corner, deformation: Deformation | None) -> _Loop:
        """The loop at a corner, which deformations share that differ in their gain alone; None: of the controller alone."""
        if corner not in self._problems:
            gains = self._estimates.gains
            self._problems[corner] = estimated_problem(self._problem, gains, corner.cycles, corner.lags)
        form = None if deformation is None else linear(deformation.with_effective_gain(1.0))
        if (corner, form) not in self._loops:
            controller = self._bare if form is None else self._bare.with_deformation(form)
            self._loops[corner, form] = _Loop(self._problems[corner], controller, self._estimates.gains.shape)
        return self._loops[corner, form]


class _Loop:
    """A loop on the estimated plant, linearised for any gains of plant and map."""

    def __init__(self, problem: Problem, controller: Controller, shape: tuple[int, ...]) -> None:
        self._radii: dict[tuple[float | None, bytes], float] = {}
        self._quiet: dict[float | None, np.ndarray] = {}
        self._linear: Linearisation | None = None
        try:
            self._linear = Linearisation(AskedLoop(problem, controller))
        except FpirhcError:  # it cannot be composed
            return
        first, names = self._linear.asked.loop.memory.slice("_exact").start, list(problem.real_plant.parameters)
        self._places = [first + names.index(gain_name(i, j)) for i, j in np.ndindex(shape)]

    def radius(self, gain: float | None, gains: np.ndarray) -> float:
        """Return the radius for a gain of the map and the gains of the plant; infinite where the loop does not run."""
        if self._linear is None:
            return math.inf
        key = gain, gains.tobytes()
        if key not in self._radii:
            try:
                changed = self._memory(self._linear.asked, gain).copy()
                changed[self._places] = gains.ravel()
                self._radii[key] = self._linear.at(changed).radius
            except FpirhcError:
                self._radii[key] = math.inf
        return self._radii[key]

    def _memory(self, loop: AskedLoop, gain: float | None) -> np.ndarray:
        """The quietest memory of a run with a gain."""
        if gain not in self._quiet:
            self._quiet[gain] = loop.quietest(loop.run(loop.start(gain=gain), 4 * loop.warm + _FEW))
        return self._quiet[gain]
