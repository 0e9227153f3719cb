"""Many plants in one compiled loop: the scalar code of the closed loop on vector registers, one plant in each lane.

Theory: docs/theory-plants.md, "Many plants side by side".
"""

from __future__ import annotations

import ctypes
import math
import os
import platform
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import casadi as ca
import numpy as np

from fpirhc.errors import CompileError, InvalidShape, InvalidValue
from fpirhc.simulation.loop import start_memory
from fpirhc.simulation.metrics.base import measured_errors
from fpirhc.simulation.ranges import ranges_of
from fpirhc.simulation.simulate import Simulator, run_tables
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.native import find_compiler, shared_library
from fpirhc.task.problem import Problem

_GROUPS = 256  # of lanes in one call
_TWO = {
    ca.OP_ADD: "{0} + {1}", ca.OP_SUB: "{0} - {1}", ca.OP_MUL: "{0} * {1}", ca.OP_DIV: "{0} / {1}",
    ca.OP_LT: "truth({0} < {1})", ca.OP_LE: "truth({0} <= {1})", ca.OP_EQ: "truth({0} == {1})", ca.OP_NE: "truth({0} != {1})",
    ca.OP_AND: "truth(({0} != 0) & ({1} != 0))", ca.OP_OR: "truth(({0} != 0) | ({1} != 0))",
    ca.OP_FMIN: "least({0}, {1})", ca.OP_FMAX: "most({0}, {1})", ca.OP_IF_ELSE_ZERO: "where({0} != 0, {1})",
    ca.OP_POW: "v_pow({0}, {1})", ca.OP_CONSTPOW: "v_pow({0}, {1})", ca.OP_ATAN2: "v_atan2({0}, {1})",
    ca.OP_HYPOT: "v_hypot({0}, {1})", ca.OP_COPYSIGN: "v_copysign({0}, {1})", ca.OP_FMOD: "v_fmod({0}, {1})",
}  # fmt: skip
_ONE = {
    ca.OP_ASSIGN: "{0}", ca.OP_NEG: "-{0}", ca.OP_SQ: "{0} * {0}", ca.OP_TWICE: "{0} + {0}", ca.OP_INV: "1.0 / {0}",
    ca.OP_NOT: "truth({0} == 0)", ca.OP_FABS: "size({0})", ca.OP_SIGN: "truth({0} > 0) - truth({0} < 0)",
}  # fmt: skip
_NAMED = ("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh",
          "log1p", "expm1", "floor", "ceil")  # fmt: skip
_ONE |= {getattr(ca, f"OP_{name.upper()}"): f"v_{name}({{0}})" for name in _NAMED}


@dataclass(frozen=True, eq=False)
class ManyRuns:
    """Errors of many plants.

    Args:
        rms_error: by coordinate, shape (plants,), in its unit; NaN where a run ended before `measure_from`.
        max_error: the same, largest sizes.
        stops: why the runs of some plants ended early, by number of the plant.
        lanes: plants that ran side by side in one register; 0: one after the other by the ordinary loop.
        why: no lanes; empty where there are some.
    """

    rms_error: Mapping[str, np.ndarray]
    max_error: Mapping[str, np.ndarray]
    stops: Mapping[int, str]
    lanes: int
    why: str


def run_many(ready: Simulator, exact: np.ndarray, *, seed: int = 0) -> ManyRuns:
    """Run one loop for many plants, which differ in their exact parameters.

    Args:
        ready: from `fp.simulator`.
        exact: parameters of the plants, shape (plants, parameters), in the order of the plant's parameters.
        seed: of the noise of disturbances and sensors, the same for every plant.

    Raises:
        InvalidShape: another number of parameters.
        InvalidValue: a parameter that is not finite.
    """
    exact = np.atleast_2d(np.asarray(exact, dtype=float))
    if exact.ndim != 2 or exact.shape[1] != ready.problem.plant.parameter.size:
        names = ", ".join(ready.problem.plant.parameter.elements)
        raise InvalidShape(f"run_many(exact of shape {exact.shape}): expected one row per plant with {names}")
    if not np.isfinite(exact).all():
        raise InvalidValue(
            f"run_many: parameters of plant {int(np.argmin(np.isfinite(exact).all(axis=1)))} are not finite"
        )
    why = _why_no_lanes(ready)
    library: _Library | None = None
    if not why:
        try:
            library = _built(ready)
        except CompileError as error:
            why = str(error)
    judged = ready.loop.trace["error"].elements
    rms, largest = (np.empty((len(exact), len(judged))) for _ in range(2))
    left = np.ones(len(exact), dtype=bool)
    if library is not None:
        squares, largest, left = library.errors(ready, exact, seed)
        rms = np.sqrt(squares / (ready.problem.cycles - _first(ready.problem)))
    stops = {}
    for number in map(int, np.flatnonzero(left)):
        variant = ready.problem.with_exact(exact[number])
        run = ready.run(seed=seed, variant=variant)
        errors = measured_errors(variant, run)
        rms[number], largest[number] = np.sqrt(np.mean(errors**2, axis=0)), np.max(np.abs(errors), axis=0)
        if run.stop is not None:
            stops[number] = run.stop
    by_name = [dict(zip(judged, columns.T.copy(), strict=True)) for columns in (rms, largest)]
    return ManyRuns(by_name[0], by_name[1], stops, 0 if library is None else library.lanes, why)


def _first(problem: Problem) -> int:
    """The first cycle that is measured."""
    return max(0, math.ceil(problem.measure_from / problem.period - 0.5))


def _why_no_lanes(ready: Simulator) -> str:
    if ready.problem.foreign is not None:
        return "a plant outside is run one after the other"
    if ready.loop.opaque:
        return "the loop has a plan, a table or a solver in it, which is no scalar code"
    if ready.problem.cycles <= _first(ready.problem):
        return "no cycle is measured"
    function = ready.loop.function
    operations = {function.instruction_id(k) for k in range(function.n_instructions())}
    if operations - {*_TWO, *_ONE, ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST}:
        return "the loop has an operation that is not written for lanes"
    return "" if find_compiler() else "there is no C compiler"


@dataclass(frozen=True, eq=False)
class _Library:
    """The compiled loop over lanes."""

    run: Callable[..., None]
    lanes: int

    def errors(self, ready: Simulator, exact: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sums of squares and largest sizes of the errors, (plants, errors), and which plants are to be run again."""
        problem, loop = ready.problem, ready.loop
        tables = run_tables(problem, seed, problem.cycles)
        reads = np.ascontiguousarray(np.hstack([*tables, np.empty((problem.cycles, 0))]))
        starts, count = _starts(ready, exact), loop.trace["error"].size
        groups = -(-len(exact) // self.lanes)
        padded = starts[np.minimum(np.arange(groups * self.lanes), len(exact) - 1)]
        memory = np.ascontiguousarray(padded.reshape(groups, self.lanes, -1).transpose(0, 2, 1))
        squares, largest = np.empty((groups, count, self.lanes)), np.empty((groups, count, self.lanes))
        left = np.empty((groups, self.lanes))

        def call(begin: int) -> None:
            end = min(begin + _GROUPS, groups)
            pieces = (memory[begin:end], reads, squares[begin:end], largest[begin:end], left[begin:end])
            self.run(end - begin, problem.cycles, _first(problem), *(p.ctypes.data_as(ctypes.c_void_p) for p in pieces))

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(call, range(0, groups, _GROUPS)))
        sums, sizes = (v.transpose(0, 2, 1).reshape(-1, count)[: len(exact)].copy() for v in (squares, largest))
        return sums, sizes, left.reshape(-1)[: len(exact)] != 0


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


def _built(ready: Simulator) -> _Library:
    """Compile the loop, with the vector library of the system where it can be linked.

    Raises:
        CompileError: neither with it nor without it.
    """
    lanes, flags = _registers()
    source = lanes_source(ready.problem, ready.loop)
    try:
        path = shared_library(source, (f"-DLANES={lanes}", *flags, "-DVECTOR_LIBRARY"), ("-lmvec",))
    except CompileError:
        path = shared_library(source, (f"-DLANES={lanes}", *flags))
    run = ctypes.CDLL(str(path)).run_lanes
    run.argtypes, run.restype = [ctypes.c_long] * 3 + [ctypes.c_void_p] * 5, None
    return _Library(run, lanes)


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


def lanes_source(problem: Problem, loop: Composite) -> str:
    """Return the C text of the loop over lanes, whose width is LANES."""
    sizes = {"MEMORY": loop.memory.size, "TRACE": loop.trace.size, "READS": sum(s.size for s in loop.reads.signals)}
    errors = loop.trace.slice("true_error" if "true_error" in loop.trace.names else "error")
    limits = ranges_of(problem, loop.trace)
    rows = zip(limits.columns, limits.lower, limits.upper, strict=True)
    outside = "".join(
        f"  bad |= (trace[{k}] < {_number(low)}) | (trace[{k}] > {_number(high)});\n" for k, low, high in rows
    )
    defined = {**sizes, "ERRORS": errors.stop - errors.start, "FIRST_ERROR": errors.start}
    head = "".join(f"#define {name} {value}\n" for name, value in defined.items())
    text = resources.files("fpirhc.simulation").joinpath("lanes.c").read_text(encoding="utf-8")
    return head + text.replace("/* STEP */", _step(loop.function)).replace("/* RANGES */", outside)


def _step(function: ca.Function) -> str:
    """The instructions of scalar code, one line each; reads of the arguments behind the memory follow each other."""
    before = np.cumsum([0, *(function.numel_in(k) for k in range(1, function.n_in()))])
    places, lines = set[int](), list[str]()
    for k in range(function.n_instructions()):
        op, given, results = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_OUTPUT:
            lines.append(f"  {('next', 'trace')[results[0]]}[{results[1]}] = w{given[0]};")
            continue
        if op == ca.OP_INPUT:
            value = f"memory[{given[1]}]" if given[0] == 0 else f"all(reads[{before[given[0] - 1] + given[1]}])"
        elif op == ca.OP_CONST:
            value = f"all({_number(function.instruction_constant(k))})"
        else:
            value = (_TWO.get(op) or _ONE[op]).format(*(f"w{i}" for i in given))
        places.add(results[0])
        lines.append(f"  w{results[0]} = {value};")
    return "\n".join([f"  V {', '.join(f'w{k}' for k in sorted(places))};", *lines])


def _number(value: float) -> str:
    if math.isnan(value):
        return "(0.0 / 0.0)"
    return repr(float(value)) if math.isfinite(value) else f"({'-' if value < 0 else ''}1.0 / 0.0)"
