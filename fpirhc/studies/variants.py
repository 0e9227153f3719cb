"""Variants of a problem: named cases, plants drawn at random, cells of a grid. A study runs every controller in each of them."""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, Self

import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.plant.parameter import drawn, exact_ranges
from fpirhc.problem_files.problem_file import Task, with_numbers_of_all
from fpirhc.problem_files.settings import number_of_case, of_problem, with_numbers
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Variant:
    """One variant of a problem, the same for every controller."""

    name: str
    problem: Problem
    build: object = None  # variants with equal ones have one loop: their problems differ in exact parameters alone
    settings: Mapping[str, float] = field(default_factory=dict)  # of controllers, by path
    seed: int = 0  # of the noise
    group: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)  # what the table says of it, by path
    built: Problem | None = None  # by whose plant a gain is judged; None: `problem`
    believed: Problem | None = None  # by which automatic settings are chosen; None: `built`
    alone: bool = False  # whether no other variant has its loop


class Variants(ABC):
    """The variants of a study: plain data, from which every process makes the same ones."""

    seed: int

    @abstractmethod
    def of(self, task: Task) -> Sequence[Variant]:
        """Return the variants of a task."""

    @property
    def same(self) -> Mapping[str, object]:
        """What decides a variant beside its name; rows of studies that agree in it are rows of one study."""
        return {"variants": repr(self)}

    random = False  # whether they are a sample, from which the share of failures follows
    place = "at"  # what a table calls one


@dataclass(frozen=True)
class CasesOf(Variants):
    """The cases of the problem file that these patterns name."""

    patterns: tuple[str, ...] = ("all",)
    seed: int = 0
    place = "case"

    def __str__(self) -> str:
        return f"cases {', '.join(self.patterns)}, seed {self.seed}"

    @property
    def same(self) -> Mapping[str, object]:
        return {"kind": "cases", "seed": self.seed}

    def of(self, task: Task) -> Sequence[Variant]:
        cases = task.cases
        if cases is None:
            raise InvalidValue(
                f"problem '{task.name}' has no cases; add to its file cases = fpirhc.Cases({{'heavy': {{'exact.mass': 2.0}}}})"
            )
        made, variants, chosen = dict[object, Problem](), [], cases.matching(self.patterns)
        paths = dict.fromkeys(path for name in chosen for path in cases.changes[name])
        for name in chosen:
            key, seed = cases.key(name), int(_streams(self.seed, cases.names.index(name)).generate_state(1)[0])
            if key not in made:
                made[key] = cases.build(name, task.problem)
            problem = cases.exactly(name, made[key])
            numbers = {path: value for path in paths if (value := number_of_case(problem, path)) is not None}
            variants.append(Variant(name, problem, key, {}, seed, cases.group(name), numbers, made[key]))
        return _told_apart(variants)


@dataclass(frozen=True)
class Draws(Variants):
    """Plants drawn at random: exact parameters within `percent` of the problem's, dead times shorter or longer by it.

    Plant k of a seed is always the same, whatever the number of plants, of processes and of controllers. Controllers do not know
    what is drawn. A log-uniform factor lies between 1 - percent/100 and 1 + percent/100; a parameter with a spread has its own.
    """

    count: int
    percent: float = 0.0
    seed: int = 0
    random = True
    place = "plant"

    def __str__(self) -> str:
        within = f"exact parameters and dead times within {self.percent:g} % of the problem's"
        alone = "which differ in noise and stated spreads alone (--mismatch P draws parameters too)"
        return f"{self.count} plants of seed {self.seed}, {within if self.percent else alone}"

    @property
    def same(self) -> Mapping[str, object]:
        return {"kind": "draws", "mismatch": self.percent, "seed": self.seed}

    def of(self, task: Task) -> Sequence[Variant]:
        return self.of_problem(task.problem)

    def of_problem(self, problem: Problem) -> Sequence[Variant]:
        """Return the variants of a problem."""
        if self.count < 1:
            raise InvalidValue(f"draws {self.count}: expected at least 1")
        wide = {n for n, (low, high) in exact_ranges(problem.moves.parameters, self.percent).items() if high > low}
        delay = problem.dead_time
        delayed = delay.measurement or any(delay.inputs.values())
        late = bool(self.percent and delayed) and problem.moves.simulated  # a body outside has its own
        if self.count > 1 and not (wide or late or problem.random):
            mend = "state parameters of the plant, or a dead time" if self.percent else "give --mismatch P"
            raise InvalidValue(
                f"all {self.count} plants would be the same: the problem has no disturbances, no noise, and nothing that is drawn; "
                f"{mend}"
            )
        longer = lambda s: replace(problem, dead_time=problem.dead_time.longer(s * self.percent, problem.period))  # noqa: E731
        times = {s: longer(s) if late and s else problem for s in (-1, 0, 1)}
        return _Lazy(self.count, lru_cache(4096)(partial(self._one, problem, times, wide)))

    def _one(self, problem: Problem, times: Mapping[int, Problem], wide: Container[str], number: int) -> Variant:
        parameters, noise, late = _streams(self.seed, number).spawn(3)
        shares = np.random.default_rng(parameters).random(len(problem.moves.parameters))
        stated = zip(problem.moves.parameters.items(), shares, strict=True)
        exact = {name: drawn(one, self.percent, float(share)) for (name, one), share in stated}
        built = times[int(np.random.default_rng(late).integers(-1, 2))]
        numbers = {f"exact.{name}": float(value) for name, value in exact.items() if name in wide}
        if len({*times.values()}) > 1:
            now = {"dead_time.measurement": built.dead_time.measurement}
            numbers |= now | {f"dead_time.inputs.{name}": value for name, value in built.dead_time.inputs.items()}
        # A body outside may have no parameters.
        own = built.with_exact(np.array([*exact.values()], dtype=float)) if self.percent else built
        seed = int(noise.generate_state(1)[0])
        return Variant(str(number), own, id(built), {}, seed, "", numbers, built, believed=problem)


@dataclass(frozen=True)
class Grid(Variants):
    """Every combination of values of one or two settings, of controllers or of the problem, by path."""

    axes: Mapping[str, tuple[float, ...]]
    seed: int = 0

    def __str__(self) -> str:
        spans = (f"{path} at {len(v)} values from {v[0]:g} to {v[-1]:g}" for path, v in self.axes.items())
        return f"{', '.join(spans)}, seed {self.seed}"

    @property
    def same(self) -> Mapping[str, object]:
        return {"kind": "grid", "axes": [*self.axes], "seed": self.seed}

    def of(self, task: Task) -> Sequence[Variant]:
        with_numbers_of_all(task, {path: values[0] for path, values in self.axes.items()})  # refuses what nobody has
        made, variants = dict[object, Problem](), []

        def problem_with(numbers: Mapping[str, float]) -> Problem:
            key = tuple(sorted(numbers.items()))
            if key not in made:
                made[key] = with_numbers(task.problem, numbers)
            return made[key]

        for values in itertools.product(*self.axes.values()):
            numbers = dict(zip(self.axes, values, strict=True))
            ours = {path: value for path, value in numbers.items() if of_problem(path)}
            fixed = {path: value for path, value in ours.items() if not path.startswith("exact.")}
            name = ", ".join(f"{path} = {value:.10g}" for path, value in numbers.items())
            settings = {path: value for path, value in numbers.items() if path not in ours}
            build, own = tuple(sorted(fixed.items())), problem_with(ours)
            variants.append(Variant(name, own, build, settings, self.seed, "", numbers, problem_with(fixed)))
        return _told_apart(variants)

    @classmethod
    def parsed(cls, texts: Sequence[str], seed: int = 0) -> Self:
        """Return the grid of texts such as 'deformation.gain=-2:-0.1:40' or 'exact.m1=0.5:2:9:log'."""
        axes: dict[str, tuple[float, ...]] = {}
        for text in texts:
            path, _, span = text.partition("=")
            try:
                low, high, count, *rest = span.split(":")
                ends, points = (float(low), float(high)), int(count)
            except ValueError:
                raise InvalidValue(f"--over {text}: expected PATH=LOW:HIGH:COUNT or PATH=LOW:HIGH:COUNT:log") from None
            wrong = (
                "behind the count there may be 'log' alone" if rest not in ([], ["log"])
                else "expected at least 2 values" if points < 2
                else "expected two finite numbers, the smaller one first" if not -math.inf < ends[0] < ends[1] < math.inf
                else "with log both ends need one sign" if rest and ends[0] * ends[1] <= 0
                else "the same path twice" if path in axes
                else ""
            )  # fmt: skip
            if wrong:
                raise InvalidValue(f"--over {text}: {wrong}")
            values = (np.geomspace if rest else np.linspace)(*ends, points)
            axes[path] = tuple(float(f"{v:.10g}") for v in values)
        if not 1 <= len(axes) <= 2:
            raise InvalidValue(f"--over: {len(axes)} settings; expected one or two")
        return cls(axes, seed)


class _Lazy(Sequence[Variant]):
    """Variants that are made when they are asked for."""

    def __init__(self, count: int, make: Callable[[int], Variant]) -> None:
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: Any) -> Any:
        if isinstance(k, slice):
            return [self._make(i) for i in range(*k.indices(self._count))]
        return self._make(range(self._count)[int(k)])


def _streams(seed: int, number: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(0, number))


def _told_apart(variants: Sequence[Variant]) -> list[Variant]:
    counts = Counter(one.build for one in variants)
    return [replace(one, alone=counts[one.build] == 1) for one in variants]
