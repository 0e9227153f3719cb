"""Speed of optimisers on the same horizons: fixed-point iteration against fatrop, IPOPT and SQP, side by side in one run.

    python benchmarks/optimisers.py [PROBLEM ...] [--write]      --write puts the tables into docs/performance.md
    python benchmarks/optimisers.py --constrained [PLANT ...]    horizons of other people's plants with limits of states

A closed loop of 200 plans is recorded once: the plant with its exact parameters, planned for with the approximate ones, from the
shipped problem. Every optimiser then solves the same 200 horizons, warm-started with its own last plan shifted by one stage.
Timed is the solver alone, through buffers: for fixed-point iteration the whole call (rollouts, verification and memory included),
for the others CasADi's solver without our verification. fatrop has all its functions compiled to C; IPOPT and SQP run
as CasADi ships them, in the virtual machine, unless 'compiled' is said.
"""

from __future__ import annotations

import runpy
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.horizon.problem import OptimalControl, rollout
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.base import Optimiser, judge
from fpirhc.optimisers.nlp import (
    MultipleShooting,
    interleave,
    scaled_solver,
    separate,
    shift_dynamics,
    shift_variables,
    sizes,
)
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.native import native

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

PLANS = 200
PROBLEMS = [
    "two_mass",
    "cart_pole",
    "van_der_pol",
    "two_link_arm",
    "chain_of_masses:3",
    "chain_of_masses:5",
    "chain_of_masses:7",
]
JIT = {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O2"], "verbose": False}, "jit_temp_suffix": True}


@dataclass(frozen=True)
class Horizons:
    """The recorded horizons of one problem."""

    ocp: OptimalControl
    first: list[np.ndarray]
    data: list[np.ndarray]
    tolerance: float


def problem_of(name: str) -> fp.Problem:
    """A shipped problem; 'chain_of_masses:5' is the chain of five."""
    base, _, size = name.partition(":")
    task = fp.load_problem(base)
    return runpy.run_path(str(task.path))["chain"](int(size)) if size else task.problem


def recorded(p: fp.Problem) -> Horizons:
    """Plan, apply, and let the exact plant move, 200 times."""
    cost = p.cost
    ocp = transcribe(p.plant, p.reference, p.horizon, cost, p.limits)
    data_of = stage_data(p.plant, p.reference, p.horizon, cost)
    advance = fp.RungeKutta4(4).step(p.plant, p.horizon.step)
    reach = np.where(np.isfinite(ocp.input_upper - ocp.input_lower), ocp.input_upper - ocp.input_lower, 2.0) / 2
    tolerance = 1e-6 * float(reach.max())
    optimiser = fp.FixedPoint(iterations=1, tolerance=tolerance)
    solve = follow(optimiser, ocp, native(optimiser.converging(ocp)).function)
    state, first, data = p.start_state, [], []
    before = np.zeros(ocp.input.size)
    for k in range(PLANS):
        values = np.asarray(data_of(k * p.horizon.step, p.plant.approximate).full())
        s0 = ocp.start(state, before).full().ravel()
        first.append(s0)
        data.append(values)
        before = solve(s0, values)[0][:, 0]
        state = advance(state, before, p.plant.exact, np.zeros(len(p.plant.names))).full().ravel()
    return Horizons(ocp, first, data, tolerance)


def follow(optimiser: Optimiser, ocp: OptimalControl, function: ca.Function) -> Callable:
    """A warm-started loop around a step: (s0, data) -> (inputs, seconds, diagnostics)."""
    evaluator, layout = Evaluator(function), optimiser.memory(ocp)
    remembered = ca.MX.sym("m", layout.size)
    shift = ca.Function("fpirhc_shift", [remembered], [optimiser.shifted(ocp, remembered)])
    evaluator.arguments[2][...], evaluator.arguments[3][...] = ocp.input_lower, ocp.input_upper
    evaluator.arguments[4][...] = layout.start()

    def solve(s0: np.ndarray, data: np.ndarray, *, cold: bool = False) -> tuple[np.ndarray, float, np.ndarray]:
        if cold:
            evaluator.arguments[4][...] = layout.start()
        evaluator.arguments[0][...], evaluator.arguments[1][...] = s0, data.T
        begin = time.perf_counter_ns()
        evaluator.evaluate()
        taken = time.perf_counter_ns() - begin
        evaluator.arguments[4][...] = shift(evaluator.results[2]).full().ravel()
        return evaluator.results[0].reshape(ocp.stages, -1).T.copy(), taken / 1e9, evaluator.results[1].copy()

    return solve


def rival(optimiser: MultipleShooting, ocp: OptimalControl, options: dict[str, object]) -> Callable:
    """The same around CasADi's solver alone, warm-started with its shifted variables and multipliers."""
    made = scaled_solver("fpirhc_rival", optimiser.plugin, ocp, {**optimiser.options(ocp), **options})
    solver = Evaluator(made)
    place = {made.name_in(k): k for k in range(made.n_in())}
    result = {made.name_out(k): k for k in range(made.n_out())}
    n, (variables, constraints) = ocp.stages, sizes(ocp)
    w, g = ca.MX.sym("w", variables), ca.MX.sym("g", constraints)
    later = ca.Function("fpirhc_later", [w, g], [shift_variables(ocp, w), shift_dynamics(ocp, g)])
    separated = ca.Function("fpirhc_separated", [w], list(separate(ocp, w)))
    predict = rollout(ocp)
    state, memory = {}, {"w": None, "lam_x": np.zeros(variables), "lam_g": np.zeros(constraints)}

    def bound(s0: np.ndarray, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        column = ca.horzcat(ca.DM(s0), ca.repmat(ca.DM(states), 1, n))
        return np.asarray(interleave(column, ca.repmat(ca.DM(inputs), 1, n)).full()).ravel()

    def solve(s0: np.ndarray, data: np.ndarray, *, cold: bool = False) -> tuple[np.ndarray, float, np.ndarray]:
        if cold:
            memory.update(w=None, lam_x=np.zeros(variables), lam_g=np.zeros(constraints))
        guess = np.zeros((ocp.input.size, n)) if memory["w"] is None else separated(memory["w"])[1].full()
        states = predict(s0, guess, data)[0]
        arguments = {
            "x0": interleave(
                states if np.isfinite(states.full()).all() else ca.repmat(ca.DM(s0), 1, n + 1), ca.DM(guess)
            ),
            "p": data.ravel(order="F"),
            "lbx": bound(s0, ocp.state_lower, ocp.input_lower),
            "ubx": bound(s0, ocp.state_upper, ocp.input_upper),
            "lam_x0": memory["lam_x"],
            "lam_g0": memory["lam_g"],
        }
        for name, value in arguments.items():
            solver.arguments[place[name]][...] = np.asarray(ca.DM(value).full()).ravel()
        begin = time.perf_counter_ns()
        try:
            solver.evaluate()
        except RuntimeError:  # a solver that raises has no plan
            memory.update(w=None, lam_x=np.zeros(variables), lam_g=np.zeros(constraints))
            return np.asarray(guess, dtype=float), (time.perf_counter_ns() - begin) / 1e9, np.full(5, np.nan)
        taken = time.perf_counter_ns() - begin
        solution = {name: solver.results[result[name]].copy() for name in ("x", "lam_x", "lam_g")}
        state["inputs"] = separated(solution["x"])[1].full()
        memory["w"], memory["lam_g"] = (v.full().ravel() for v in later(solution["x"], solution["lam_g"]))
        memory["lam_x"] = later(solution["lam_x"], solution["lam_g"])[0].full().ravel()
        return state["inputs"], taken / 1e9, np.full(5, np.nan)

    return solve


def measured(horizons: Horizons, solve: Callable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seconds, stationarity and iterations of every plan."""
    ocp = horizons.ocp
    verify = judge(ocp)
    none = np.zeros((ocp.state.size, ocp.stages))
    seconds, residuals, iterations = [], [], []
    for s0, data in zip(horizons.first, horizons.data, strict=True):
        inputs, taken, diagnostics = solve(s0, data)
        seconds.append(taken)
        iterations.append(diagnostics[3])
        residuals.append(float(verify(inputs, s0, data, ocp.input_lower, ocp.input_upper, none)[1]))
    return np.array(seconds), np.array(residuals), np.array(iterations)


def ways(horizons: Horizons) -> dict[str, Callable[[], Callable]]:
    """Every optimiser as a warm-started solve; built when it is its turn."""
    ocp, tolerance = horizons.ocp, horizons.tolerance
    fixed = fp.FixedPoint(iterations=1, tolerance=tolerance)
    accuracy = 1e-6
    return {
        "FixedPoint, converged, compiled": lambda: follow(fixed, ocp, native(fixed.converging(ocp)).function),
        "FixedPoint, one iteration, compiled": lambda: follow(fixed, ocp, native(fixed.step(ocp)).function),
        "FixedPoint, converged, virtual machine": lambda: follow(fixed, ocp, fixed.converging(ocp)),
        "fatrop, functions compiled": lambda: rival(fp.Fatrop(accuracy=accuracy), ocp, JIT),
        "IPOPT": lambda: rival(fp.Ipopt(accuracy=accuracy), ocp, {}),
        "SQP (Gauss-Newton) with OSQP": lambda: rival(fp.SequentialQuadratic(), ocp, {}),
    }


def rows_of(name: str) -> list[tuple[str, ...]]:
    """One row per optimiser for this problem."""
    horizons = recorded(problem_of(name))
    ocp, rows, base = horizons.ocp, [], None
    title = f"{name} (N = {ocp.stages}, {ocp.state.size} states)"
    for way, build in ways(horizons).items():
        seconds, residuals, iterations = measured(horizons, build())
        middle = float(np.median(seconds[1:]))
        base = base or middle
        iterations_text = (
            f"{np.median(iterations):.0f} / {iterations.max():.0f}" if np.isfinite(iterations).all() else ""
        )
        rows.append(
            (
                title,
                way,
                f"{1e6 * middle:.3g}",
                f"{1e6 * np.quantile(seconds[1:], 0.99):.3g}",
                f"{middle / base:.3g}",
                iterations_text,
                f"{np.median(residuals) / horizons.tolerance * 1e-6:.1e}",
                f"{(residuals > horizons.tolerance).sum()}",
            )
        )
        print(" | ".join(rows[-1]), flush=True)
    return rows


def main() -> None:
    """Measure the problems named on the command line, or all."""
    if "--constrained" in sys.argv:
        import constrained

        constrained.main()
        return
    names = [a for a in sys.argv[1:] if not a.startswith("--")] or PROBLEMS
    rows = [row for name in names for row in rows_of(name)]
    heads = (
        "problem",
        "optimiser",
        "median us",
        "p99 us",
        "times FixedPoint",
        "iterations, median / most",
        "stationarity, median",
        f"above 1e-6, of {PLANS}",
    )
    write_table("optimisers", heads, rows)


if __name__ == "__main__":
    main()
