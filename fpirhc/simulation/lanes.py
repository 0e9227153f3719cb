"""Many plants in one compiled loop: the scalar code of the closed loop on vector registers, one plant in each lane.

Theory: docs/theory-plants.md, "Many plants side by side".
"""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import resources

import numpy as np

from fpirhc.errors import CompileError, InvalidShape, InvalidValue, NoCode
from fpirhc.simulation.loop import start_memory
from fpirhc.simulation.metrics.base import measured_errors
from fpirhc.simulation.opencl import loaded_kernel
from fpirhc.simulation.ranges import ranges_of
from fpirhc.simulation.simulate import Simulator, run_tables
from fpirhc.status import Status
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.dataflow import SIDE_BY_SIDE, Callee
from fpirhc.symbolic.lanes import lanes_library, written_for_devices, written_in_lanes
from fpirhc.symbolic.latest import Latest
from fpirhc.symbolic.native import find_compiler
from fpirhc.task.problem import Problem

_GROUPS, _ITEMS = 256, 65_536  # of lanes in one call, and of a device


@dataclass(frozen=True, eq=False)
class ManyRuns:
    """Errors of many plants.

    Args:
        rms_error: by coordinate, shape (plants,), in its unit; NaN where a run ended before `measure_from`.
        max_error: the same, largest sizes.
        statuses: cycles with each status that occurred, by its name, shape (plants,).
        stops: why the runs of some plants ended early, by number of the plant.
        lanes: plants that ran side by side in one register, or work item of a device; 0: one after the other by the ordinary loop.
        why: no lanes; empty where there are some.
    """

    rms_error: Mapping[str, np.ndarray]
    max_error: Mapping[str, np.ndarray]
    statuses: Mapping[str, np.ndarray]
    stops: Mapping[int, str]
    lanes: int
    why: str


def run_many(ready: Simulator, exact: np.ndarray, *, seed: int = 0, device: str | None = None) -> ManyRuns:
    """Run one loop for many plants, which differ in their exact parameters.

    Args:
        ready: from `fp.simulator`.
        exact: parameters of the plants, shape (plants, parameters), in the order of the plant's parameters.
        seed: of the noise of disturbances and sensors, the same for every plant.
        device: part of the name of an OpenCL device ('': the first graphics processor, else the first one), for loops that are
            scalar code; None: the vector registers of this machine.

    Raises:
        InvalidName: no device has this name.
        InvalidShape: another number of parameters.
        InvalidValue: a parameter that is not finite.
        NotInstalled: pyopencl (pip install 'fpirhc[opencl]'), or a device with double precision.
    """
    exact = np.atleast_2d(np.asarray(exact, dtype=float))
    if exact.ndim != 2 or exact.shape[1] != ready.problem.plant.parameter.size:
        names = ", ".join(ready.problem.plant.parameter.elements)
        raise InvalidShape(f"run_many(exact of shape {exact.shape}): expected one row per plant with {names}")
    if not np.isfinite(exact).all():
        raise InvalidValue(
            f"run_many: parameters of plant {int(np.argmin(np.isfinite(exact).all(axis=1)))} are not finite"
        )
    why = _why_no_lanes(ready, device)
    library: _Library | None = None
    if not why:
        try:
            library = _LIBRARIES.of((ready,), (device,), lambda: _built(ready, device))
        except (CompileError, NoCode) as error:
            why = str(error)
    judged, problem = ready.loop.trace["error"].elements, ready.problem
    sums, largest = (np.full((len(exact), len(judged)), np.nan) for _ in range(2))
    counts, left = np.zeros((len(exact), len(Status))), np.ones(len(exact), dtype=bool)
    if library is not None:
        sums, largest, counts, left = library.results(ready, exact, seed)
        counts[:, Status.OK] = problem.cycles - counts[:, Status.OK + 1 :].sum(axis=1)
    rms, stops = np.sqrt(sums / (problem.cycles - _first(problem))), {}
    for number in map(int, np.flatnonzero(left)):
        variant = problem.with_exact(exact[number])
        run = ready.run(seed=seed, variant=variant)
        errors = measured_errors(variant, run)
        rms[number], largest[number] = np.sqrt(np.mean(errors**2, axis=0)), np.max(np.abs(errors), axis=0)
        counts[number] = np.bincount(run["status"].ravel().astype(int), minlength=len(Status))
        if run.stop is not None:
            stops[number] = run.stop
    by_name = (dict(zip(judged, columns.T.copy(), strict=True)) for columns in (rms, largest))
    statuses = {one.name: counts[:, one].astype(int) for one in Status if counts[:, one].any()}
    return ManyRuns(next(by_name), next(by_name), statuses, stops, 0 if library is None else library.lanes, why)


def _first(problem: Problem) -> int:
    """The first cycle that is measured."""
    return max(0, math.ceil(problem.measure_from / problem.period - 0.5))


def _why_no_lanes(ready: Simulator, device: str | None) -> str:
    if not ready.problem.equations_known:
        return "a plant outside is run one after the other"
    if ready.problem.cycles <= _first(ready.problem):
        return "no cycle is measured"
    return "" if device is not None or find_compiler() else "there is no C compiler"


@dataclass(frozen=True, eq=False)
class _Library:
    """The compiled loop over lanes.

    Args:
        run: function of (groups, cycles, first that is measured, first memories, what cycles read, results).
        lanes: plants of a group.
        batch: groups of a call.
        threads: calls at a time.
    """

    run: Callable[..., int]
    lanes: int
    batch: int
    threads: int

    def results(self, ready: Simulator, exact: np.ndarray, seed: int) -> tuple[np.ndarray, ...]:
        """Sums of squares and largest sizes of the errors, and cycles by status, a row per plant; which are to be run again."""
        problem, loop = ready.problem, ready.loop
        tables = run_tables(problem, seed, problem.cycles)
        reads = np.ascontiguousarray(np.hstack([*tables, np.empty((problem.cycles, 0))]))
        starts, count = _starts(ready, exact), loop.trace["error"].size
        groups = -(-len(exact) // self.lanes)
        padded = starts[np.minimum(np.arange(groups * self.lanes), len(exact) - 1)]
        memory = np.ascontiguousarray(padded.reshape(groups, self.lanes, -1).transpose(0, 2, 1))
        sums_of_all = np.ones((groups, 2 * count + len(Status) + 1, self.lanes))

        def call(begin: int) -> None:
            end = min(begin + self.batch, groups)
            self.run(end - begin, problem.cycles, _first(problem), memory[begin:end], reads, sums_of_all[begin:end])

        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(call, range(0, groups, self.batch)))
        rows = sums_of_all.transpose(0, 2, 1).reshape(groups * self.lanes, -1)[: len(exact)]
        sums, sizes, counts, left = np.split(rows, np.cumsum([count, count, len(Status)]), axis=1)
        return sums.copy(), sizes.copy(), counts.copy(), left.ravel() != 0


def _starts(ready: Simulator, exact: np.ndarray) -> np.ndarray:
    """First memories (plants, memory): one and the same but for the parameters, unless the start depends on these."""
    place, ends = ready.loop.memory.slice("_exact"), [exact[0], exact[-1]]
    first, last = (start_memory(ready.loop, ready.problem.with_exact(one), ready.controller) for one in ends)
    rest = np.delete(np.arange(len(first)), np.arange(place.start, place.stop))
    if np.array_equal(first[rest], last[rest]):
        starts = np.tile(first, (len(exact), 1))
        starts[:, place] = exact
        return starts
    return np.array([start_memory(ready.loop, ready.problem.with_exact(one), ready.controller) for one in exact])


def _built(ready: Simulator, device: str | None) -> _Library:
    """Compile the loop.

    Raises:
        CompileError: the compiler fails.
        InvalidName, NotInstalled: no such device.
        NoCode: a part of the loop is not written for lanes, or for devices.
    """
    if device is not None:
        text, step = written_for_devices(ready.loop.function)
        return _Library(loaded_kernel(text + _around(ready.problem, ready.loop, step), device), 1, _ITEMS, 1)
    library, lanes = lanes_library(lanes_sources(ready.problem, ready.loop))
    run = library.run_lanes
    run.argtypes, run.restype = [ctypes.c_long] * 3 + [np.ctypeslib.ndpointer(float)] * 3, ctypes.c_int
    return _Library(run, lanes, _GROUPS, os.cpu_count() or 1)


_LIBRARIES: Latest[_Library] = Latest(4)


def lanes_sources(problem: Problem, loop: Composite) -> tuple[str, ...]:
    """Return the C files of the loop over lanes, whose width is LANES.

    Raises:
        NoCode: a part of it is not written for lanes.
    """
    (text, *drivers), step = written_in_lanes(loop.function)
    return text + _around(problem, loop, step), *drivers


def _around(problem: Problem, loop: Composite, step: Callee) -> str:
    """The text of a run, behind that of a cycle."""
    before = np.cumsum([0, *(loop.function.numel_in(k) for k in range(1, loop.function.n_in()))])
    errors = loop.trace.slice("true_error" if "true_error" in loop.trace.names else "error")
    defined = {
        "STEP": step.name, "ROOM": step.room, "MEMORY": loop.memory.size, "TRACE": loop.trace.size, "READS": before[-1],
        "TABLES": ", ".join(f"now + {at}" for at in before[:-1]), "ERRORS": errors.stop - errors.start,
        "FIRST_ERROR": errors.start, "STATUS": loop.trace.slice("status").start, "STATUSES": len(Status),
    }  # fmt: skip
    limits = ranges_of(problem, loop.trace)
    outside = "".join(
        f"  bad |= (trace[{column}] < {SIDE_BY_SIDE.constant(low)}) | (trace[{column}] > {SIDE_BY_SIDE.constant(high)});\n"
        for column, low, high in zip(limits.columns, limits.lower, limits.upper, strict=True)
    )
    head = "".join(f"#define {name} {value}\n" for name, value in defined.items())
    own = resources.files("fpirhc.simulation").joinpath("lanes.c").read_text(encoding="utf-8")
    return head + own.replace("/* RANGES */", outside)
