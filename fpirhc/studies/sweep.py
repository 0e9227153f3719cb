"""Maps of behaviour: what every controller does over one setting, or over two.

A cell of the map is a case of the problem with settings of the controller. Cells are kept in a ledger one by one, so that an
interrupted sweep goes on. Settings that can be live are numbers of one loop; for others every value has a loop of its own.
"""

from __future__ import annotations

import itertools
import math
import shlex
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fpirhc.describe import describe
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, Mistakes, listed, nearest
from fpirhc.fields.checked import Checked, checked_call
from fpirhc.fields.kinds import CountOrZero, Seed
from fpirhc.plant.motion import with_space
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.settings import current_setting, is_whole, of_problem, unit_of_setting
from fpirhc.studies.comparison.compare import check_gains, select
from fpirhc.studies.objective import Objective, figure
from fpirhc.studies.scenarios.bench import SIDE_BY_SIDE, Conditions, Trials, is_of_judgements
from fpirhc.studies.scenarios.draws import COMPARING
from fpirhc.studies.scenarios.fingerprint import fingerprint
from fpirhc.studies.scenarios.ledger import Ledger
from fpirhc.studies.view import Progress, Study, View, circumstances
from fpirhc.summary import Column, Table, behind_equals, in_percent, in_units, line, number
from fpirhc.symbolic.paths import names_in
from fpirhc.task.cases import PARAMETERS, START, Cases
from fpirhc.task.problem import Problem

if TYPE_CHECKING:
    import pandas as pd

LEDGER = "sweep.jsonl"
_MOST, _CELLS = 2, 1_000_000  # settings of a map, and its cells
_BLOCK = 64  # cells that run side by side, and are finished together
_LOG = "log"
_FORM = "PATH=LOW:HIGH:COUNT, or PATH=LOW:HIGH:COUNT:log"


@dataclass(frozen=True)
class Axis:
    """A setting and its values.

    Args:
        path: of the setting: of a case of the problem, such as 'exact.m1', 'start.q1' or 'dead_time.inputs.Q1', or of the
            controllers, such as 'deformation.gain'.
        values: numbers in ascending or descending order, at least two.
        logarithmic: whether equal factors lie between them.

    Raises:
        InvalidValue: fewer than two different finite values.
    """

    path: str
    values: tuple[float, ...]
    logarithmic: bool = False

    def __post_init__(self) -> None:
        steps = np.diff(self.values)
        if len(self.values) < 2 or not np.isfinite(self.values).all() or not ((steps > 0).all() or (steps < 0).all()):
            shown = ", ".join(map(number, self.values))
            raise InvalidValue(
                f"sweep over '{self.path}': expected at least two finite numbers in order, got ({shown})"
            )

    @classmethod
    def parsed(cls, text: str) -> Axis:
        """Return the axis that a text states: 'deformation.gain=-2:-0.1:40', or 'exact.m1=0.5:2:9:log' by equal factors.

        Raises:
            InvalidValue: another form, no number, an empty range, or equal factors from one sign to the other.
        """
        path, _, span = text.partition("=")
        parts = span.split(":")
        form = f"--over {text}: expected {_FORM}, such as deformation.gain=-2:-0.1:40"
        if not path or len(parts) not in (3, 4) or parts[3:] not in ([], [_LOG]):
            raise InvalidValue(form)
        try:
            low, high, count = float(parts[0]), float(parts[1]), int(parts[2])
        except ValueError:
            raise InvalidValue(form) from None
        if not (math.isfinite(low) and math.isfinite(high)) or low == high or count < 2:
            raise InvalidValue(
                f"--over {text}: an empty range; expected two different finite ends and at least 2 values"
            )
        if count > _CELLS:
            raise InvalidValue(f"--over {text}: expected at most {_CELLS} values, got {count}")
        logarithmic = bool(parts[3:])
        if logarithmic and not low * high > 0:
            raise InvalidValue(f"--over {text}: equal factors need two ends of one sign that are not zero")
        values = (np.geomspace if logarithmic else np.linspace)(low, high, count)
        return cls(path, tuple(float(f"{v:.10g}") for v in values), logarithmic)


@dataclass(frozen=True)
class CellFields(Checked):
    """The fields of the record of one cell."""

    controller: str
    cell: CountOrZero
    outcome: str
    value: float | None
    reason: str


@dataclass(frozen=True, eq=False)
class SweepMap:
    """What one controller does."""

    controller: str  # its name
    # the figure that is judged, an entry per value of every setting; smaller is better, and infinite where a run ended early
    figures: np.ndarray
    outcomes: np.ndarray  # 'finished', 'diverged', 'ended early' or 'refused', of the same shape
    reasons: Mapping[str, str]  # why a first run of each outcome did not finish; '' where it only diverged
    without: tuple[str, ...]  # paths of settings that it does not have: its numbers are the same along these axes
    rebuilt: tuple[str, ...]  # paths of settings of which every value needed a loop of its own
    now: Mapping[str, float]  # its settings and those of the problem as they stand, by path
    apart: str = ""  # why its runs were one after the other; empty where they were side by side

    @cached_property
    def values(self) -> np.ndarray:
        """The figures of the runs that finished, and infinite elsewhere: nothing is best by a run that diverged."""
        return np.where(self.outcomes == "finished", self.figures, math.inf)

    @property
    def failed(self) -> float:
        """Share of the cells whose run did not finish."""
        return float((self.outcomes != "finished").mean())


@dataclass(frozen=True, eq=False, kw_only=True)
class Sweep(Study):
    """The result of `sweep`."""

    axes: tuple[Axis, ...]  # one setting or two
    maps: tuple[SweepMap, ...]  # one per controller
    aim: Objective  # the figure that is judged
    seed: int  # of the noise, the same in all cells
    units: Mapping[str, str]  # units of the settings and of the figure that have one, by name

    def __repr__(self) -> str:
        names = " x ".join(f"{len(axis.values)} {axis.path}" for axis in self.axes)
        return line(
            self, self.problem, names, *(f"{one.controller}: {in_percent(one.failed)} failed" for one in self.maps)
        )

    def of(self, controller: str) -> SweepMap:
        """Return the map of a controller.

        Raises:
            InvalidName: there is none.
        """
        result = {one.controller: one for one in self.maps}
        if controller not in result:
            raise InvalidName(f"no map of '{controller}'.{nearest(controller, result)}")
        return result[controller]

    def run_command(self, controller: str) -> str:
        """Return the beginning of the command that runs a controller; settings and seed follow."""
        task = shlex.split(self.command)[2] if self.command else self.problem
        return shlex.join(["fpirhc", "run", task, controller])

    @staticmethod
    def set_texts(axis: Axis) -> list[str]:
        """Return what stands behind --set in the command of a run, for every value of a setting."""
        return [shlex.quote(f"{axis.path}={value:.10g}") for value in axis.values]

    @property
    def ranks(self) -> bool:
        """Whether one controller may be better than another: there are several, and the figure has a better side."""
        return len(self.maps) > 1 and self.aim.ranks

    @cached_property
    def winners(self) -> np.ndarray:
        """Place of the controller with the best number among `maps`, per cell; -1 where none is alone the best."""
        values = np.array([one.values for one in self.maps])
        least = values.min(axis=0)
        alone = self.aim.ranks & np.isfinite(least) & ((values == least).sum(axis=0) == 1)
        return np.where(alone, values.argmin(axis=0), -1)

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield a row for every cell and controller: settings, controller, figure as it is told, outcome."""
        for one in self.maps:
            for place in np.ndindex(one.values.shape):
                settings = {axis.path: axis.values[k] for axis, k in zip(self.axes, place, strict=True)}
                value = self.aim.told(float(one.figures[place]))
                yield {
                    **settings,
                    "controller": one.controller,
                    self.aim.name: value,
                    "outcome": str(one.outcomes[place]),
                }

    def to_dataframe(self) -> pd.DataFrame:
        """Return the rows as a pandas DataFrame; `attrs["units"]` has the units of columns that have one, by name."""
        import pandas as pd

        return in_units(pd.DataFrame(self.rows()), self.units)

    @property
    def view(self) -> View:
        """What every output says of it."""
        return _view(self)


@checked_call
def sweep(
    task: Task,
    over: Sequence[Axis],
    *,
    folder: Path,
    controllers: Sequence[str] | None = None,
    metric: str | None = None,
    seed: Seed = 0,
    compiled: bool = True,
    command: str = "",
    progress: Progress | None = None,
) -> Sweep:
    """Run every controller at every value of one setting, or of two, and return the maps.

        axes = [Axis("deformation.gain", (-2.0, -1.0, -0.5)), Axis("exact.m1", (0.5, 1.0, 2.0))]
        sweep(fp.load_problem("two_mass"), axes, folder=Path("map"), controllers=["CTC+FPI"]).to_dataframe()

    Args:
        over: one setting or two. A path that begins with a field of the problem, or with exact., approximate., known. or start., is
            the problem's, see `Cases`; any other is the controllers', and those that do not have it are the same along it.
        folder: folder to which finished cells are written; those that it holds are not repeated.
        controllers: names of controllers; None: all.
        metric: figure of merit, such as 'settling.q1'; None: the problem's headline metric, or the relative error.
        progress: function of (controller, cells done, cells in all).

    Raises:
        InvalidName: a path that leads nowhere; an unknown metric.
        InvalidProblem: unknown controllers, gains of the wrong sign.
        InvalidValue: no setting or more than two, a value that the problem does not accept.
        OutputError: the folder cannot be written, or holds results under other conditions.
    """
    begin = time.perf_counter()
    chosen = select(task, controllers)
    check_gains(task, chosen)
    axes = tuple(replace(axis, path=of_problem(task.problem, axis.path) or axis.path) for axis in over)
    of_cases = _checked_axes(replace(task, controllers=chosen), axes)
    aim = figure(task.headline_metric if metric is None else metric, task.metrics, task.problem)
    grid = _Grid(axes, of_cases, seed)
    measured = [m for m in task.metrics if m.name in ("rms_error", aim.metric.name if aim.metric else "")]
    task = replace(task, controllers=chosen, cases=grid.cases, metrics=measured)
    conditions = Conditions(seed, COMPARING, 0.0, compiled, named=True, judged=is_of_judgements(aim.metric))
    header = {**fingerprint(task, conditions), "axes": describe(axes), "metric": aim.name}
    with Ledger(folder / LEDGER, header, CellFields) as ledger:
        maps = tuple(_Runner(task, name, grid, conditions, aim, ledger).map(progress) for name in chosen)
    units = {**{axis.path: unit_of_setting(axis.path, task.problem) for axis in axes}, aim.name: aim.unit}
    told = {name: unit for name, unit in units.items() if unit not in ("", "1")}
    return Sweep(axes=axes, maps=maps, aim=aim, seed=seed, units=told, **circumstances(task, chosen, command, begin))


# --- The grid ------------------------------------------------------------------------------------------------------------


def _checked_axes(task: Task, axes: Sequence[Axis]) -> frozenset[str]:
    """Return the paths that are the problem's."""
    if not 0 < len(axes) <= _MOST:
        raise InvalidValue(
            f"a sweep has one setting or two, got {len(axes)}; a third one is another sweep, with run --set"
        )
    if (cells := math.prod(len(axis.values) for axis in axes)) > _CELLS:
        raise InvalidValue(f"a sweep has at most {_CELLS} cells, got {cells}: give fewer values")
    if len({axis.path for axis in axes}) < len(axes):
        raise InvalidValue(f"'{axes[0].path}' is given twice")
    words = {f.name for f in fields(task.problem)} | {*PARAMETERS, START}
    of_cases = frozenset(axis.path for axis in axes if of_problem(task.problem, axis.path))
    mistakes = Mistakes("sweep")
    for axis in axes:
        with mistakes.caught():
            if axis.path in of_cases:
                ends = (axis.values[0], axis.values[-1])
                _Values({f"{axis.path} = {behind_equals(v)}": {axis.path: v} for v in ends}).check(task.problem)
            else:
                _check_controllers(task, axis, words)
    mistakes.raise_if_any()
    return of_cases


def _check_controllers(task: Task, axis: Axis, words: Collection[str]) -> None:
    """Raise where no controller has the setting, or one that has it cannot take a value."""
    lacking: dict[str, str] = {}
    for name, controller in task.controllers.items():
        try:
            current_setting(controller, axis.path)
        except FpirhcError as error:
            lacking[name] = f"{name}: {error}"
            continue
        if is_whole(controller, axis.path) and any(v % 1 for v in axis.values):
            shown = ", ".join(map(number, axis.values))
            raise InvalidValue(
                f"'{axis.path}' of '{name}' is a whole number, and the values are {shown}; choose another COUNT"
            )
    if len(lacking) < len(task.controllers):
        return
    word, fields_of = axis.path.partition(".")[0], {n for one in task.controllers.values() for n in names_in(one)}
    if word in fields_of:
        told = [text for name, text in lacking.items() if task.controllers[name].deformation.adapts]
        raise InvalidName(f"no controller has '{axis.path}'. {(told or list(lacking.values()))[-1]}")
    parameters = task.problem.moved.parameters
    if axis.path.rpartition(".")[2] in PARAMETERS:
        raise InvalidName(f"the problem has no parameter '{axis.path.rpartition('.')[0]}'.{nearest(word, parameters)}")
    parameter = f" The parameter is 'exact.{word}'." if word in parameters else ""
    hint = parameter or nearest(word, sorted({*words, *fields_of}))
    raise InvalidName(f"neither the problem nor a controller has '{axis.path}'.{hint}")


def _of_problem(problem: Problem, path: str) -> float | None:
    """The number of the problem at the path of a case; None where there is none yet."""
    word, _, name = path.partition(".")
    if word == "exact":
        return problem.moved.parameters[name].exact
    if word in PARAMETERS:
        return problem.plant.parameters[name].approximate
    if word == START:
        return float(problem.start_state[problem.plant.state.elements.index(name)])
    try:
        return float(current_setting(problem, path))
    except FpirhcError:
        return None


class _Values(Cases):
    """Values of settings as cases; a message has them in place of the name of a case."""

    _where = ""

    def _place(self, name: str, path: str = "", *, head: bool = False) -> str:  # noqa: ARG002
        return name


class _Grid:
    """The cells, by number: the last axis is the fastest. `of_problem`: paths that are the problem's."""

    def __init__(self, axes: Sequence[Axis], of_problem: frozenset[str], seed: int) -> None:
        self.axes, self.of_problem = axes, of_problem
        self.shape = tuple(len(axis.values) for axis in axes)
        self._case_axes = [axis for axis in axes if axis.path in of_problem]
        cases = [
            dict(zip([a.path for a in self._case_axes], values, strict=True))
            for values in itertools.product(*(a.values for a in self._case_axes))
        ]
        names = [", ".join(f"{path} = {float(value)!r}" for path, value in case.items()) for case in cases]
        self.cases = _Values(
            {name or "as it stands": {**case, "seed": seed} for name, case in zip(names, cases, strict=True)}
        )

    def case(self, place: Sequence[int]) -> int:
        """Return the number of a cell's case."""
        places = [k for k, axis in zip(place, self.axes, strict=True) if axis in self._case_axes]
        sizes = [len(axis.values) for axis in self._case_axes]
        return int(np.ravel_multi_index(places, sizes)) if places else 0

    def settings(self, place: Sequence[int], paths: Sequence[str]) -> dict[str, float]:
        """Return the numbers of a cell's settings."""
        return {axis.path: axis.values[k] for axis, k in zip(self.axes, place, strict=True) if axis.path in paths}


class _Runner:
    """Runs the cells of one controller: with one loop where its settings can be live, else with one for each value."""

    def __init__(
        self, task: Task, name: str, grid: _Grid, conditions: Conditions, aim: Objective, ledger: Ledger
    ) -> None:
        self._name, self._grid, self._aim, self._ledger = name, grid, aim, ledger
        self._controller = task.controllers[name]
        own = [axis.path for axis in grid.axes if axis.path not in grid.of_problem]
        self._now = {path: value for path in own if (value := self._current(path)) is not None}
        self._without = tuple(path for path in own if path not in self._now)
        self._of_problem = {path: v for path in grid.of_problem if (v := _of_problem(task.problem, path)) is not None}
        cells = math.prod(
            size for size, axis in zip(grid.shape, grid.axes, strict=True) if axis.path not in self._without
        )
        self._trials = Trials(task, name, list(self._now), replace(conditions, side_by_side=cells >= SIDE_BY_SIDE))

    def map(self, progress: Progress | None) -> SweepMap:
        """Return the map; cells that the ledger has are not run again."""
        known = {r["cell"]: r for r in self._ledger.records if r["controller"] == self._name}
        places = [p for p in np.ndindex(*self._grid.shape) if self._stands_for_others(p)]
        # Settings are the outer loop: what must be built anew is built once.
        places.sort(key=lambda p: tuple(self._settings(p).values()))
        todo = [p for p in places if self._number(p) not in known]
        if progress:
            progress(self._name, len(known), len(places))
        for at in range(0, len(todo), _BLOCK):
            for new in self._records(todo[at : at + _BLOCK]):
                known[new["cell"]] = new
                self._ledger.append(new)
                if progress:
                    progress(self._name, len(known), len(places))
        figures, outcomes = np.full(self._grid.shape, math.inf), np.empty(self._grid.shape, dtype=object)
        reasons: dict[str, str] = {}
        for place in np.ndindex(*self._grid.shape):
            record = known[self._number(self._representative(place))]
            figures[place] = math.inf if record["value"] is None else record["value"]
            outcomes[place] = record["outcome"]
            if record["outcome"] != "finished":
                reasons.setdefault(record["outcome"], record["reason"])
        rebuilt = () if self._live else tuple(self._now)
        return SweepMap(
            self._name,
            figures,
            outcomes,
            reasons,
            self._without,
            rebuilt,
            {**self._now, **self._of_problem},
            self._trials.apart,
        )

    def _current(self, path: str) -> float | None:
        try:
            return float(current_setting(self._controller, path))
        except FpirhcError:
            return None

    def _representative(self, place: Sequence[int]) -> tuple[int, ...]:
        """The cell that is run for this one: the first along settings that the controller does not have."""
        axes = zip(place, self._grid.axes, strict=True)
        return tuple(0 if axis.path in self._without else k for k, axis in axes)

    def _stands_for_others(self, place: tuple[int, ...]) -> bool:
        return self._representative(place) == place

    def _number(self, place: Sequence[int]) -> int:
        return int(np.ravel_multi_index(tuple(place), self._grid.shape))

    def _settings(self, place: Sequence[int]) -> dict[str, float]:
        result = self._grid.settings(place, list(self._now))
        return {p: round(v) if is_whole(self._controller, p) else v for p, v in result.items()}

    @cached_property
    def _live(self) -> bool:
        return self._trials.live()

    def _records(self, places: Sequence[tuple[int, ...]]) -> Iterator[dict[str, Any]]:
        """The records of cells; settings that are not live are those of one loop as long as they stay."""
        jobs = [(self._grid.case(place), self._settings(place)) for place in places]
        for place, record in zip(places, self._trials.records(jobs, live=self._live), strict=True):
            value = math.inf if "skipped" in record else self._aim.value(record)
            yield {
                "controller": self._name,
                "cell": self._number(place),
                "outcome": record.get("outcome", "refused"),
                "value": value if math.isfinite(value) else None,
                "reason": (record.get("skipped") or record.get("stop") or "").partition(";")[0],
            }


# --- What is said of it --------------------------------------------------------------------------------------------------


def _view(result: Sweep) -> View:
    cells = math.prod(len(axis.values) for axis in result.axes)
    done, first, last = ("judged", "best", "worst") if result.aim.ranks else ("shown", "least", "largest")
    over = " and ".join(
        f"{axis.path} from {number(axis.values[0])} to {number(axis.values[-1])}{with_space(result.units.get(axis.path, '1'))} "
        f"in {len(axis.values)} values" + (" by equal factors" if axis.logarithmic else "")
        for axis in result.axes
    )
    conditions = (
        f"{cells} runs of a controller over {over}, with the noise of seed {result.seed}; {result.aim.name} is {done}. A run "
        f"fails if it ends early, diverges (an rms error above the reference's range) or is refused; {first} and {last} "
        "are of those that finished."
    )
    heads = [Column(head) for head in ("controller", "failed", first, "at", last)]
    table = Table(f"{result.problem}: over {' and '.join(axis.path for axis in result.axes)}", heads, conditions)
    for one in result.maps:
        table.add([one.controller, in_percent(one.failed), *_extremes(result, one)])
    reasons = [
        f"{one.controller}: {int((one.outcomes == kind).sum())} {kind}{f', such as: {why}' if why else ''}"
        for one in result.maps
        for kind, why in one.reasons.items()
    ]
    built = [
        f"{one.controller}: {', '.join(one.rebuilt)} cannot be live, so every value has a loop of its own"
        for one in result.maps
        if one.rebuilt
    ]
    lacking: dict[tuple[str, ...], list[str]] = {}
    for one in result.maps:
        lacking.setdefault(one.without, []).append(one.controller)
    same = [
        f"without {' and '.join(paths)}, and the same along {'it' if len(paths) == 1 else 'them'}: {listed(names)}"
        for paths, names in lacking.items()
        if paths
    ]
    apart = [f"{one.controller}: one run after the other, because {one.apart}" for one in result.maps if one.apart]
    lists = {"Why runs failed": reasons, "How it was run": [*built, *same, *apart]}
    return result.viewed(
        sentences=[(text, None) for text in _sentences(result)],
        conditions=conditions,
        tables=(table,),
        lists=lists,
        facts=_facts(result),
    )


def _extremes(result: Sweep, one: SweepMap) -> list[str]:
    """The best number, where it is, and the largest one of a run that finished."""
    if not np.isfinite(one.values).any():
        return ["none", "", ""]
    best = np.unravel_index(int(np.argmin(one.values)), one.values.shape)
    at = ", ".join(
        f"{axis.path} = {behind_equals(axis.values[k])}{with_space(result.units.get(axis.path, '1'))}"
        for axis, k in zip(result.axes, best, strict=True)
        if axis.path not in one.without
    )
    finished = one.values[one.outcomes == "finished"]
    largest = result.aim.text(float(finished.max())) if finished.size else "none"
    return [result.aim.text(float(one.values[best])), at, largest]


def _sentences(result: Sweep) -> Iterator[str]:
    """Who is best where, and who fails."""
    cells, places = result.winners.size, result.winners.ravel()
    if result.ranks:
        shares = sorted(((int((places == k).sum()), one.controller) for k, one in enumerate(result.maps)), reverse=True)
        best = ", ".join(f"{name} in {count}" for count, name in shares if count)
        yield f"{result.aim.subject[0].upper()}{result.aim.subject[1:]} is best with: {best or 'none alone'} of {cells} cells."
    failures = {one.controller: int((one.outcomes != "finished").sum()) for one in result.maps}
    for name, failed in failures.items():
        if failed:
            yield f"{name} fails in {failed} of {cells} cells."
    never = [name for name, failed in failures.items() if not failed]
    if len(never) == len(failures) > 1:
        yield "No controller fails anywhere."
    elif never:
        yield f"{listed(never)} {'fails' if len(never) == 1 else 'fail'} nowhere."


def _facts(result: Sweep) -> dict[str, Any]:
    return {
        "problem": result.problem,
        "title": result.title,
        "seed": result.seed,
        "figure": result.aim.name,
        "axes": [{"path": a.path, "values": list(a.values), "logarithmic": a.logarithmic} for a in result.axes],
        "maps": [
            {
                "controller": one.controller,
                "values": [result.aim.told(float(v)) for v in one.values.ravel()],
                "outcomes": [str(v) for v in one.outcomes.ravel()],
                "reasons": dict(one.reasons),
                "without": list(one.without),
                "rebuilt": list(one.rebuilt),
                "as it stands": dict(one.now),
            }
            for one in result.maps
        ],
        "order": "the last setting is the fastest",
        "sentences": list(_sentences(result)),
        "settings": result.settings,
        "versions": result.versions,
        "command": result.command,
    }
