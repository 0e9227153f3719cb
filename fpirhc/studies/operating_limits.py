"""How much each controller bears before it fails: mismatch, latency, noise, lost samples, a longer period, single parameters.

Every quantity grows from the problem as it stands, by factors of two, until a run fails; a bisection then finds the limit. All
values of a quantity run in one loop per controller, whose numbers are live; another period is another loop. Controllers know
nothing of what grows, except of the period.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fpirhc.controllers.contract import Controller, believing
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, nearest
from fpirhc.fields.checked import Checked, checked_call
from fpirhc.fields.kinds import AboveZero, Seed
from fpirhc.problem_files.problem_file import Task
from fpirhc.sensing.base import response_names
from fpirhc.sensing.sensing import Sensor
from fpirhc.simulation.metrics import measure
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.studies.comparison.compare import check_gains, select
from fpirhc.studies.scenarios.bench import Conditions, ranges, relative_error
from fpirhc.studies.scenarios.draws import COMPARING
from fpirhc.studies.scenarios.fingerprint import fingerprint
from fpirhc.studies.scenarios.ledger import kept_in
from fpirhc.studies.view import Progress, Study, View, circumstances, finite_alone
from fpirhc.summary import Column, Table, in_percent, in_units, line, number
from fpirhc.task.dead_time import MOST
from fpirhc.task.disturbance import Noise
from fpirhc.task.problem import Problem

if TYPE_CHECKING:
    import pandas as pd

LEDGER = "limits.jsonl"
FAILS = 0.5  # relative error from which a run has failed, where nothing else is said
_NEAR = 1.05  # between the value that fails and the one that holds
_HALVINGS = 14  # below the first value that is tried
_OUTSIDE = 0.02  # of a limit's width: a state farther outside has left it
_SAMPLES = 2000
# cycles of latency for which loops are built; C of the long queue takes longer to compile than to do without
_ROOMS = (128, 512)
_LOOPS = 20  # cycles that the longest period leaves to a run


@dataclass(frozen=True, eq=False)
class Quantity:
    """What grows.

    Args:
        name: of the quantity.
        unit: of its values; 'times': a factor.
        start: value of the problem as it stands.
        first: first value that is tried.
        most: largest one.
        at: the problem with a value.
        live: paths of the settings in which these problems differ, apart from exact parameters; None: each has a loop of its own.
        large: value from which a larger loop is needed, which is not compiled.
        whole: whether values are whole multiples of the first one.
    """

    name: str
    unit: str
    start: float
    first: float
    most: float
    at: Callable[[float], Problem]
    live: tuple[str, ...] | None = ()
    whole: bool = False
    large: float = math.inf

    def text(self, value: float) -> str:
        """Return a value with its unit."""
        return f"{number(value)} {self.unit}"


@dataclass(frozen=True)
class Point:
    """One run: the value, the relative error (infinite where the run ended early), and why it failed; '' where it did not."""

    value: float
    error: float
    why: str


@dataclass(frozen=True)
class PointFields(Checked):
    """The fields of the record of one run."""

    controller: str
    quantity: str
    value: float
    error: float | None
    why: str


@dataclass(frozen=True, eq=False)
class OperatingLimit:
    """The limit of one controller in one quantity."""

    controller: str  # its name
    quantity: Quantity  # what grew
    holds: float  # largest value below which no run failed; NaN where the problem as it stands fails
    fails: float  # smallest value at which one did; infinite where none did
    why: str  # what failed there
    points: tuple[Point, ...]  # all runs, in the order of their values

    @property
    def text(self) -> str:
        """The limit in a cell of a table, in the unit of the quantity."""
        if math.isnan(self.holds):
            return "as it stands"
        return number(self.fails) if math.isfinite(self.fails) else f"> {number(self.holds)}"


@dataclass(frozen=True, eq=False, kw_only=True)
class OperatingLimits(Study):
    """The result of `operating_limits`."""

    fails: float  # relative error from which a run has failed
    seed: int  # of noise and lost samples
    quantities: tuple[Quantity, ...]  # what grew
    limits: tuple[OperatingLimit, ...]  # one per controller and quantity that could be tried
    untried: Mapping[tuple[str, str], str]  # reasons why not, by controller and quantity

    def __repr__(self) -> str:
        return line(self, self.problem, *(f"{one.controller}: {one.quantity.name} {one.text}" for one in self.limits))

    def of(self, controller: str, quantity: str) -> OperatingLimit:
        """Return one limit."""
        result = {f"{one.controller}: {one.quantity.name}": one for one in self.limits}
        key = f"{controller}: {quantity}"
        if key not in result:
            why = self.untried.get((controller, quantity), "")
            raise InvalidName(f"no limit '{key}'{f' ({why})' if why else ''}.{nearest(key, result)}")
        return result[key]

    def to_dataframe(self) -> pd.DataFrame:
        """Return a row per controller and quantity: `controller`, `quantity`, `unit`, `holds`, `fails`, `why`."""
        import pandas as pd

        frame = pd.DataFrame(
            {"controller": one.controller, "quantity": one.quantity.name, "unit": one.quantity.unit}
            | {"holds": one.holds, "fails": one.fails, "why": one.why}
            for one in self.limits
        )
        return in_units(frame, {})  # every row has a unit of its own

    @property
    def view(self) -> View:
        """What every output says of it."""
        return _view(self)


@checked_call
def operating_limits(
    task: Task,
    *,
    over: Sequence[str] | None = None,
    controllers: Sequence[str] | None = None,
    fails: AboveZero = FAILS,
    seed: Seed = 0,
    compiled: bool = True,
    folder: Path | None = None,
    command: str = "",
    progress: Progress | None = None,
) -> OperatingLimits:
    """Return for every controller the mismatch, latency, noise, lost samples and period at which it fails, to 5 %.

    A run fails if it ends early, leaves a limit of a state by more than 2 % of its width, or has a relative error (rms over the
    range of the reference) above `fails`. The quantities are

        mismatch    f: exact = approximate (exact / approximate)^f of all parameters; 1 is the problem's own
        latency     commands arrive later by whole cycles
        noise       deviation of white noise on every measured quantity, as a share of its range along the reference
        lost        probability that a sample of a cycle is lost
        period      of the control cycle; stages of the horizon keep their length, as nearly as whole cycles allow
        NAME        factor f of one exact parameter: 'NAME up' multiplies by f, 'NAME down' divides

    Args:
        task: the loaded problem file.
        over: names of quantities; None: the first five. A parameter's name stands for both directions.
        controllers: names of controllers; None: all.
        fails: relative error from which a run has failed.
        seed: of noise and lost samples, the same in all runs.
        compiled: whether runs use compiled C.
        folder: to which finished runs are written; those that it holds are not repeated. None: nothing is kept.
        command: the command line, for the report.
        progress: function of (controller, quantities done, quantities in all).

    Raises:
        InvalidName: an unknown quantity.
        InvalidProblem: unknown controllers, gains of the wrong sign.
        InvalidValue: `fails` is not positive.
        OutputError: the folder cannot be written, or holds results under other conditions.
    """
    begin = time.perf_counter()
    chosen = select(task, controllers)
    check_gains(task, chosen)
    quantities, unfit = _quantities(task.problem, over)
    judge = Judge(task, fails, seed)
    limits, untried = [], {(name, what): why for name in chosen for what, why in unfit.items()}
    conditions = Conditions(seed, COMPARING, 0.0, compiled)
    path = None if folder is None else folder / LEDGER
    with kept_in(path, lambda: {**fingerprint(task, conditions), "fails": fails}, PointFields) as (records, keep):
        known = _Known(records, keep)
        for name, controller in chosen.items():
            loops = _Loops(judge, believing(task.problem, controller), compiled)
            for done, quantity in enumerate(quantities):
                if progress:
                    progress(name, done, len(quantities))
                try:
                    limits.append(_limit(name, quantity, loops, known))
                except FpirhcError as error:
                    untried[name, quantity.name] = str(error)
            if progress:
                progress(name, len(quantities), len(quantities))
    return OperatingLimits(
        fails=fails,
        seed=seed,
        quantities=quantities,
        limits=tuple(limits),
        untried=untried,
        **circumstances(task, chosen, command, begin),
    )


# --- The search ---------------------------------------------------------------------------------------------------------


class _Known:
    """Runs that a ledger holds, and what it is told of new ones."""

    def __init__(self, records: Sequence[Mapping[str, Any]], keep: Callable[[Mapping[str, Any]], None]) -> None:
        self._keep, self._points = keep, {}
        for one in records:
            error = math.inf if one["error"] is None else one["error"]
            self._points[one["controller"], one["quantity"], one["value"]] = Point(one["value"], error, one["why"])

    def point(self, name: str, quantity: Quantity, value: float, run: Callable[[], Point]) -> Point:
        """Return the run with a value."""
        key = name, quantity.name, value
        if key not in self._points:
            one = self._points[key] = run()
            error = finite_alone(one.error)
            self._keep({"controller": name, "quantity": quantity.name, "value": value, "error": error, "why": one.why})
        return self._points[key]


def _limit(name: str, quantity: Quantity, loops: _Loops, known: _Known) -> OperatingLimit:
    start = quantity.start
    points = {start: known.point(name, quantity, start, lambda: loops.point(quantity, start))}

    def failed(value: float) -> bool:
        if value not in points:
            points[value] = known.point(name, quantity, value, lambda: _tried(quantity, value, loops))
        return bool(points[value].why)

    holds, fails = (math.nan, quantity.start) if failed(quantity.start) else _bracket_of(quantity, failed)
    why = points[fails].why if fails in points else ""
    return OperatingLimit(name, quantity, holds, fails, why, tuple(points[v] for v in sorted(points)))


def _tried(quantity: Quantity, value: float, loops: _Loops) -> Point:
    """The run with a value. A loop that is refused there has failed, unless it is refused as soon as the quantity grows."""
    try:
        return loops.point(quantity, value)
    except FpirhcError as error:
        if value <= quantity.first:
            raise
        return Point(value, math.inf, str(error).partition(";")[0])


def _bracket_of(quantity: Quantity, failed: Callable[[float], bool]) -> tuple[float, float]:
    step = quantity.first if quantity.whole else 0.0
    return bracket(failed, quantity.start, quantity.first, quantity.most, step=step)


def bracket(
    failed: Callable[[float], bool], start: float, first: float, most: float, *, step: float = 0.0, near: float = _NEAR
) -> tuple[float, float]:
    """Return the largest value that holds and the smallest one that fails, by doubling and halving; infinity where none fails.

    `failed`: whether a value fails; the start does not. `step`: of which all values are multiples; 0: they are any.
    """
    holds, fails = start, min(first, most)
    while not failed(fails):
        if fails >= most:
            return fails, math.inf
        holds, fails = fails, min(2 * fails, most)
    for _ in range(_HALVINGS):
        if fails <= near * holds or fails - holds < 1.5 * step:
            break
        middle = math.sqrt(holds * fails) if holds > 0 else fails / 2
        if step:
            middle = step * round((holds + fails) / 2 / step)
        holds, fails = (holds, middle) if failed(middle) else (middle, fails)
    return holds, fails


class Judge:
    """What a run of the task is worth."""

    def __init__(self, task: Task, fails: float, seed: int) -> None:
        self.task, self.fails, self.seed, self._ranges = task, fails, seed, ranges(task.problem)

    def point(self, value: float, problem: Problem, run: Run) -> Point:
        """Return a run with its error and why it failed."""
        error = relative_error(measure(problem, run, self.task.metrics), self._ranges)
        return Point(value, error, self._why(problem, run, error))

    def _why(self, problem: Problem, run: Run, error: float) -> str:
        if run.stop is not None:
            return run.stop.partition(";")[0]
        left = _left(problem, run)
        if left:
            return left
        return f"error of {in_percent(error)}" if not error <= self.fails else ""


def _left(problem: Problem, run: Run) -> str:
    """Which limit of a state is left; '' for none."""
    signal = "plant_state" if "plant_state" in run.layout else "state"
    begin = min(round(problem.measure_from / problem.period), max(run.cycles - 1, 0))
    for name, (lower, upper) in problem.limits.states.items():
        values = run[f"{signal}.{name}"][begin:]
        width = upper - lower if math.isfinite(upper - lower) else abs(upper if math.isfinite(upper) else lower)
        width = width or float(np.abs(values).max())  # the only limit is zero
        if values.min() < lower - _OUTSIDE * width or values.max() > upper + _OUTSIDE * width:
            return f"{name} leaves its limits"
    return ""


class _Loops:
    """The loops of one controller: one for all values of a quantity, and one for the problem as it stands."""

    def __init__(self, judge: Judge, controller: Controller, compiled: bool) -> None:
        self._judge, self._controller, self._compiled = judge, controller, compiled
        self._own: dict[tuple[tuple[str, ...], bool], Simulator] = {}
        self._start: Point | None = None

    def point(self, quantity: Quantity, value: float) -> Point:
        """Return the run with a value of a quantity."""
        if value == quantity.start:
            if self._start is None:
                self._start = self._run(self._shared(self._judge.task.problem, ()), self._judge.task.problem, value)
            return replace(self._start, value=value)
        problem = quantity.at(value)
        if quantity.live is None:
            return self._run(simulator(problem, self._controller, compiled=None), problem, value)
        return self._run(self._shared(problem, quantity.live, large=value > quantity.large), problem, value)

    def _shared(self, problem: Problem, live: tuple[str, ...], *, large: bool = False) -> Simulator:
        key = live, large
        if key not in self._own or self._own[key].remembers:
            self._own[key] = simulator(problem, self._controller, compiled=self._compiled and not large, live=live)
        return self._own[key]

    def _run(self, loop: Simulator, problem: Problem, value: float) -> Point:
        return self._judge.point(value, problem, loop.run(seed=self._judge.seed, variant=problem))


# --- The quantities -----------------------------------------------------------------------------------------------------


def _quantities(problem: Problem, over: Sequence[str] | None) -> tuple[tuple[Quantity, ...], dict[str, str]]:
    """The wanted quantities, and why others are none here."""
    parameters = problem.moved.parameters
    valid = [*_MAKERS, *parameters]
    quantities: list[Quantity] = []
    unfit = {}
    for name in over or tuple(_MAKERS):
        if name not in valid:
            raise InvalidName(f"quantity '{name}' is unknown.{nearest(name, valid)}")
        try:
            quantities += [_MAKERS[name](problem)] if name in _MAKERS else _of_parameter(problem, name)
        except FpirhcError as error:
            unfit[name] = str(error)
    return tuple(quantities), unfit


def _mismatch(problem: Problem) -> Quantity:
    parameters = problem.moved.parameters
    known = {n: one.approximate for n, one in problem.plant.parameters.items()}
    exact = np.array([one.exact for one in parameters.values()], dtype=float)
    model = np.array([known.get(n, one.exact) for n, one in parameters.items()], dtype=float)
    if np.array_equal(exact, model):
        raise InvalidValue(f"the model is right; name a parameter, such as {next(iter(parameters), 'none')}")
    scaled = exact * model > 0
    ratios = np.log(np.where(scaled, exact, 1.0) / np.where(scaled, model, 1.0))

    def at(share: float) -> Problem:
        return problem.with_exact(np.where(scaled, model * np.exp(share * ratios), model + share * (exact - model)))

    return _bounded(Quantity("mismatch", "times", 1.0, 2.0, 64.0, at))


def _of_parameter(problem: Problem, name: str) -> Iterator[Quantity]:
    parameters = problem.moved.parameters
    exact = np.array([one.exact for one in parameters.values()], dtype=float)
    place = list(parameters).index(name)
    if exact[place] == 0:
        raise InvalidValue(f"'{name}' is zero: a factor does not change it")

    def changed(factor: float) -> Problem:
        values = exact.copy()
        values[place] *= factor
        return problem.with_exact(values)

    yield _bounded(Quantity(f"{name} up", "times", 1.0, 2.0, 1024.0, changed))
    yield _bounded(Quantity(f"{name} down", "times", 1.0, 2.0, 1024.0, lambda factor: changed(1 / factor)))


def _bounded(quantity: Quantity) -> Quantity:
    """The quantity as far as its problems exist: parameters have bounds, and a response an inverse."""

    def exists(value: float) -> bool:
        try:
            quantity.at(value)
        except FpirhcError:
            return False
        return True

    if exists(quantity.most):
        return quantity
    low, high = quantity.start, quantity.most
    while high > 1.01 * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if exists(middle) else (low, middle)
    return replace(quantity, most=low)


def _latency(problem: Problem) -> Quantity:
    late, period = problem.dead_time, problem.period
    known = {name: late.inputs.get(name, 0.0) for name in problem.plant.inputs}
    most = min(MOST - math.ceil(max(known.values()) / period), max(problem.cycles // 4, 1))
    small, large = (period * min(cycles, most) for cycles in _ROOMS)

    def at(value: float) -> Problem:
        room = small if value <= small else large
        longest = {**late.longest, **{name: time + room for name, time in known.items()}}
        inputs = {name: time + value for name, time in known.items()}
        return replace(problem, dead_time=replace(late, inputs=inputs, longest=longest))

    live = tuple(f"dead_time.inputs.{name}" for name in known)
    return Quantity("latency", problem.time_unit, 0.0, period, large, at, live, whole=True, large=small)


def _noise(problem: Problem) -> Quantity:
    sizes = {name: size for name, size in _sizes(problem).items() if size > 0}
    sensors = problem.sensing.sensors

    def at(value: float) -> Problem:
        noisy = {n: replace(sensors.get(n, Sensor()), noise=Noise(value * size)) for n, size in sizes.items()}
        return replace(problem, sensing=replace(problem.sensing, sensors={**sensors, **noisy}))

    live = tuple(f"sensing.sensors.{name}.noise.deviation" for name in sizes)
    return Quantity("noise", "of the range", 0.0, 1e-3, 4.096, at, live)


def _sizes(problem: Problem) -> dict[str, float]:
    """Range along the reference of every measured quantity that it tells."""
    plant, times = problem.plant, np.linspace(0.0, problem.duration, _SAMPLES)
    states, highest = problem.reference.function(plant).map(_SAMPLES)(times[None, :])
    names = [*plant.output.elements, *response_names(plant)]
    series = np.vstack([np.asarray(states.full()), np.asarray(highest.full())])
    measured = problem.sensing.measures(plant)
    return {n: float(np.ptp(row)) for n, row in zip(names, series, strict=False) if n in measured}


def _lost(problem: Problem) -> Quantity:
    sensors, measured = problem.sensing.sensors, problem.sensing.measures(problem.plant)

    def at(value: float) -> Problem:
        lossy = {n: replace(sensors.get(n, Sensor()), dropout=value) for n in measured}
        return replace(problem, sensing=replace(problem.sensing, sensors=lossy))

    live = tuple(f"sensing.sensors.{name}.dropout" for name in measured)
    return Quantity("lost", "of the samples", 0.0, 0.02, 0.98, at, live)


def _period(problem: Problem) -> Quantity:
    def at(value: float) -> Problem:
        horizon = problem.horizon
        if horizon is not None:
            horizon = replace(horizon, step=value * max(1, round(horizon.step / value)))
        return replace(problem, period=value, duration=value * math.ceil(problem.duration / value), horizon=horizon)

    return Quantity(
        "period", problem.time_unit, problem.period, 2 * problem.period, problem.duration / _LOOPS, at, None
    )


_MAKERS: dict[str, Callable[[Problem], Quantity]] = {
    "mismatch": _mismatch,
    "latency": _latency,
    "noise": _noise,
    "lost": _lost,
    "period": _period,
}


# --- What is said of it -------------------------------------------------------------------------------------------------


def _view(result: OperatingLimits) -> View:
    conditions = (
        f"A run fails if it ends early, leaves a limit of a state, or has an rms error above {in_percent(result.fails)} of the "
        "reference's range. Controllers do not know of what grows, except of the period. Cells are the smallest value that "
        "fails; 5 % below, or one cycle below a latency, the run holds."
    )
    heads = [Column("controller"), *(Column(f"{q.name} [{q.unit}]") for q in result.quantities)]
    cells = {(one.controller, one.quantity.name): one for one in result.limits}
    controllers = dict.fromkeys(one.controller for one in result.limits)
    table = Table(f"{result.problem}: where controllers fail", heads, conditions)
    for name in controllers:
        row = [cells.get((name, q.name)) for q in result.quantities]
        table.add([name, *("not tried" if one is None else one.text for one in row)])
    reasons = [
        f"{one.controller}, {one.quantity.name}: {one.why}"
        for one in result.limits
        if one.why and not one.why.startswith("error of")
    ]
    untried: dict[str, list[str]] = {}
    for (name, what), why in result.untried.items():
        untried.setdefault(f"{what}: {why}", []).append(name)
    everyone = {name for name, _ in result.untried} | set(controllers)
    lacking = [text if set(names) == everyone else f"{', '.join(names)}, {text}" for text, names in untried.items()]
    return result.viewed(
        sentences=[(text, None) for text in _sentences(result)],
        conditions=conditions,
        tables=(table,),
        lists={"What failed": reasons, "Not tried": lacking},
        facts=_facts(result),
    )


def _sentences(result: OperatingLimits) -> Iterator[str]:
    """Who bears most of each quantity, and who least."""
    for quantity in result.quantities:
        rows = [one for one in result.limits if one.quantity.name == quantity.name]
        if not rows:
            continue

        def bears(one: OperatingLimit) -> float:
            return -1.0 if math.isnan(one.holds) else one.fails

        low, high = min(rows, key=bears), max(rows, key=bears)
        if len(rows) == 1 or bears(low) == bears(high):
            who = rows[0].controller if len(rows) == 1 else "every controller"
            yield f"{quantity.name}: {who} {_said(high)}."
        else:
            yield f"{quantity.name}: {high.controller} {_said(high)}; {low.controller} {_said(low)}."


def _said(one: OperatingLimit) -> str:
    if math.isnan(one.holds):
        return f"fails as the problem stands ({one.why})"
    if math.isinf(one.fails):
        return f"holds up to {one.quantity.text(one.holds)}, the largest value that was tried"
    return f"fails at {one.quantity.text(one.fails)}"


def _facts(result: OperatingLimits) -> dict[str, Any]:
    return {
        "problem": result.problem,
        "fails": result.fails,
        "seed": result.seed,
        "versions": result.versions,
        "limits": [
            {
                "controller": one.controller,
                "quantity": one.quantity.name,
                "unit": one.quantity.unit,
                "holds": one.holds,
                "fails": one.fails,
                "why": one.why,
                "runs": [[p.value, p.error, p.why] for p in one.points],
            }
            for one in result.limits
        ],
        "untried": [{"controller": c, "quantity": q, "why": why} for (c, q), why in result.untried.items()],
    }
