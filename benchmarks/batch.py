"""Microseconds per cycle and plant of a closed loop: plants side by side in vector registers beside the ordinary compiled loop, and
beside what somebody writes by hand in C, numpy, numba and JAX.

    python benchmarks/batch.py [--write] [--many] [--four] [--device NAME]

--write puts the tables into docs/performance.md; --many runs a million plants for 500 cycles, and 100 000 for 100 plans; --four
measures the loops with four lanes, for AVX2, and nothing else; --device runs thousands of plants on an OpenCL device, and nothing
else.

Processor time in one process, in turn, the smallest of five; the ordinary runs keep their log and are measured by the same errors,
the loops written by hand keep nothing but sums of squares. numba and JAX are left out where they are not installed.
"""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import by_hand
import numpy as np
from table import write_table

import fpirhc as fp
from fpirhc.simulation import lanes
from fpirhc.simulation.metrics.base import measured_errors
from fpirhc.simulation.opencl import Kernel, loaded_kernel
from fpirhc.simulation.simulate import Simulator
from fpirhc.symbolic.native import shared_library

LOOPS = {
    "two_mass": ("CTC", "CTC+FPI (eq 6)", "CTC+FPI (eq 3)", "RHC", "RHC+FPI"),
    "mrac_pendulum": ("CTC+FPI",),
    "puma560": ("CT+FPI",),
}
PLANTS, ALONE, MANY, PLANNED = 512, 8, 1_000_000, 100_000
Errors = Callable[[np.ndarray], np.ndarray]  # of exact parameters, a row per plant: rms errors, a row per plant


def plants(ready: Simulator, count: int) -> np.ndarray:
    """Parameters within 10 % of the exact ones."""
    exact = ready.problem.plant.exact
    return exact * (1 + 0.1 * np.random.default_rng(0).uniform(-1, 1, (count, exact.size)))


def alone(ready: Simulator, exact: np.ndarray) -> np.ndarray:
    """Rms errors of plants that run one after the other."""
    variants = [ready.problem.with_exact(one) for one in exact]
    return np.array([np.sqrt(np.mean(measured_errors(v, ready.run(seed=0, variant=v)) ** 2, axis=0)) for v in variants])


def smallest(works: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Processor time of every work in s, the smallest of five in turn."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(5):
        for name, work in works.items():
            begun = time.process_time()
            work()
            times[name].append(time.process_time() - begun)
    return {name: min(spent) for name, spent in times.items()}


def row(name: str, controller: str, ready: Simulator) -> list[str]:
    """Both times, their ratio and the largest relative difference of an rms error."""
    exact = plants(ready, PLANTS)
    many, single = ready.run_many(exact), alone(ready, exact[:ALONE])
    apart = max(np.abs(many.rms_error[n][:ALONE] / single[:, k] - 1).max() for k, n in enumerate(many.rms_error))
    spent = smallest({"lanes": lambda: ready.run_many(exact), "alone": lambda: alone(ready, exact[:ALONE])})
    lanes, ordinary = (
        1e6 * spent[k] / count / ready.problem.cycles for k, count in (("lanes", PLANTS), ("alone", ALONE))
    )
    figures = f"{lanes:.3f}", f"{ordinary:.3f}", f"{ordinary / lanes:.1f}", f"{apart:.1g}"
    return [f"{name}, {controller}", str(many.lanes), *figures]


def a_plan_a_cycle() -> Simulator:
    """RHC+FPI of two_mass in cycles as long as a stage, so that every one of them plans."""
    problem = by_hand.TASK.problem
    assert problem.horizon is not None
    coarse = replace(problem, period=problem.horizon.step)
    return fp.simulator(coarse, by_hand.TASK.controllers["RHC+FPI"])


def first_measured(ready: Simulator) -> int:
    """The first cycle whose error counts."""
    return round(ready.problem.measure_from / ready.problem.period)


def in_c(ready: Simulator) -> Errors:
    """A bare loop in C."""
    run = ctypes.CDLL(str(shared_library([by_hand.IN_C]))).run
    model, cycles, first = np.array(by_hand.MODEL), ready.problem.cycles, first_measured(ready)

    def errors(exact: np.ndarray) -> np.ndarray:
        sums = np.empty((len(exact), 2))
        numbers = (ctypes.c_long(len(exact)), ctypes.c_long(cycles), ctypes.c_long(first))
        run(*numbers, *(v.ctypes.data_as(ctypes.c_void_p) for v in (exact, model, sums)))
        return np.sqrt(sums / (cycles - first))

    return errors


def in_numpy(ready: Simulator) -> Errors:
    """Arrays with an entry per plant."""
    cycle, cycles, first = by_hand.cycle_of(np), ready.problem.cycles, first_measured(ready)

    def errors(exact: np.ndarray) -> np.ndarray:
        memory, sums, columns = by_hand.START, np.zeros((2, len(exact))), tuple(exact.T.copy())
        for k in range(cycles):
            memory, e = cycle(k * by_hand.PERIOD, memory, columns)
            if k >= first:
                sums += np.square(e)
        return np.sqrt(sums.T / (cycles - first))

    return errors


def in_numba(ready: Simulator) -> Errors:
    """Scalar loops that numba compiles."""
    import numba

    cycle, cycles, first = by_hand.cycle_of(np, numba.njit), ready.problem.cycles, first_measured(ready)
    start, period = by_hand.START, by_hand.PERIOD

    @numba.njit
    def errors(exact: np.ndarray) -> np.ndarray:
        rms = np.empty((len(exact), 2))
        for n in range(len(exact)):
            p = exact[n]
            par = (p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10])
            memory, s1, s2 = start, 0.0, 0.0
            for k in range(cycles):
                memory, e = cycle(k * period, memory, par)
                if k >= first:
                    s1, s2 = s1 + e[0] ** 2, s2 + e[1] ** 2
            rms[n] = np.sqrt(s1 / (cycles - first)), np.sqrt(s2 / (cycles - first))
        return rms

    return errors  # type: ignore[no-any-return]


def in_jax(ready: Simulator) -> Errors:
    """`vmap` over plants of a `fori_loop`, compiled by XLA for the processor."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    cycle, cycles, first = by_hand.cycle_of(jnp), ready.problem.cycles, first_measured(ready)

    def rms(par: Any) -> Any:
        def body(k: Any, carried: Any) -> Any:
            memory, sums = carried
            memory, e = cycle(k * by_hand.PERIOD, memory, par)
            return memory, sums + jnp.where(k >= first, jnp.square(jnp.array(e)), 0.0)

        begun = tuple(jnp.float64(v) for v in by_hand.START), jnp.zeros(2)
        return jnp.sqrt(jax.lax.fori_loop(0, cycles, body, begun)[1] / (cycles - first))

    compiled = jax.jit(jax.vmap(rms))
    return lambda exact: np.asarray(compiled(exact))


def by_others() -> list[list[str]]:
    """Times of the loop written by hand, times of the lanes, and the largest relative difference of an rms error."""
    ready = fp.simulator(by_hand.TASK.problem, by_hand.CONTROLLER)
    exact, left_out = plants(ready, PLANTS), []
    ways: dict[str, Errors] = {
        "`run_many`": lambda some: np.column_stack(list(ready.run_many(some).rms_error.values())),
        "ordinary compiled loop, every signal logged": lambda some: alone(ready, some[:ALONE]),
    }
    makers = {"bare C loop": in_c, "numpy": in_numpy, "numba": in_numba, "JAX `vmap`": in_jax}
    for name, make in makers.items():
        try:
            ways[name] = make(ready)
        except ImportError as error:
            left_out.append([name, f"left out: {error}", "", ""])
    results = {name: way(exact) for name, way in ways.items()}
    spent = smallest({name: lambda way=way: way(exact) for name, way in ways.items()})  # type: ignore[misc]
    micro = {name: 1e6 * spent[name] / len(results[name]) / ready.problem.cycles for name in ways}
    apart = {name: np.abs(found / results["`run_many`"][: len(found)] - 1).max() for name, found in results.items()}
    own = micro["`run_many`"]
    return [[name, f"{micro[name]:.3f}", f"{micro[name] / own:.1f}", f"{apart[name]:.1g}"] for name in ways] + left_out


def shortened(ready: Simulator, cycles: int) -> Simulator:
    """The loop of so many cycles."""
    problem, span = ready.problem, cycles * ready.problem.period
    return fp.simulator(replace(problem, duration=span, measure_from=0.2 * span), ready.controller)


def many(name: str, ready: Simulator, count: int, cycles: int) -> list[str]:
    """Processor time of so many plants, and what two cores need where nothing else runs."""
    ready = shortened(ready, cycles)
    exact, begun = plants(ready, count // 10), time.process_time()
    for _ in range(10):
        ready.run_many(exact)
    spent = time.process_time() - begun
    return [name, f"{count:,}".replace(",", " "), str(cycles), f"{spent:.1f}", f"{spent / 2:.1f}"]


def on_device(device: str, name: str, ready: Simulator, count: int) -> list[str]:
    """By the clock on the wall: a loop on a device and in the lanes of all cores, and what a plant has beside the registers."""
    kernels: list[Kernel] = []

    def loaded(*given: str) -> Kernel:
        kernels.append(loaded_kernel(*given))
        return kernels[-1]

    lanes.loaded_kernel = loaded  # type: ignore[attr-defined]
    ready = shortened(ready, 500)
    exact, walls, errors = plants(ready, count), {}, {}
    for where in (None, device):
        first = ready.run_many(exact[:8], device=where)
        begun = time.perf_counter()
        errors[where] = np.array(list(ready.run_many(exact, device=where).rms_error.values()))
        walls[where] = 1e6 * (time.perf_counter() - begun) / len(exact) / ready.problem.cycles
        if not first.lanes:
            return [name, first.why, "", "", "", ""]
    apart = float(np.max(np.abs(errors[device] / errors[None] - 1)))
    times = walls[device] / walls[None]
    return [
        name,
        f"{walls[device]:.4f}",
        f"{walls[None]:.4f}",
        f"{times:.2f}",
        f"{kernels[-1].private}",
        f"{apart:.0e}",
    ]


def main() -> None:
    """Measure and print, and write the tables where it is asked for."""
    if "--device" in sys.argv:
        device, planning = sys.argv[sys.argv.index("--device") + 1], a_plan_a_cycle()
        ready = fp.simulator(by_hand.TASK.problem, by_hand.CONTROLLER)
        some = (
            ("two_mass, CTC+FPI (eq 6)", ready, 65_536),
            ("two_mass, RHC+FPI, a plan in every cycle", planning, 4096),
        )
        heads = [
            "loop",
            "us on the device",
            "us in the lanes of all cores",
            "ratio",
            "private bytes of a plant",
            "apart",
        ]
        write_table("device", heads, [on_device(device, *one) for one in some])
        return
    tasks = {name: fp.load_problem(name) for name in LOOPS}
    loops = [
        (name, one, fp.simulator(tasks[name].problem, tasks[name].controllers[one]))
        for name, some in LOOPS.items()
        for one in some
    ]
    loops.append(("two_mass", "RHC+FPI, a plan in every cycle", a_plan_a_cycle()))
    head = ["loop", "lanes", "us in lanes", "us alone", "ratio", "apart"]
    if "--four" in sys.argv:
        lanes._registers = lambda: (4, ("-mavx2",))  # type: ignore[attr-defined,assignment]
        write_table("four lanes", head, [row(*one) for one in loops])
        return
    write_table("lanes", head, [row(*one) for one in loops])
    write_table(
        "batch", ["two_mass, CTC+FPI (eq 6)", "us per cycle and plant", "times the lanes", "apart"], by_others()
    )
    if "--many" in sys.argv:
        rows = [
            many("two_mass, CTC+FPI (eq 6)", fp.simulator(by_hand.TASK.problem, by_hand.CONTROLLER), MANY, 500),
            many("two_mass, RHC+FPI, a plan in every cycle", a_plan_a_cycle(), PLANNED, 100),
        ]
        write_table("many", ["loop", "plants", "cycles", "s of processor time", "s of two cores"], rows)


if __name__ == "__main__":
    main()
