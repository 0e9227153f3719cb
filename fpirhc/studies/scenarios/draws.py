"""Scenarios, random or named: what is the same for every controller of a comparison.

Random scenario k of a seed is always the same: its numbers come from a stream of its own, `SeedSequence(seed, spawn_key=(use, k))`,
whatever the number of scenarios, of processes and of controllers, and in whatever order they run. Dead times are those of the
problem, or shorter or longer by whole cycles: another length of a queue is another loop.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from fpirhc.controllers.contract import Controller, resolved
from fpirhc.plant.plant import Parametric, drawn, exact_ranges
from fpirhc.studies.scenarios.dead_times import DeadTimes
from fpirhc.task.cases import START, Cases
from fpirhc.task.problem import Problem

_REGISTER = 8  # numbers in one, at most
COMPARING, TUNING, SEARCHING = range(3)  # uses: a controller is never compared on the scenarios on which it was tuned


@dataclass(frozen=True, eq=False)
class Draw:
    """What is drawn for one scenario.

    Args:
        seed: of the disturbances' noise.
        exact: exact parameters of the plant, shape (np,).
        mismatch: distance of the model from them, see `mismatch_of`.
        lateness: -1, 0 or 1: dead times are shorter by the whole percentage, as in the problem, or longer by it.
    """

    seed: int
    exact: np.ndarray
    mismatch: float
    lateness: int = 0


def draw(
    plant: Parametric, *, seed: int, use: int, number: int, percent: float, model: Parametric | None = None
) -> Draw:
    """Return what is drawn; its exact parameters lie in `exact_ranges(plant, percent)`.

    Args:
        percent: range of the exact parameters, percent.
        model: the controllers' model, where it is another plant. The mismatch is then that of the parameters which both have.
    """
    parameters, noise, late = np.random.SeedSequence(seed, spawn_key=(use, number)).spawn(3)
    shares = np.random.default_rng(parameters).random(len(plant.parameters))
    values = [drawn(p, percent, float(s)) for p, s in zip(plant.parameters.values(), shares, strict=True)]
    exact = np.array(values, dtype=float)
    lateness = int(np.random.default_rng(late).integers(-1, 2))
    return Draw(int(noise.generate_state(1)[0]), exact, _mismatch(model or plant, plant, exact), lateness)


def draws_differ(problem: Problem, percent: float) -> bool:
    """Return whether anything is drawn for scenarios of a comparison: a parameter whose range has a width, or a dead time."""
    ranges = exact_ranges(problem.moved, percent).values()
    return any(high > low for low, high in ranges) or DeadTimes(problem, percent).drawn


def _mismatch(model: Parametric, plant: Parametric, exact: np.ndarray) -> float:
    """The mismatch in the parameters that model and plant share."""
    known = {name: parameter.approximate for name, parameter in model.parameters.items()}
    shared = [k for k, name in enumerate(plant.parameters) if name in known]
    assumed = np.array([known[name] for name in plant.parameters if name in known])
    return mismatch_of(assumed, exact[shared])


def mismatch_of(approximate: np.ndarray, exact: np.ndarray) -> float:
    """Return the rms over the parameters of |approximate - exact| / max(|approximate|, |exact|), as a share."""
    size = np.maximum(np.abs(approximate), np.abs(exact))
    shares = np.abs(approximate - exact) / np.where(size > 0, size, 1.0)
    return float(np.sqrt(np.mean(shares**2))) if shares.size else 0.0


@dataclass(frozen=True, eq=False)
class Scenario:
    """What every controller meets alike in one scenario.

    Args:
        name: of the scenario.
        group: of the scenario; '' where there are none.
        seed: of the noise.
        mismatch: distance of the model from the exact parameters, see `mismatch_of`.
        build: what decides the loop; scenarios with equal ones have one.
        built: the problem for which the loop is built.
        problem: the same with the scenario's exact parameters.
        shared: what decides a loop with live settings that serves more scenarios; None: there is none.
        alone: whether no other scenario has its loop, with or without live settings.
    """

    name: str
    group: str
    seed: int
    mismatch: float
    build: object
    built: Problem
    problem: Problem
    shared: Shared | None = None
    alone: bool = False


@dataclass(frozen=True, eq=False)
class Shared:
    """A loop that serves several scenarios, because numbers in which they differ are live."""

    key: object  # scenarios with equal ones have one loop
    built: Problem  # the problem for which it is built
    live: tuple[str, ...]  # paths of its live settings; the scenario's problem has their numbers


class Scenarios(ABC):
    """The scenarios of a study, by number; random ones and named cases differ in nothing else."""

    @abstractmethod
    def __getitem__(self, number: int) -> Scenario:
        """Return a scenario, always the same one."""

    @abstractmethod
    def options(self, number: int) -> tuple[str, ...]:
        """Return the options of `fpirhc run` that run a scenario once more."""

    @property
    def differ_in_exact_alone(self) -> bool:
        """Whether exact parameters are all in which the problems of the scenarios differ."""
        return False

    def automatic(self, controller: Controller) -> Controller:
        """Return the controller with those settings that it has whatever the scenario is."""
        return controller

    def has_many_alike(self, number: int) -> bool:  # noqa: ARG002
        """Whether the loop of a scenario serves all scenarios, or a register of them at least."""
        return True


@dataclass(frozen=True, eq=False)
class RandomScenarios(Scenarios):
    """Scenarios with drawn parameters and dead times."""

    of: Problem
    seed: int  # of the study
    use: int  # `COMPARING` or `TUNING`
    percent: float  # range of the exact parameters, percent

    def __post_init__(self) -> None:
        exact_ranges(self.of.moved, self.percent)

    def __getitem__(self, number: int) -> Scenario:
        plant, facts = self.of.moved, {"seed": self.seed, "use": self.use, "percent": self.percent}
        one = draw(plant, number=number, model=self.of.plant, **facts)  # type: ignore[arg-type]  # of several types
        lateness = one.lateness if self._dead_times.drawn else 0
        built = self._dead_times.at(lateness * self.percent)
        problem = built.with_exact(one.exact)
        return Scenario(str(number), "", one.seed, one.mismatch, lateness, built, problem, self._shared)

    def options(self, number: int) -> tuple[str, ...]:
        percent = np.format_float_positional(self.percent, trim="-")  # every digit, because draws depend on them
        return ("--scenario", str(number), "--mismatch", percent, "--seed", str(self.seed))

    def automatic(self, controller: Controller) -> Controller:
        return resolved(self.of, controller) if self._dead_times.drawn else controller

    @property
    def differ_in_exact_alone(self) -> bool:
        return not self._dead_times.drawn

    @cached_property
    def _shared(self) -> Shared | None:
        """The loop with live dead times, where they are drawn."""
        times = self._dead_times
        return Shared(None, times.room, times.live) if times.drawn else None

    @cached_property
    def _dead_times(self) -> DeadTimes:
        """Those of the plants; studies that tune draw none."""
        return DeadTimes(self.of, self.percent if self.use == COMPARING else 0.0)


@dataclass(frozen=True, eq=False)
class NamedCases(Scenarios):
    """Scenarios that are the cases of a problem file."""

    cases: Cases
    of: Problem
    seed: int  # of the study; a case without a seed of its own has noise of this one and of its place among the cases
    _built: dict[object, Problem] = field(default_factory=dict, init=False)
    _shared_builds: dict[object, Problem] = field(default_factory=dict, init=False)

    def __getitem__(self, number: int) -> Scenario:
        name = self.cases.names[number]
        key, own = self.cases.key(name), self.cases.seed(name)
        if key not in self._built:
            self._built[key] = self.cases.build(name, self.of)
        built = self._built[key]
        problem = self.cases.exactly(name, built)
        seed = int(np.random.SeedSequence(self.seed, spawn_key=(COMPARING, number)).generate_state(1)[0])
        moved = problem.moved
        exact = np.array([one.exact for one in moved.parameters.values()])
        mismatch = _mismatch(problem.plant, moved, exact)
        group, seed = self.cases.group(name), seed if own is None else own
        alone = self._alike[self.cases.key(name, self._data)] == 1
        return Scenario(name, group, seed, mismatch, key, built, problem, self._shared(name, built), alone)

    def options(self, number: int) -> tuple[str, ...]:
        name = self.cases.names[number]
        # A name that begins as an option does would be taken for one.
        case = (f"--case={name}",) if name.startswith("-") else ("--case", name)
        return (*case, "--seed", str(self[number].seed))

    def has_many_alike(self, number: int) -> bool:
        alike = self._alike[self.cases.key(self.cases.names[number], self._data)]
        return alike == len(self.cases.names) or alike >= _REGISTER

    @cached_property
    def _alike(self) -> Counter[object]:
        """Number of cases of every loop."""
        return Counter(self.cases.key(name, self._data) for name in self.cases.names)

    @cached_property
    def _data(self) -> tuple[str, ...]:
        """Paths of what is data of most loops: live numbers, and starts."""
        paths = {path for changes in self.cases.changes.values() for path in changes}
        return (*self._live, *(path for path in paths if path.startswith(f"{START}.")))

    def _shared(self, name: str, built: Problem) -> Shared | None:
        """The loop in which the numbers that cases change are live."""
        key = self.cases.key(name, self._live)
        return Shared(key, self._shared_builds.setdefault(key, built), self._live) if self._live else None

    @cached_property
    def _live(self) -> tuple[str, ...]:
        return self.cases.numbers(self.of)
