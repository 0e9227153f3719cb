"""Which adaptation suits a plant as estimated: candidates are run on it, and keep their margins at the corners of all intervals.

Gains are shares g of the deadbeat gain: 1 / the largest eigenvalue of Lambda, or the inverse of Lambda where responses are coupled.
A mirror that is right takes lateness for right and leaves it, so mirrors without dead time and lag are candidates too, and one with
three times the lag, which stands for everything slow. Of the safe settings within a tenth of the least error the calmest is bold.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.leaky import default_pole
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.deformation.wrappers.delayed import Paired
from fpirhc.deformation.wrappers.filtered import Filtered
from fpirhc.errors import FpirhcError
from fpirhc.probing.estimated_plant import estimated_problem, gain_name
from fpirhc.probing.estimates import Estimates
from fpirhc.simulation.error_pair import errors_of
from fpirhc.simulation.linearise.asked_loop import AskedLoop
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.simulation.trials import weighed
from fpirhc.task.problem import Problem

SHARES = (0.1, 0.16, 0.25, 0.4, 0.65, 1.0)
_RINGING = (4.0, 1.0)  # g / (1 - pole) of the filters
_FIRST, _LONG = 0.2, 0.2  # shares with which forms are compared, and of the candidate with a long lag
_FORMS = 2  # model-referenced ones that are searched in full, beside the plain one
_LARGEST_PRODUCT = 1.99
_STEPS, _OF_RANGE = 1.5, 0.02  # largest step of a command: times that of the controller alone, or of the input's range
_NEAR, _WORTH = 1.1, 0.95  # errors that count as equal, and one that is worth an adaptation


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
        """Build the estimated plant and run the controller alone on it.

        Raises:
            FpirhcError: a plant without equations.
        """
        self.bare, self.estimates, self._names = (
            without_deformation(controller),
            estimates,
            weighed(problem, controller),
        )
        self._given = problem
        self._margins = Margins(problem, self.bare, estimates)
        self._simulators: dict[Setting, Simulator] = {}
        noise = [one.noise for one in estimates.channels]
        middle = estimates.dead[1], estimates.lag[1]
        self.problem = estimated_problem(problem, estimates.gains, *middle, estimates.drift, noise)
        self._alone = simulator(self.problem, self.bare, compiled=False).run(seed=0)
        self._room = self._allowed(chatter)
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
                    for one in _one_filter_each(calm)
                    if self._margins.safe(one.deformation, rough=True) and self._safe(one)
                ),
                None,
            ),
            "mirrored": self._first(filter(self._mirrors, calm)),
            "referenced": self._first(one for one in calm if one.setting.referenced),
            "plain": self._first(one for one in calm if not one.setting.referenced),
            "matrix": self._first(one for one in calm if one.setting.weighted),
            "long lag": self._long(),
            "bold": min(safe, key=lambda one: one.steps, default=None),
        }
        different: dict[str, Predicted] = {}
        for name, candidate in chosen.items():
            if candidate is not None and all(candidate.deformation != one.deformation for one in different.values()):
                different[name] = candidate
        return different

    def _first(self, settings: Iterable[Predicted]) -> Predicted | None:
        """The first safe one."""
        return next(filter(self._safe, _one_filter_each(settings)), None)

    def _safe(self, one: Predicted) -> bool:
        return self._margins.safe(one.deformation)

    def _mirrors(self, one: Predicted) -> bool:
        """Whether the model is late and lags as the plant at most does."""
        return one.setting.referenced and one.setting.lags == tuple(self.estimates.lag[2])

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
        return one if self._safe(one) else None

    def _predicted(self, setting: Setting) -> Predicted:
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
            float((_steps(run) / self._room).max()),
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

    def _allowed(self, chatter: float | Mapping[str, float] | None) -> np.ndarray:
        """Largest rms step of every input."""
        plant = self._given.plant
        lower, upper = self._given.limits.input_bounds(plant)
        width = np.where(np.isfinite(upper - lower), upper - lower, 0.0)
        usual = np.maximum(_STEPS * _steps(self._alone), _OF_RANGE * width)
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


def _one_filter_each(settings: Iterable[Predicted]) -> Iterator[Predicted]:
    """The first of those that differ in their filter alone: the best one, where they are in the order of their errors."""
    passed = set()
    for one in settings:
        form = replace(one.setting, pole=0.0)
        if form not in passed:
            passed.add(form)
            yield one


def _steps(run: Run) -> np.ndarray:
    """Rms step of every command, the transient left out."""
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


Case: TypeAlias = tuple[
    Corner, float, int
]  # a corner, a factor of the gains, and the number of a draw; 0: the estimate


class Margins:
    """Those of one controller with any deformation."""

    def __init__(self, problem: Problem, bare: Controller, estimates: Estimates) -> None:
        """Take the problem, the controller alone, and what is known of the plant."""
        self._problem, self._bare, self._estimates = problem, bare, estimates
        self._problems: dict[Corner, Problem] = {}
        self._loops: dict[tuple[Corner, Deformation | None], _Loop] = {}
        self._judged: dict[tuple[Deformation, bool], bool] = {}

    def safe(self, deformation: Deformation, *, rough: bool = False) -> bool:
        """Return whether the whole loop is stable in every case in which the controller alone is.

        Args:
            deformation: of the controller.
            rough: whether twice the gain and a slower plant are asked; else the gain margin of a review.
        """
        if (deformation, rough) not in self._judged:
            cases = self._far if rough else self._near
            self._judged[deformation, rough] = all(
                self._stable(deformation, case) for case in cases if self._stable(None, case)
            )
        return self._judged[deformation, rough]

    @cached_property
    def _near(self) -> tuple[Case, ...]:
        """A gain margin of 1.4 to both sides of the estimate and of a draw, and a command that is a cycle later."""
        dead, lag = self._estimates.dead, self._estimates.lag
        corners = dict.fromkeys(Corner(tuple(dead[i]), tuple(lag[j])) for i in (2, 0) for j in (0, 2))
        late = (Corner(tuple(dead[2] + 1), tuple(lag[1])), 1.0, 0)
        return late, *((corner, *case) for case in ((1.4, 0), (0.6, 0), (1.4, 1)) for corner in corners)

    @cached_property
    def _far(self) -> tuple[Case, ...]:
        """A lag is only a picture of what is slow: half as long again, and a command that is a cycle later."""
        dead, slow = self._estimates.dead[2], 1.5 * np.maximum(self._estimates.lag[2], 0.25 * self._problem.period)
        later = Corner(tuple(dead + 1), tuple(slow))
        return (later, 1.4, 0), (later, 1.4, 1), *((Corner(tuple(dead), tuple(slow)), 2.0, k) for k in (0, 1))

    def _stable(self, deformation: Deformation | None, case: Case) -> bool:
        corner, factor, draw = case
        return self._loop(corner, deformation).radius(factor, draw) < _STABLE

    def _loop(self, corner: Corner, deformation: Deformation | None) -> _Loop:
        """The loop at a corner; None: of the controller alone."""
        if corner not in self._problems:
            gains = self._estimates.gains
            self._problems[corner] = estimated_problem(self._problem, gains, corner.cycles, corner.lags)
        if (corner, deformation) not in self._loops:
            controller = self._bare if deformation is None else self._bare.with_deformation(deformation)
            self._loops[corner, deformation] = _Loop(self._problems[corner], controller, self._estimates)
        return self._loops[corner, deformation]


class _Loop:
    """A loop on the estimated plant, linearised for any gains."""

    def __init__(self, problem: Problem, controller: Controller, estimates: Estimates) -> None:
        self._matrices = (estimates.gains, *estimates.draws)
        self._radii: dict[tuple[float, int], float] = {}
        self._memory: np.ndarray | None = None
        try:
            self._loop = AskedLoop(problem, controller)
            self._memory = self._loop.quietest(self._loop.run(self._loop.start(), 4 * self._loop.warm + _FEW))
        except FpirhcError:  # it does not run
            return
        first, names = self._loop.loop.memory.slice("_exact").start, list(problem.real_plant.parameters)
        self._places = [first + names.index(gain_name(i, j)) for i, j in np.ndindex(estimates.gains.shape)]

    def radius(self, factor: float, draw: int) -> float:
        """Return the radius for a factor of the gains; infinite where the loop does not run."""
        if self._memory is None:
            return math.inf
        if (factor, draw) not in self._radii:
            changed = self._memory.copy()
            changed[self._places] = factor * self._matrices[draw].ravel()
            try:
                self._radii[factor, draw] = self._loop.at(changed).radius
            except FpirhcError:
                self._radii[factor, draw] = math.inf
        return self._radii[factor, draw]
