"""How wrong the model may be: the largest box of plants in which a controller holds, by draws and a search for one that fails.

Theory: docs/theory-robust.md, "How wrong the model may be".
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fpirhc.controllers.contract import Controller, believing
from fpirhc.errors import FpirhcError, InvalidValue
from fpirhc.fields.checked import Checked, checked_call
from fpirhc.fields.kinds import AboveZero, Accuracy, CountOrZero, Seed
from fpirhc.plant.motion import with_space
from fpirhc.plant.plant import Parametric, drawn, exact_ranges
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.settings import current_setting
from fpirhc.simulation.lanes import Lanes
from fpirhc.simulation.metrics import Metrics
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.simulation.sums import Values
from fpirhc.studies.comparison.compare import check_gains, select
from fpirhc.studies.operating_limits import FAILS, Judge, Point, bracket
from fpirhc.studies.scenarios.bench import Conditions, ranges, relative_error
from fpirhc.studies.scenarios.dead_times import DeadTimes
from fpirhc.studies.scenarios.draws import SEARCHING, draws_differ
from fpirhc.studies.scenarios.fingerprint import fingerprint
from fpirhc.studies.scenarios.ledger import kept_in
from fpirhc.studies.view import Progress, Study, View, circumstances, finite_alone
from fpirhc.summary import Column, Table, behind_equals, in_percent, in_units, line
from fpirhc.task.problem import Problem

if TYPE_CHECKING:
    import pandas as pd

LEDGER = "robust.jsonl"
RISK, CONFIDENCE = 0.05, 0.999  # where nothing else is said
_BOXES = 99  # of 1 % to 99 %
_MOST_DRAWS = 100_000  # plants of a box: hours of runs
_FIRST = 8  # percent: the first box that is tried
_GENERATION = 20  # plants of a generation, at most
_SIDE_BY_SIDE = 64  # plants that run before it is asked whether one failed


@dataclass(frozen=True)
class Counterexample:
    """A plant of the box that fails."""

    parameters: Mapping[str, float]  # its exact parameters, by name
    dead_times: Mapping[str, float]  # by path, in the unit of time; empty where they are the problem's
    units: Mapping[str, str]  # of both, by the same names
    why: str  # it fails
    from_percent: int  # the smallest box, in whole percent, at whose edge in this direction a plant fails


@dataclass(frozen=True)
class BoxFields(Checked):
    """The fields of the record of one box: with the `errors` of its plants, or with what a search `found`."""

    controller: str
    percent: CountOrZero
    error: float | None
    why: str


@dataclass(frozen=True)
class RobustBox:
    """The largest box of one controller."""

    controller: str  # its name
    percent: (
        float  # the largest box that was tried in which no drawn plant failed; NaN where the plant of the problem fails
    )
    fails_at: float  # the smallest box above it in which one failed, percent; infinite where none did
    why: str  # what failed there
    worst_drawn: float  # largest relative error of the plants drawn from the box
    worst_found: float  # largest relative error of those that the search tried beside them
    counterexample: Counterexample | None  # a plant of the box that the search found to fail; None: it found none


@dataclass(frozen=True, eq=False, kw_only=True)
class RobustBoxes(Study):
    """The result of `robust_boxes`."""

    risk: float  # largest share of failing plants in a box that holds
    confidence: float  # with which that is said
    draws: int  # plants that are drawn from a box
    fails: float  # relative error from which a run has failed
    seed: int  # of the draws
    boxes: tuple[RobustBox, ...]  # by controller, in their order
    untried: Mapping[str, str]  # reasons why controllers did not run, by name

    def __repr__(self) -> str:
        return line(self, self.problem, *(f"{one.controller}: {_percent(one.percent)}" for one in self.boxes))

    def to_dataframe(self) -> pd.DataFrame:
        """Return a row per controller: boxes in percent, relative errors, and the smallest box with a counterexample.

        Numbers of the counterexample stand in columns such as `counterexample.m1`; `attrs["units"]` has units by column.
        """
        import pandas as pd

        units = dict.fromkeys(("percent", "fails_at", "counterexample_from"), "%")
        rows = []
        for box in self.boxes:
            row, found = asdict(box), box.counterexample
            del row["counterexample"]
            row["counterexample_from"] = math.nan if found is None else found.from_percent
            if found is not None:
                row |= {f"counterexample.{n}": value for n, value in {**found.parameters, **found.dead_times}.items()}
                units |= {f"counterexample.{n}": unit for n, unit in found.units.items()}
            rows.append(row)
        return in_units(pd.DataFrame(rows), units)

    @property
    def view(self) -> View:
        """What every output says of it."""
        return _view(self)


@checked_call
def robust_boxes(
    task: Task,
    *,
    controllers: Sequence[str] | None = None,
    risk: Accuracy = RISK,
    confidence: Accuracy = CONFIDENCE,
    fails: AboveZero = FAILS,
    seed: Seed = 0,
    compiled: bool = True,
    folder: Path | None = None,
    command: str = "",
    progress: Progress | None = None,
) -> RobustBoxes:
    """Return for every controller the largest mismatch at which at most a share `risk` of all plants fails.

    The box of P percent holds the plants that `fpirhc compare --scenarios --mismatch P` draws: exact parameters, and dead times
    that are those of the problem, or P percent shorter or longer, in whole cycles. N plants are drawn, one direction each, and
    every box is asked with these; where none of the N fails,

        share of failing plants <= risk    with probability >= confidence,    N >= ln(99 / (1 - confidence)) / ln(1 / (1 - risk)),

    for all of the 99 boxes of whole percents at once, so that the largest one may be chosen. Inside it a search (differential
    evolution from the worst plants, their corners and those across, about N runs) then looks for a plant that fails all the same.

    Args:
        task: the loaded problem file.
        controllers: names of controllers; None: all.
        risk: largest share of failing plants.
        confidence: with which that is said.
        fails: relative error (rms over the range of the reference) from which a run has failed; one that ends early or leaves a
            limit of a state has failed too.
        seed: of the draws and of the noise.
        compiled: whether runs use compiled C.
        folder: to which finished boxes and searches are written; those that it holds are not repeated. None: nothing is kept.
        command: the command line, for the report.
        progress: function of (controller, boxes asked, boxes in all, at most).

    Raises:
        InvalidProblem: unknown controllers, gains of the wrong sign.
        InvalidValue: a share that is none or needs too many plants, `fails` that is not positive, or a plant without parameters
            or dead times to draw.
        OutputError: the folder cannot be written, or holds results under other conditions.
    """
    begin = time.perf_counter()
    most = _most(task)
    chosen = select(task, controllers)
    check_gains(task, chosen)
    draws = wanted_draws(risk, confidence)
    boxes, untried = [], {}
    conditions = Conditions(seed, SEARCHING, 0.0, compiled)
    path = None if folder is None else folder / LEDGER
    with kept_in(path, lambda: {**fingerprint(task, conditions), "fails": fails, "draws": draws}, BoxFields) as (
        records,
        keep,
    ):
        for name, controller in chosen.items():
            own = [one for one in records if one["controller"] == name]
            try:
                plants = _Plants(task, believing(task.problem, controller), draws, most, fails, seed, compiled)
                boxes.append(_robust_box(name, plants, most, progress, own, keep))
            except FpirhcError as error:
                untried[name] = str(error)
    return RobustBoxes(
        risk=risk,
        confidence=confidence,
        draws=draws,
        fails=fails,
        seed=seed,
        boxes=tuple(boxes),
        untried=untried,
        **circumstances(task, chosen, command, begin),
    )


def wanted_draws(risk: float, confidence: float) -> int:
    """Return how many plants have to hold in a box; see `robust_boxes`.

    Raises:
        InvalidValue: more than a hundred thousand.
    """
    wanted = math.log(_BOXES / (1 - confidence))
    draws = wanted / -math.log1p(-risk)
    if draws > _MOST_DRAWS:
        least = 1.001 * -math.expm1(-wanted / _MOST_DRAWS)
        raise InvalidValue(
            f"a risk of {risk:g} with confidence {confidence:g} needs {draws:.2g} plants per box: expected at most "
            f"{_MOST_DRAWS:g}, so a risk of at least {least:.3g}, or less confidence"
        )
    return math.ceil(draws)


def _most(task: Task) -> int:
    """The largest box in which every plant is one, percent."""
    moved: Parametric = task.problem.moved
    least, beyond = 0, _BOXES + 1
    while beyond - least > 1:
        middle = (least + beyond) // 2
        try:
            exact_ranges(moved, middle)
        except FpirhcError as error:
            beyond, refusal = middle, str(error)
        else:
            least, refusal = middle, ""
    if least and draws_differ(task.problem, least):
        return least
    why = refusal or "all are zero or given by signals"
    raise InvalidValue(f"problem '{task.name}' has no parameters or dead times that can be drawn: {why}")


def _robust_box(
    name: str,
    plants: _Plants,
    most: int,
    progress: Progress | None,
    known: Sequence[Mapping[str, Any]],
    keep: Callable[[Mapping[str, Any]], None],
) -> RobustBox:
    drawn_before = {one["percent"]: one for one in known if "errors" in one}
    asked: dict[int, Point] = {}
    steps = 2 + 2 * math.ceil(math.log2(most))

    def worst(percent: int) -> Point:
        """The first drawn plant that fails, or the one with the largest error."""
        if percent not in asked:
            if percent in drawn_before:
                one = drawn_before[percent]
                plants.errors, asked[percent] = (
                    _read(one["errors"]),
                    Point(percent, float(_read([one["error"]])[0]), one["why"]),
                )
            else:
                asked[percent] = plants.worst_drawn(percent)
                keep(_record(name, percent, asked[percent].error, asked[percent].why, errors=plants.errors.tolist()))
            if progress:
                progress(name, len(asked), steps)
        return asked[percent]

    if worst(0).why:
        return RobustBox(name, math.nan, 0.0, asked[0].why, asked[0].error, asked[0].error, None)
    low, fails = bracket(lambda percent: bool(worst(int(percent)).why), 0, _FIRST, most, step=1, near=1.0)
    holds, why = int(low), asked[int(fails)].why if math.isfinite(fails) else ""
    searched = next((one for one in known if "found" in one), None)
    if searched is None:
        largest, example = plants.search(holds)
        keep(_record(name, holds, largest, "", found=None if example is None else asdict(example)))
    else:
        found = searched["found"]
        largest, example = float(_read([searched["error"]])[0]), None if found is None else Counterexample(**found)
    if progress:
        progress(name, steps, steps)
    return RobustBox(name, float(holds), float(fails), why, asked[holds].error, largest, example)


def _record(name: str, percent: int, error: float, why: str, **more: object) -> dict[str, Any]:
    told: dict[str, Any] = finite_alone({"controller": name, "percent": percent, "error": error, "why": why, **more})
    return told


def _read(errors: Sequence[float | None]) -> np.ndarray:
    """Errors of a record, where one of a run that ended early is null."""
    return np.array([math.inf if one is None else one for one in errors])


class _Plants:
    """The plants of all boxes, by percent and direction: the share of the distribution of every parameter, shape (np,).

    Where dead times are drawn one share stands behind these: its thirds are shorter ones, those of the problem, and longer ones.
    """

    def __init__(
        self, task: Task, controller: Controller, draws: int, most: int, fails: float, seed: int, compiled: bool
    ) -> None:
        self._problem, self._judge = task.problem, Judge(task, fails, seed)
        self._controller, self._compiled, self._seed = controller, compiled, seed
        self._parameters, self._dead_times = task.problem.moved.parameters, DeadTimes(task.problem, most)
        sizes, shares, self._noise = (len(self._parameters), int(self._dead_times.drawn)), [], []
        for k in range(draws):
            own, noise, late = np.random.SeedSequence(seed, spawn_key=(SEARCHING, k)).spawn(3)
            shares.append(
                np.hstack([np.random.default_rng(one).random(n) for one, n in zip((own, late), sizes, strict=True)])
            )
            self._noise.append(int(noise.generate_state(1)[0]))
        self._shares = np.array(shares)
        self.errors, self._metrics = np.zeros(draws), [m for m in task.metrics if m.name == "rms_error"]
        self._loop = self._built()

    def worst_drawn(self, percent: int) -> Point:
        """Return the first drawn plant of the box that fails, or the one with the largest error; of 0 % the problem's own."""
        if percent and self._lanes is not None:
            chosen = self._worst_of_lanes(self._lanes, percent)
            if chosen is not None:
                return chosen
        worst = Point(percent, 0.0, "")
        for k, (shares, noise) in enumerate(zip(self._shares, self._noise, strict=True)):
            one = self._point(percent, shares, noise)
            self.errors[k] = one.error
            worst = max(worst, one, key=lambda point: point.error)
            if one.why:
                return one
            if percent == 0 and not self._problem.disturbances and self._problem.sensing.ideal:
                break  # all of them are the same
        return worst

    @cached_property
    def _lanes(self) -> Lanes | None:
        """For plants side by side, where they fail by their errors alone."""
        problem = self._problem
        if not self._compiled or problem.reality is not None or problem.limits.states:
            return None
        lanes = Lanes(self._loop, self._metrics)
        return None if lanes.why else lanes

    def _worst_of_lanes(self, lanes: Lanes, percent: int) -> Point | None:
        """The same by plants side by side; None where rounding decides which one fails first, or a plant cannot run."""
        for begin in range(0, len(self._shares), _SIDE_BY_SIDE):
            some = slice(begin, begin + _SIDE_BY_SIDE)
            errors = self._errors_of_lanes(lanes, percent, self._shares[some], self._noise[some])
            if errors is None:
                return None
            self.errors[some] = errors
            failing = np.flatnonzero(~(errors <= self._judge.fails))
            if failing.size:
                k = begin + int(failing[0])
                first = self._point(percent, self._shares[k], self._noise[k])
                return first if first.why else None
        worst = int(np.argmax(self.errors))
        largest = self._point(percent, self._shares[worst], self._noise[worst])
        return None if largest.why else largest

    def _errors_of_lanes(
        self, lanes: Lanes, percent: int, shares: np.ndarray, noise: Sequence[int]
    ) -> np.ndarray | None:
        """The errors of plants side by side; None where one cannot run, which the loop one after the other names."""
        try:
            plants = [self._plant(percent, one) for one in shares]
            pairs, alone = zip(plants, noise, strict=True), not self._dead_times.drawn
            runs = [lanes.one_run(self._loop, problem, own, exact_alone=alone) for problem, own in pairs]
        except FpirhcError:
            return None
        return np.array([self._error(one) for one in lanes.values(runs)])

    def _error(self, values: Values | None) -> float:
        """The relative error of a run; infinite where it ends early."""
        if values is None:
            return math.inf
        return relative_error(Metrics(values, {}, {m.name: m for m in self._metrics}), self._sizes)

    @cached_property
    def _sizes(self) -> dict[str, float]:
        return ranges(self._problem)

    def search(self, percent: int) -> tuple[float, Counterexample | None]:
        """Return the largest error that a search in the box meets, and a plant that fails, if it meets one."""
        from scipy.optimize import differential_evolution

        size = min(_GENERATION, max(5, 4 * self._shares.shape[1]), max(5, len(self._shares) // 4))
        order = np.argsort(self.errors)[::-1]
        worst = self._shares[order[: max(size // 3, 2)]]
        start = np.vstack([worst, np.round(worst), 1 - np.round(worst)])  # their corners, and the corners across
        largest, noise = 0.0, self._noise[int(order[0])]

        def negative_errors(columns: np.ndarray) -> np.ndarray:
            nonlocal largest
            errors = self._searched(percent, columns.T, noise)
            largest = max(largest, float(errors.max()))
            return -errors

        limits = [(0.0, 1.0)] * self._shares.shape[1]
        generations = max(len(self._shares) // len(start) - 1, 1)
        try:
            differential_evolution(
                negative_errors,
                limits,
                init=start,
                maxiter=generations,
                tol=0,
                polish=False,
                seed=self._seed,
                vectorized=True,
                updating="deferred",
            )
        except _Found as failing:
            return max(largest, failing.point.error), self._counterexample(percent, failing, noise)
        return largest, None

    def _searched(self, percent: int, generation: np.ndarray, noise: int) -> np.ndarray:
        """The errors of the plants of a generation, a row of shares each; the first that fails ends the search."""
        if self._lanes is not None:
            errors = self._errors_of_lanes(self._lanes, percent, generation, [noise] * len(generation))
            if errors is not None and (errors <= self._judge.fails).all():
                return errors
        errors = np.empty(len(generation))
        for k, shares in enumerate(generation):
            one = self._point(percent, shares, noise)
            if one.why:
                raise _Found(shares, one)
            errors[k] = one.error
        return errors

    def _counterexample(self, percent: int, failing: _Found, noise: int) -> Counterexample:
        holds, fails = 0, percent
        while fails - holds > 1:
            middle = (holds + fails) // 2
            holds, fails = (holds, middle) if self._point(middle, failing.shares, noise).why else (middle, fails)
        values = self._exact(percent, failing.shares)
        parameters = dict(zip(self._parameters, map(float, values), strict=True))
        dead_times = self._other_dead_times(percent, failing.shares)
        units = {name: one.unit for name, one in self._parameters.items()} | dict.fromkeys(
            dead_times, self._problem.time_unit
        )
        return Counterexample(parameters, dead_times, units, failing.point.why, fails)

    def _other_dead_times(self, percent: int, shares: np.ndarray) -> dict[str, float]:
        plant = self._plant(percent, shares)
        both = {
            path: [float(current_setting(one, path)) for one in (plant, self._problem)]
            for path in self._dead_times.live
        }
        return {path: own for path, (own, usual) in both.items() if own != usual}

    def _plant(self, percent: int, shares: np.ndarray) -> Problem:
        """The problem with a plant of the box."""
        lateness = min(int(3 * shares[-1]), 2) - 1 if self._dead_times.drawn else 0
        return self._dead_times.at(lateness * percent).with_exact(self._exact(percent, shares))

    def _exact(self, percent: int, shares: np.ndarray) -> np.ndarray:
        pairs = zip(self._parameters.values(), shares, strict=False)
        return np.array([drawn(parameter, percent, float(share)) for parameter, share in pairs])

    def _point(self, percent: int, shares: np.ndarray, noise: int) -> Point:
        try:
            problem = self._plant(percent, shares)
        except FpirhcError as error:
            return Point(percent, math.inf, str(error))
        if self._loop.remembers:
            self._loop = self._built()
        return self._judge.point(percent, problem, self._loop.run(seed=noise, variant=problem))

    def _built(self) -> Simulator:
        times = self._dead_times
        return simulator(times.room, self._controller, compiled=self._compiled, live=times.live)


class _Found(Exception):  # it ends a search and reports no error
    """A plant that fails ends the search."""

    def __init__(self, shares: np.ndarray, point: Point) -> None:
        self.shares, self.point = shares.copy(), point


# --- What is said of it -------------------------------------------------------------------------------------------------


def _view(result: RobustBoxes) -> View:
    conditions = (
        f"A run fails if it ends early, leaves a limit of a state, or has an rms error above {in_percent(result.fails)} of the "
        f"reference's range. The box of P percent holds the plants that scenarios with a mismatch of P percent draw. "
        f"{result.draws} plants per box; where none fails, at most {in_percent(result.risk)} of all plants of the box do, with "
        f"{in_percent(result.confidence)} confidence for all boxes at once."
    )
    heads = ["controller", "box [%]", "fails at [%]", "worst drawn", "worst found", "counterexample from [%]"]
    table = Table(f"{result.problem}: how wrong the model may be", [Column(head) for head in heads], conditions)
    for one in result.boxes:
        example = "none found" if one.counterexample is None else str(one.counterexample.from_percent)
        errors = (_error(one.worst_drawn), _error(one.worst_found))
        table.add([one.controller, _percent(one.percent), _percent(one.fails_at), *errors, example])
    examples = [f"{one.controller}: {_plant(one.counterexample)}" for one in result.boxes if one.counterexample]
    return result.viewed(
        sentences=[(text, None) for text in _sentences(result)],
        conditions=conditions,
        tables=(table,),
        lists={"Plants of the boxes that fail": examples},
        skipped=result.untried,
        facts={
            **{name: getattr(result, name) for name in ("problem", "risk", "confidence", "draws", "fails", "seed")},
            "boxes": [asdict(one) for one in result.boxes],
            "untried": dict(result.untried),
            "versions": result.versions,
        },
    )


def _sentences(result: RobustBoxes) -> Iterator[str]:
    for one in sorted(result.boxes, key=lambda box: -1.0 if math.isnan(box.percent) else box.percent, reverse=True):
        if math.isnan(one.percent):
            yield f"{one.controller}: fails as the problem stands ({one.why})."
            continue
        above = "the largest that was tried" if math.isinf(one.fails_at) else f"at {one.fails_at:g} % one fails"
        if one.counterexample is None:
            searched = f"a search found none that fails (largest error {_error(one.worst_found)})"
        else:
            searched = f"a search found one that fails, and such plants begin at {one.counterexample.from_percent} %"
        yield f"{one.controller}: no plant drawn from the box of {one.percent:g} % fails, {above}; {searched}."


def _plant(example: Counterexample) -> str:
    values = ", ".join(
        f"{name} = {behind_equals(value)}{with_space(example.units[name])}"
        for name, value in {**example.parameters, **example.dead_times}.items()
    )
    return f"{values} ({example.why}); in this direction plants fail from {example.from_percent} % on"


def _percent(value: float) -> str:
    return "as it stands" if math.isnan(value) else "none" if math.isinf(value) else f"{value:g}"


def _error(value: float) -> str:
    return in_percent(value) if math.isfinite(value) else "ended early"
