"""Many plants in one compiled loop: the scalar code of the closed loop on vector registers, one plant in each lane.

Theory: docs/theory-plants.md, "Many plants side by side".
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import CompileError, InvalidShape, InvalidValue, NoCode
from fpirhc.plant.motion import followed_units
from fpirhc.plant.parameter import Parameter
from fpirhc.simulation.metrics import known_metrics
from fpirhc.simulation.metrics.base import Metric, first_measured, measured_errors
from fpirhc.simulation.opencl import loaded_kernel
from fpirhc.simulation.run import Run
from fpirhc.simulation.sums import Sums, Values
from fpirhc.simulation.tables import run_tables
from fpirhc.status import Status
from fpirhc.summary import in_units
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.dataflow import DEVICE, SIDE_BY_SIDE, Callee, Words
from fpirhc.symbolic.driver import SIGNATURE, driver_of, entry_of, is_driver
from fpirhc.symbolic.evaluate import Evaluator, Latest
from fpirhc.symbolic.flat_code import FlatCode
from fpirhc.symbolic.native import find_compiler, shared_library
from fpirhc.task.problem import Problem

if TYPE_CHECKING:
    import pandas as pd

_ASKED = 2  # runs after which it is known what depends on the exact parameters
_GROUPS, _ITEMS = 256, 65_536  # of lanes in one call, and of a device
Columns: TypeAlias = float | Sequence[float] | np.ndarray
_ROOM = 2**27  # bytes of tables and of what is kept, beyond which runs take turns


class _Ready(Protocol):
    """What lanes ask a `Simulator`, which has them."""

    @property
    def problem(self) -> Problem: ...
    @property
    def loop(self) -> Composite: ...
    @property
    def evaluator(self) -> Evaluator: ...
    def first_memory(
        self, variant: Problem | None = None, settings: Mapping[str, float] | None = None
    ) -> tuple[Problem, np.ndarray]: ...
    def starting_at(self, start: Mapping[str, float]) -> _Ready: ...
    def run(self, *, seed: int, variant: Problem | None = None, settings: Mapping[str, float] | None = None) -> Run: ...


@dataclass(frozen=True, eq=False)
class ManyRuns:
    """Errors of many scenarios."""

    # by coordinate, shape (plants,), in its unit; NaN where a run ended before `measure_from`
    rms_error: Mapping[str, np.ndarray]
    max_error: Mapping[str, np.ndarray]  # the same, largest sizes
    statuses: Mapping[str, np.ndarray]  # cycles with each status that occurred, by its name, shape (plants,)
    stops: Mapping[int, str]  # why the runs of some plants ended early, by number of the plant
    # scenarios that ran side by side in one register, or work item of a device; 0: one after the other by the ordinary loop
    lanes: int
    why: str  # no lanes; empty where there are some
    units: Mapping[str, str]  # of the coordinates

    def to_dataframe(self) -> pd.DataFrame:
        """Return a row per scenario: `rms_error.q1`, `max_error.q1`, `status.OK` and so on, and `stop`, why a run ended early.

        `attrs["units"]` has units by column.
        """
        import pandas as pd

        groups = {"rms_error": self.rms_error, "max_error": self.max_error, "status": self.statuses}
        frame = pd.DataFrame({f"{name}.{one}": column for name, some in groups.items() for one, column in some.items()})
        frame = frame.assign(stop=frame.index.map(self.stops.get))
        return in_units(frame, {f"{name}.{one}": unit for name in groups for one, unit in self.units.items()})


def run_many(
    ready: _Ready,
    exact: np.ndarray | None = None,
    *,
    settings: Mapping[str, Columns] | None = None,
    starts: Mapping[str, Columns] | None = None,
    seed: int | Sequence[int] | np.ndarray = 0,
    device: str | None = None,
) -> ManyRuns:
    """See `Simulator.run_many`."""
    rows = _Rows.of(ready.problem, exact, settings or {}, starts or {}, seed)
    judged, count = ready.loop.trace["error"].elements, len(rows.exact)
    lanes = _LANES.of((ready,), (device,), lambda: Lanes(ready, _errors_alone(), device))
    rms, largest = (np.full((count, len(judged)), np.nan) for _ in range(2))
    counts, left = np.zeros((count, len(Status)), dtype=int), np.ones(count, dtype=bool)
    scenarios = _Scenarios(ready, rows)
    if not lanes.why and count and (settings or starts or np.ndim(seed)):
        for k, values in lanes.of_scenarios(scenarios).items():
            rms[k], largest[k] = ([values[m][n] for n in judged] for m in ("rms_error", "max_error"))
            counts[k] = [values["status"].get(one.name, 0) for one in Status]
            left[k] = False
    elif not lanes.why and count:
        columns, left = lanes.of_parameters(rows.exact, int(rows.seeds[0]))
        rms, largest = (np.column_stack([columns[m][n] for n in judged]) for m in ("rms_error", "max_error"))
        counts = np.column_stack([np.ma.filled(columns["status"][one.name], 0) for one in Status])
    stops = {}
    for number in map(int, np.flatnonzero(left)):
        own, variant, noise, numbers = scenarios[number]
        run = own.run(seed=noise, variant=variant, settings=numbers)
        errors = measured_errors(variant, run)
        rms[number], largest[number] = np.sqrt(np.mean(errors**2, axis=0)), np.max(np.abs(errors), axis=0)
        counts[number] = np.bincount(run["status"].ravel().astype(int), minlength=len(Status))
        if run.stop is not None:
            stops[number] = run.stop
    by_name = (dict(zip(judged, columns.T.copy(), strict=True)) for columns in (rms, largest))
    statuses = {one.name: counts[:, one].copy() for one in Status if counts[:, one].any()}
    units = followed_units(ready.problem.plant)
    return ManyRuns(
        next(by_name), next(by_name), statuses, stops, lanes.width, lanes.why, {name: units[name] for name in judged}
    )


@dataclass(frozen=True, eq=False)
class _Rows:
    """In what scenarios differ."""

    exact: np.ndarray  # shape (scenarios, parameters)
    settings: Mapping[str, np.ndarray]  # numbers by path, shape (scenarios,)
    starts: Mapping[str, np.ndarray]  # first values by state, shape (scenarios,)
    seeds: np.ndarray  # of the noise, shape (scenarios,)

    @classmethod
    def of(
        cls,
        problem: Problem,
        exact: np.ndarray | None,
        settings: Mapping[str, Columns],
        starts: Mapping[str, Columns],
        seed: int | Sequence[int] | np.ndarray,
    ) -> _Rows:
        """Return what was given, with a row for every scenario."""
        plants = np.atleast_2d(np.asarray(problem.real_parameters if exact is None else exact, dtype=float))
        _check_parameters(problem.moved.parameters, plants)
        named = [{n: np.atleast_1d(np.asarray(v, dtype=float)) for n, v in some.items()} for some in (settings, starts)]
        seeds = np.atleast_1d(np.asarray(seed))
        if seeds.ndim != 1 or seeds.dtype.kind not in "iu" or (seeds < 0).any():
            raise InvalidValue(
                f"run_many(seed={seed!r}): expected a whole number of at least 0, or one for every scenario"
            )
        sizes = {
            "exact": len(plants),
            "seed": seeds.size,
            **{f"'{n}'": v.size for some in named for n, v in some.items()},
        }
        several = {name: size for name, size in sizes.items() if size != 1}
        if len({*several.values()}) > 1 or any(v.ndim != 1 for some in named for v in some.values()):
            lengths = ", ".join(f"{size} for {name}" for name, size in several.items())
            raise InvalidShape(
                f"run_many({lengths}): expected a number for every scenario, as many everywhere, or one for all"
            )
        count = next(iter(several.values()), 1)
        for some in named:
            for name, values in some.items():
                if not np.isfinite(values).all():
                    number = int(np.argmin(np.isfinite(values)))
                    raise InvalidValue(
                        f"run_many: scenario {number}: '{name}' is {values[number]:g}, which is not finite"
                    )
        whole = [{name: np.broadcast_to(values, count) for name, values in some.items()} for some in named]
        return cls(np.broadcast_to(plants, (count, plants.shape[1])), whole[0], whole[1], np.broadcast_to(seeds, count))


class _Scenarios:
    """The loop, the problem, the seed and the live settings of every scenario, by number."""

    def __init__(self, ready: _Ready, rows: _Rows) -> None:
        self._ready, self._rows = ready, rows
        self._begun: dict[tuple[float, ...], _Ready] = {}

    def __len__(self) -> int:
        return len(self._rows.exact)

    def __getitem__(self, number: int) -> tuple[_Ready, Problem, int, dict[str, float] | None]:
        exact, settings, starts = self._rows.exact, self._rows.settings, self._rows.starts
        begin = {name: float(values[number]) for name, values in starts.items()}
        key = tuple(begin.values())
        if key not in self._begun:
            self._begun[key] = self._ready.starting_at(begin) if begin else self._ready
        own = self._begun[key]
        changed = not np.array_equal(exact[number], own.problem.real_parameters)
        problem = own.problem.with_exact(exact[number]) if changed else own.problem
        numbers = {path: float(values[number]) for path, values in settings.items()} or None
        return own, problem, int(self._rows.seeds[number]), numbers


def _check_parameters(parameters: Mapping[str, Parameter], exact: np.ndarray) -> None:
    """Raise where rows are not those of plants."""
    if exact.ndim != 2 or exact.shape[1] != len(parameters):
        raise InvalidShape(
            f"run_many(exact of shape {exact.shape}): expected one row per plant with {', '.join(parameters)}"
        )
    for (name, one), column in zip(parameters.items(), exact.T, strict=True):
        low, high = one.bounds
        for wrong, what in (
            (~np.isfinite(column), "not finite"),
            ((column < low) | (column > high), f"outside {low:g} to {high:g}"),
        ):
            if wrong.any():
                number = int(np.argmax(wrong))
                raise InvalidValue(
                    f"run_many: plant {number}: '{name}' is {column[number]:g}, which is {what} {one.unit}"
                )


def _errors_alone() -> tuple[Metric, ...]:
    return tuple(m for m in known_metrics() if m.name in ("rms_error", "max_error", "status"))


@dataclass(frozen=True, eq=False)
class OneRun:
    """One of several runs of a loop."""

    problem: Problem  # the problem of the loop with the numbers of the run
    memory: np.ndarray  # first one of the loop, see `Simulator.first_memory`
    begun: np.ndarray | None  # first sums; None where nobody knows them before the run
    seed: int  # of the noise

    def beginning(self, own: slice) -> tuple[bytes, bytes | None]:
        """All with which it begins, but for these places of the memory."""
        rest = np.delete(self.memory, own)
        return rest.tobytes(), None if self.begun is None else self.begun.tobytes()


class Lanes:
    """The runs of one loop side by side, measured without logs.

    Args:
        ready: the loop.
        metrics: to measure.
        device: as in `run_many`.
        why: somebody else knows why there are none.

    Attributes:
        why: there are no lanes, because of this; empty where there are some.

    Raises:
        InvalidName, NotInstalled: no such device.
    """

    def __init__(self, ready: _Ready, metrics: Sequence[Metric], device: str | None = None, *, why: str = "") -> None:
        self._ready, self.why = ready, why or _why_no_lanes(ready, device)
        self._first: list[OneRun] = []
        self._alike = False
        if not self.why:
            try:
                self._sums = Sums(ready.loop.trace, tuple(metrics), ready.problem)
                self._library = _built(ready, self._sums, device)
            except (CompileError, NoCode) as error:
                self.why = str(error)

    @property
    def width(self) -> int:
        """Runs in one register; 0 without lanes."""
        return 0 if self.why else self._library.lanes

    def one_run(
        self,
        ready: _Ready,
        problem: Problem,
        seed: int,
        settings: Mapping[str, float] | None = None,
        *,
        exact_alone: bool = False,
    ) -> OneRun:
        """Return a run; `ready` is the loop, or one with the same code, and the rest as in `Simulator.run`.

        Where all such calls differ in their `exact_alone`, that with which the first two begin alike is not computed again.
        """
        own = self._ready.loop.memory.slice("_exact")
        if exact_alone and self._alike:
            memory = self._first[0].memory.copy()
            memory[own] = problem.real_parameters
            return OneRun(problem, memory, self._first[0].begun, seed)
        problem, memory = ready.first_memory(problem, settings)
        run = OneRun(problem, memory, self._start_of(problem), seed)
        if exact_alone and len(self._first) < _ASKED:
            self._first.append(run)
            self._alike = len(self._first) == _ASKED and len({one.beginning(own) for one in self._first}) == 1
        return run

    def values(self, runs: Sequence[OneRun]) -> list[Values | None]:
        """Return the metrics of some runs; None for one that the ordinary loop has to run: it ends early, or nothing is summed up.

        Every run has its own noise, that which the ordinary loop draws for its seed. Runs of one call have one duration and one
        first measured cycle.
        """
        places = [k for k, one in enumerate(runs) if one.begun is not None]
        first, kept = runs[0].problem, self._sums.kept.size
        size = sum(table.shape[1] for table in run_tables(first, runs[0].seed, 1)) + kept
        most = max(self._library.lanes, _ROOM // (8 * first.cycles * max(size, 1)))
        result: list[Values | None] = [None] * len(runs)
        for at in range(0, len(places), most):
            now = places[at : at + most]
            some = [runs[k] for k in now]
            begun = np.array([one.begun for one in some])
            reads = np.array([_tables(one.problem, one.seed) for one in some])
            memories = np.array([one.memory for one in some])
            sums, bad, log = self._library.results(first, memories, begun, reads, kept)
            found = self._sums.values([one.problem for one in some], [one.seed for one in some], sums, log)
            for k, ended, value in zip(now, bad, found, strict=True):
                result[k] = None if ended else value
        return result

    def _start_of(self, problem: Problem) -> np.ndarray | None:
        """The first sums of a run; None where the problem does not say before a run what they need."""
        try:
            return self._sums.start(problem)
        except NoCode:
            return None

    def of_parameters(self, exact: np.ndarray, seed: int) -> tuple[dict[str, Mapping[str, np.ndarray]], np.ndarray]:
        """Return the metrics of plants with one noise, by name and element, and which ones the ordinary loop has to run.

        Args:
            exact: parameters, shape (plants, parameters).
            seed: of the noise.
        """
        ready = self._ready
        memories, reads = _starts(ready, exact), _tables(ready.problem, seed)
        begun = np.broadcast_to(self._begun, (len(exact), self._sums.size))
        sums, bad, _ = self._library.results(ready.problem, memories, begun, reads, 0)
        columns, outside = self._sums.columns(ready.problem, sums)
        return columns, bad | outside

    def of_scenarios(self, scenarios: _Scenarios) -> dict[int, Values]:
        """Return the metrics of scenarios by number, but for those that the ordinary loop has to run."""
        several = enumerate(scenarios[k] for k in range(len(scenarios)))
        runs = {
            number: self.one_run(own, problem, noise, numbers)
            for number, (own, problem, noise, numbers) in several
            if own.evaluator is self._ready.evaluator
        }
        measured = zip(runs, self.values(list(runs.values())) if runs else (), strict=True)
        return {number: values for number, values in measured if values is not None}

    @cached_property
    def _begun(self) -> np.ndarray:
        return self._sums.start(self._ready.problem)


_LANES: Latest[Lanes] = Latest(4)


def _tables(problem: Problem, seed: int) -> np.ndarray:
    """What the cycles read, shape (cycles, entries)."""
    return np.hstack([*run_tables(problem, seed, problem.cycles), np.empty((problem.cycles, 0))])


def _why_no_lanes(ready: _Ready, device: str | None) -> str:
    if not ready.problem.equations_known:
        return "a plant outside is run one after the other"
    if ready.problem.cycles <= first_measured(ready.problem):
        return "no cycle is measured"
    return "" if device is not None or find_compiler() else "there is no C compiler"


@dataclass(frozen=True, eq=False)
class _Library:
    """The compiled loop over lanes."""

    # function of (groups, cycles, first that is measured, whether tables are of lanes, first memories, first sums, tables,
    # results, what is kept)
    run: Callable[..., int]
    lanes: int  # plants of a group
    batch: int  # groups of a call
    threads: int  # calls at a time

    def results(
        self, problem: Problem, memories: np.ndarray, begun: np.ndarray, reads: np.ndarray, kept: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the last sums, which runs ended, and what was kept, shape (runs, cycles, kept).

        Args:
            memories: first ones, shape (runs, memory).
            begun: first sums, shape (runs, sums).
            reads: what cycles read, shape (cycles, entries), or (runs, cycles, entries).
        """
        count, cycles, own = len(memories), problem.cycles, reads.ndim > 2
        groups = -(-count // self.lanes)
        batch = min(self.batch, max(1, -(-groups // self.threads)))
        starts, sums = self._side_by_side(memories), self._side_by_side(begun)
        tables = self._side_by_side(reads) if own else np.ascontiguousarray(reads)
        results = np.empty((groups, begun.shape[1] + 1, self.lanes))
        log = np.empty((groups, cycles, kept, self.lanes))

        def call(at: int) -> None:
            some = slice(at, min(at + batch, groups))
            given = starts[some], sums[some], tables[some] if own else tables
            numbers = some.stop - at, cycles, first_measured(problem), int(own)
            if not self.run(*numbers, *given, results[some], log[some]):
                raise MemoryError

        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(call, range(0, groups, batch)))
        rows = results.transpose(0, 2, 1).reshape(groups * self.lanes, -1)[:count]
        logs = np.moveaxis(log, -1, 1).reshape(groups * self.lanes, cycles, kept)[:count]
        return rows[:, :-1], rows[:, -1] != 0, logs

    def _side_by_side(self, rows: np.ndarray) -> np.ndarray:
        """Numbers of runs, those of a group next to each other; the last run fills the last group."""
        groups = -(-len(rows) // self.lanes)
        padded = rows[np.minimum(np.arange(groups * self.lanes), len(rows) - 1)]
        return np.ascontiguousarray(np.moveaxis(padded.reshape(groups, self.lanes, *rows.shape[1:]), 1, -1))


def _starts(ready: _Ready, exact: np.ndarray) -> np.ndarray:
    """First memories (plants, memory): one and the same but for the parameters, unless the start depends on these."""
    place = ready.loop.memory.slice("_exact")
    # The first plant, and for every parameter the one that differs most in it.
    asked = dict.fromkeys([0, *map(int, np.abs(exact - exact[0]).argmax(axis=0))])
    first, *others = (ready.first_memory(ready.problem.with_exact(exact[k]))[1] for k in asked)
    rest = np.delete(np.arange(len(first)), np.arange(place.start, place.stop))
    if all(np.array_equal(first[rest], one[rest]) for one in others):
        starts = np.tile(first, (len(exact), 1))
        starts[:, place] = exact
        return starts
    return np.array([ready.first_memory(ready.problem.with_exact(one))[1] for one in exact])


def _built(ready: _Ready, sums: Sums, device: str | None) -> _Library:
    """Compile the loop."""
    functions = ready.loop.function, sums.function()
    if device is not None:
        (text, *drivers), callees = written_for_devices(*functions)
        source = "".join((text, _around(ready, sums, *callees), *drivers))
        return _Library(loaded_kernel(source, device).run, 1, _ITEMS, 1)
    (text, *drivers), callees = written_in_lanes(*functions)
    library, lanes = lanes_library((text + _around(ready, sums, *callees), *drivers))
    run = library.run_lanes
    run.argtypes, run.restype = [ctypes.c_long] * 4 + [np.ctypeslib.ndpointer(float)] * 5, ctypes.c_int
    return _Library(run, lanes, _GROUPS, _cores())


def _cores() -> int:
    """Cores that this process may use, which are fewer than there are in a container or a job of a cluster."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _around(ready: _Ready, sums: Sums, step: Callee, summing: Callee) -> str:
    """The text of a run, behind that of a cycle."""
    loop = ready.loop
    before = np.cumsum([0, *(loop.function.numel_in(k) for k in range(1, loop.function.n_in()))])
    defined = {
        "STEP": step.name, "SUM": summing.name, "ROOM": max(step.room, summing.room), "MEMORY": loop.memory.size,
        "TRACE": loop.trace.size, "READS": before[-1], "TABLES": ", ".join(f"now + {at}" for at in before[:-1]),
        "SUMS": sums.size, "KEPT": sums.kept.size,
    }  # fmt: skip
    head = "".join(f"#define {name} {value}\n" for name, value in defined.items())
    return head + resources.files("fpirhc.simulation").joinpath("lanes.c").read_text(encoding="utf-8")


_TABLE = re.compile(r"\bflat_table_\d+\b")
_KNOWN = {*SIDE_BY_SIDE.operations, ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST}


def written_in_lanes(*functions: ca.Function) -> tuple[tuple[str, ...], list[Callee]]:
    """Return the C files of Functions, in which LANES is to be defined, and how they are called in the first one.

    The others are the loops of optimisers. Every argument and result needs an address.
    """
    own = _File(SIDE_BY_SIDE)
    inner = [own.flat.callee(function, always=True) for function in functions]
    files = [(name, _File(SIDE_BY_SIDE)) for name in own.drivers]
    drivers = [(file.driver(name), file) for name, file in files]
    return (own.text(), *(file.text() + text for text, file in drivers)), inner


def written_for_devices(*functions: ca.Function) -> tuple[tuple[str, ...], list[Callee]]:
    """Return Functions as pieces of one file of OpenCL C, and how they are called.

    The pieces behind the first one are the loops of optimisers, and come last: their sizes are defined by short names.
    """
    own = _File(DEVICE)
    inner = [own.flat.callee(function, always=True) for function in functions]
    drivers = [own.driver(name) for name in tuple(own.drivers)]
    if sum(bool(driver_of(name).leaves) for name in own.drivers) > 1:
        raise NoCode("the loop has several optimisers, whose loops are not written for devices together")
    return (own.text(), *drivers), inner


def lanes_library(sources: Sequence[str]) -> tuple[ctypes.CDLL, int]:
    """Compile C files for the widest registers of this machine; return the library and how many lanes it has.

    It has the vector library of the system where that can be linked.
    """
    lanes, flags = _registers()
    try:
        path = shared_library(sources, (f"-DLANES={lanes}", *flags, "-DVECTOR_LIBRARY"), ("-lmvec",))
    except CompileError:
        path = shared_library(sources, (f"-DLANES={lanes}", *flags))
    return ctypes.CDLL(str(path)), lanes


@cache
def _registers() -> tuple[int, tuple[str, ...]]:
    """How many numbers a vector register of this machine holds, and the compiler's flags for that."""
    try:
        facts = Path("/proc/cpuinfo").read_text(encoding="utf-8") if platform.machine() == "x86_64" else ""
    except OSError:
        facts = ""
    if " avx512dq " in facts:
        return 8, ("-mavx512f", "-mavx512dq", "-mprefer-vector-width=512")
    return (4, ("-mavx2",)) if " avx2 " in facts else (2, ())


class _File:
    def __init__(self, words: Words) -> None:
        self._words = words
        self.drivers: list[str] = []
        self.flat = FlatCode(self._outside, words)

    def _outside(self, function: ca.Function) -> Callee:
        """How that is called which is no graph."""
        name = function.name()
        if is_driver(name) and driver_of(name).side_by_side:
            if name not in self.drivers:
                self.drivers.append(name)
            entry, room, in_place = entry_of(name)
            return Callee(entry, (function.n_in(), function.n_out()), room, in_place=in_place)
        if function.is_a("SXFunction"):
            known = {function.instruction_id(k) for k in range(function.n_instructions())} <= _KNOWN
            if known:
                return self.flat.written(function)
        where = "lanes" if self._words.side_by_side else "devices"
        raise NoCode(f"the loop has a part that is not written for {where}: {name}")

    def driver(self, name: str) -> str:
        """The loops of an optimiser, around leaves that are among the functions of this file.

        Raises:
            NoCode: they are not written for lanes.
        """
        driver, others = driver_of(name), len(self.drivers)
        leaves = {key: self.flat.callee(leaf, always=True) for key, leaf in driver.leaves.items()}
        if len(self.drivers) > others or any(leaf.room for leaf in leaves.values()):
            raise NoCode(f"the loop has a part that is not written for lanes: a stage of {name}")
        names = {key: leaf.name for key, leaf in leaves.items()}
        before = "".join(f"#undef {one}\n" for one in (*driver.constants, *names, "ENTRY", "ROOM"))
        return f"{before}#define ENTRY {entry_of(name)[0]}\n{driver.around(names)}"

    def text(self) -> str:
        """The functions that are written so far, with what they need."""
        tables = {
            f"flat_table_{k}": f"const casadi_real flat_table_{k}{one}\n" for k, one in enumerate(self.flat.tables)
        }
        declared = [f"int {entry_of(name)[0]}{SIGNATURE};\n" for name in self.drivers]
        if self._words.side_by_side:
            shared = [f"static {table}" for table in tables.values()]
            return "".join([_prelude("lanes.c"), *shared, *declared, *self.flat.texts])
        # In OpenCL constants of a file have addresses of another kind, which no function of numbers takes.
        texts = [
            head + "{\n" + "".join(tables[name] for name in dict.fromkeys(_TABLE.findall(body))) + body
            for head, _, body in (text.partition("{\n") for text in self.flat.texts)
        ]
        return "".join([_prelude("opencl.c"), *declared, *texts])


@cache
def _prelude(name: str) -> str:
    return resources.files("fpirhc.symbolic").joinpath(name).read_text(encoding="utf-8")
