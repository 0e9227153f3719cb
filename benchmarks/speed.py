"""Speed of plans and their distance from IPOPT's: FixedPointSolver, DAQP, acados, fatrop and IPOPT on states of closed loops.

    pip install daqp             without it the column of DAQP is left out
    acados by its own instructions (a version of 2026, its option for DAQP on), and its acados_template, with ACADOS_SOURCE_DIR and
    LD_LIBRARY_PATH set; without it its columns are left out
    OPENBLAS_NUM_THREADS=1 python benchmarks/speed.py [LOOP ...] [--write] [--cold]
                                 --write puts the tables into docs/performance.md; --cold lets every plan begin from nothing

Every loop is flown once for 100 plans, with the right model and with a wrong one. All solvers then plan from these states, in turns
in one process on one core, each warm-started with its own last plan one stage later and at its default tolerance, with compiled
functions. The clock of a plan is CPU time, the lower quartile of the passes. What it contains:

    FixedPointSolver    the whole call: rollouts, verification of the plan, memory for the next one
    DAQP          Model.update and Model.solve of the condensed program, with their Python; not the product that makes its vectors
    acados        its own time_tot, wall time of preparation and feedback in C, or the CPU time of solve() where that is less; not
                  the calls that set states and data; the quickest of three QP solvers, which is printed
    fatrop, IPOPT CasADi's solver, not our verification

The distance is the largest difference of an input from the plan of IPOPT at 1e-10, relative to the largest input of that plan.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import acados_plans
import casadi as ca
import numpy as np
from table import write_table

import fpirhc as fp
from fpirhc.conformance import compiled as in_c
from fpirhc.conformance import posed
from fpirhc.contracts import Optimiser, reduced_gradient

COLD = "--cold" in sys.argv
PLANS, PASSES, SPENT = 100, 10, 1.0  # a solver makes PASSES passes, or as many as begin within SPENT seconds
FLAGS = ["-O3", "-march=native"]
LARGE = 500  # instructions of a stage; above it CasADi's solvers are compiled with -O1, else that takes minutes
JIT = {"jit": True, "compiler": "shell", "jit_temp_suffix": True}
Solve = Callable[..., tuple[np.ndarray, float]]  # (s0, data, cold) -> inputs (nu, N), seconds; no plan: NaN
OURS, ONCE, IPOPT, ALIKE = "FixedPointSolver()", "one iteration", "IPOPT", ("DAQP", "acados SQP", "fatrop", "IPOPT")


def masses(wall: float = np.inf) -> fp.Problem:
    """Six masses in a row between two walls, with three tensions (Y. Wang, S. Boyd, IEEE CST 18(2), 2010): a linear plant."""
    names = [f"y{k}" for k in range(1, 7)]
    pairs = {"u1": ("y1", "y2"), "u2": ("y3", "y5"), "u3": ("y4", "y6")}

    def response(q: Any, v: Any, u: Any, p: Any) -> dict[str, Any]:
        y = [0, *(q[n] for n in names), 0]
        pull = {n: p.k * (y[k] - 2 * y[k + 1] + y[k + 2]) - p.b * v[n] for k, n in enumerate(names)}
        for tension, (one, other) in pairs.items():
            pull[one], pull[other] = pull[one] + u[tension], pull[other] - u[tension]
        return {n: pull[n] / p.m for n in names}

    # At rest with all tensions at 1 N; .8 of that is wanted, and half of it is allowed.
    shape = dict(zip(names, np.array([5, 3, 8, 6, -3, -5]) / 7, strict=True))
    known = {"m": (1.0, 1.15, "kg"), "k": (1.0, 1.3, "N/m"), "b": (0.0, 0.05, "N s/m")}
    plant = fp.Plant(
        coordinates=dict.fromkeys(names, "m"),
        inputs=dict.fromkeys(pairs, "N"),
        controlled=("y1", "y3", "y4"),
        response=response,
        parameters={n: fp.Parameter(*v) for n, v in known.items()},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {n: 0.8 * shape[n] * ca.sin(0.06 * t) for n in names}),
        start=dict.fromkeys(names, 0.0) | {f"{n}'": 0.8 * 0.06 * shape[n] for n in names},
        period=0.5,
        duration=PLANS * 0.5,
        limits=fp.Limits(
            inputs=dict.fromkeys(pairs, (-0.5, 0.5)),
            states=dict.fromkeys(names, (-wall, wall)) if np.isfinite(wall) else {},
        ),
        horizon=fp.Horizon(stages=30, step=0.5),
        cost=fp.Quadratic(states=dict.fromkeys(names, 1.0), effort=dict.fromkeys(pairs, 0.1)),
    )


def chain(*, wall: bool) -> fp.Problem:
    """The shipped chain of three masses (acados' benchmark), which is to sway, through a wall where there is one."""
    problem = fp.load_problem("chain_of_masses").problem
    rest = problem.reference.motion
    limited = dict.fromkeys(("y1", "ye"), (-0.01, np.inf)) if wall else {}
    return replace(
        problem,
        reference=fp.Trajectory(lambda t: {**rest(t), "ye": 0.05 * ca.sin(t / 2), "y1": 0.025 * ca.sin(t / 2)}),
        limits=replace(problem.limits, states=limited),
    )


LOOPS: dict[str, Callable[[], fp.Problem]] = {
    "masses": masses,
    "masses, walls": lambda: masses(0.4),
    "two_mass": lambda: fp.load_problem("two_mass").problem,
    "cart_pole": lambda: fp.load_problem("cart_pole").problem,
    "chain_of_masses": lambda: chain(wall=False),
    "chain_of_masses, wall": lambda: chain(wall=True),
}
LINEAR = "masses", "masses, walls"


@dataclass(frozen=True, eq=False)
class Loop:
    """A problem with a plan in every stage; `right`: whether its model is the plant."""

    problem: fp.Problem
    right: bool

    @property
    def ocp(self) -> Any:
        return posed(self.problem)[0]

    def flown(self, solve: Solve) -> tuple[list[tuple[np.ndarray, np.ndarray]], float]:
        """(s0, data) of every plan, and the rms error of the controlled coordinates in the last three quarters of the run."""
        p, ocp = self.problem, self.ocp
        names = p.plant.state.elements
        real = p.plant.approximate if self.right else p.plant.exact
        advance = fp.RungeKutta4(4).step(p.plant, p.horizon.step)
        state, before, found, errors = p.start_state, np.zeros(ocp.input.size), [], []
        place = {n: k for k, n in enumerate(p.plant.output.elements)}
        for k in range(PLANS):
            data = posed(p, time=k * p.horizon.step)[2]
            s0 = np.asarray(ocp.start(state, before).full()).ravel()
            wanted = data[ocp.data.slice("reference"), 0]
            errors.append([state[names.index(n)] - wanted[place[n]] for n in p.plant.controlled or p.plant.names])
            found.append((s0, data))
            inputs = solve(s0, data, cold=k == 0)[0]
            if not np.isfinite(inputs).all():
                return found, float("nan")
            before = np.clip(inputs[:, 0], ocp.input_lower, ocp.input_upper)
            state = np.asarray(advance(state, before, real, np.zeros(len(p.plant.names))).full()).ravel()
        return found, float(np.sqrt(np.mean(np.square(errors[PLANS // 4 :]))))

    def adapted(self) -> float:
        """The same error with fixed-point iteration around the plans."""
        p = self.problem
        plan = fp.RecedingHorizon(fp.FixedPointSolver(), fp.ModelReferenced(fp.Affine(gain=-0.5)))
        same = replace(
            p, period=p.horizon.step, duration=PLANS * p.horizon.step, measure_from=PLANS // 4 * p.horizon.step
        )
        if self.right:
            values = {n: replace(v, exact=v.approximate) for n, v in p.plant.parameters.items()}
            same = replace(same, plant=replace(p.plant, parameters=values))
        found = fp.measure(same, fp.simulate(same, plan, seed=0)).rms_error
        return float(np.sqrt(np.mean([found[n] ** 2 for n in p.plant.controlled or p.plant.names])))


def clock(work: Callable[[], object]) -> float:
    """CPU seconds of a call, without those of the clock."""
    begin = time.process_time_ns()
    work()
    return max(time.process_time_ns() - begin - _clock_itself, 0) / 1e9


_clock_itself = 0
_clock_itself = int(1e9 * np.median([clock(lambda: None) for _ in range(2000)]))


class Called:
    """A Function of dense matrices with arrays of its own, in which a call takes a fraction of a microsecond."""

    def __init__(self, function: ca.Function) -> None:
        sides = (function.size_in, function.n_in()), (function.size_out, function.n_out())
        sizes = ([size(k) for k in range(count)] for size, count in sides)
        self.arguments, self.results = ([np.zeros(s[0] if s[1] == 1 else s[::-1]) for s in side] for side in sizes)
        self._buffer, self.evaluate = function.buffer()
        for put, arrays in ((self._buffer.set_arg, self.arguments), (self._buffer.set_res, self.results)):
            for k, array in enumerate(arrays):
                put(k, array.data)


def later(optimiser: Optimiser, ocp: Any) -> ca.Function:
    """The memory of an optimiser one stage later."""
    memory = ca.MX.sym("m", optimiser.memory(ocp).size)
    return ca.Function("later", [memory], [optimiser.shifted(ocp, memory)])


def ours(optimiser: Optimiser, ocp: Any) -> Solve:
    """A warm-started loop around a compiled step."""
    evaluator, begin, shift = Called(in_c(optimiser.step(ocp))), optimiser.memory(ocp).start(), later(optimiser, ocp)
    s0_, data_, lower, upper, memory = evaluator.arguments
    lower[...], upper[...] = ocp.input_lower, ocp.input_upper

    def solve(s0: np.ndarray, data: np.ndarray, *, cold: bool = False) -> tuple[np.ndarray, float]:
        memory[...] = begin if cold else shift(evaluator.results[2]).full().ravel()
        s0_[...], data_[...] = s0, data.T
        seconds = clock(evaluator.evaluate)
        return evaluator.results[0].reshape(ocp.stages, -1).T.copy(), seconds

    return solve


def predicted(ocp: Any) -> Callable[..., np.ndarray]:
    """Function (s0, inputs, data) -> states (ns, N + 1)."""
    rolled, free = reduced_gradient(ocp), np.zeros((ocp.state.size, ocp.stages))
    return lambda s0, inputs, data: np.asarray(rolled(s0, inputs, data, free)[2].full())


def shooting(kind: type[fp.Ipopt | fp.Fatrop], ocp: Any, *, compiled: bool = True, **settings: float) -> Solve:
    """The same around CasADi's solver alone, out of the optimiser's step, with its shifted variables and multipliers."""
    flags = FLAGS if ocp.dynamics.n_instructions() < LARGE else ["-O1"]
    how = {**JIT, "jit_options": {"flags": flags, "verbose": False}} if compiled else {}
    made = type(kind.__name__, (kind,), {"options": lambda self, of: {**kind.options(self, of), **how}})(**settings)
    [alone] = [f for f in made.step(ocp).find_functions() if f.name() == "fpirhc_shooting_solver"]
    solver, n, layout, predict = Called(alone), ocp.stages, made.memory(ocp), predicted(ocp)
    shift, begin, remembered = later(made, ocp), layout.start(), layout.start()
    argument = dict(zip(alone.name_in(), solver.arguments, strict=True))
    result = dict(zip(alone.name_out(), solver.results, strict=True))

    def column(states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        return np.append(np.vstack([states[:, :n], inputs]).ravel(order="F"), states[:, n])

    def solve(s0: np.ndarray, data: np.ndarray, *, cold: bool = False) -> tuple[np.ndarray, float]:
        nonlocal remembered
        memory = begin if cold else shift(remembered).full().ravel()
        guess = memory[layout.slice("plan_inputs")].reshape(n, -1).T
        for name, part in (("lam_x0", "plan_variable_multipliers"), ("lam_g0", "plan_dynamics_multipliers")):
            argument[name][...] = memory[layout.slice(part)]
        states = predict(s0, guess, data)
        argument["x0"][...] = column(states if np.isfinite(states).all() else np.tile(s0[:, None], n + 1), guess)
        argument["p"][...] = data.ravel(order="F")
        for name, state, box in (("lbx", ocp.state_lower, ocp.input_lower), ("ubx", ocp.state_upper, ocp.input_upper)):
            bounds = np.column_stack([s0, np.tile(state[:, None], n)])
            argument[name][...] = column(bounds, np.tile(box[:, None], n))
        try:
            seconds = clock(solver.evaluate)
        except RuntimeError:  # a solver that raises has no plan
            remembered = begin
            return np.full((ocp.input.size, n), np.nan), float("nan")
        inputs = result["x"][: -ocp.state.size].reshape(n, -1)[:, ocp.state.size :].copy()
        plan = np.concatenate([inputs.ravel(), result["lam_x"], result["lam_g"]])
        remembered = plan if np.isfinite(result["x"]).all() else begin
        return inputs.T, seconds

    return solve


def condensed(ocp: Any) -> Solve:
    """DAQP on the condensed program of a linear plant: bounds of all inputs, rows for limited states."""
    import daqp

    s0_, data_ = ca.MX.sym("s", ocp.state.size), ca.MX.sym("d", ocp.data.size, ocp.stages + 1)
    inputs = ca.MX.sym("U", ocp.input.size, ocp.stages)
    limited = np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper))
    _, by_input, states, _ = reduced_gradient(ocp)(s0_, inputs, data_, ca.DM.zeros(ocp.state.size, ocp.stages))
    rows, flat, slope = ca.vec(states[limited.tolist(), 1:]), ca.vec(inputs), ca.vec(by_input)
    free = ca.Function("free", [s0_, inputs, data_], [slope, rows])
    at_rest = [np.zeros(ocp.state.size), np.zeros(inputs.shape), ocp.nodes[2]]
    second = ca.Function("second", [s0_, inputs, data_], [ca.jacobian(slope, flat), ca.jacobian(rows, flat)])
    hessian, matrix = (np.ascontiguousarray(m.full()) for m in second(*at_rest))
    box, n, model = (ocp.input_lower, ocp.input_upper), ocp.stages, daqp.Model()

    def vectors(s0: np.ndarray, data: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        gradient, moved = (v.full().ravel() for v in free(s0, at_rest[1], data))
        bounds = [
            np.concatenate([np.tile(own, n), np.tile(state[limited], n) - moved])
            for own, state in zip(box, (ocp.state_lower, ocp.state_upper), strict=True)
        ]
        return gradient, bounds[0], bounds[1]

    def solve(s0: np.ndarray, data: np.ndarray, *, cold: bool = False) -> tuple[np.ndarray, float]:
        gradient, lower, upper = vectors(s0, data)
        if cold:
            model.setup(hessian, gradient, matrix, upper, lower)
        answer: list[Any] = []

        def work() -> None:
            model.update(f=gradient, bupper=upper, blower=lower)
            answer.extend(model.solve())

        seconds = clock(work)
        plan = answer[0].reshape(n, -1).T if answer[2] > 0 else np.full(inputs.shape, np.nan)
        return np.array(plan), seconds

    return solve


def acados(ocp: Any, horizons: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, Solve]:
    """Its RTI and its SQP, with the condensing QP solver with which SQP is quickest on these horizons."""
    taken, solvers = {}, {}
    for choice in acados_plans.choices(ocp.stages):
        solve = solvers[choice] = acados_plans.acados_plans(ocp, "SQP", choice, " ".join(FLAGS))
        taken[choice] = float(np.median([solve(*h, cold=not k)[1] for k, h in enumerate(horizons)]))
    best = min(taken, key=lambda choice: taken[choice])
    print(f"acados: {best} of { ({choice: f'{1e6 * t:.0f} us' for choice, t in taken.items()}) }", flush=True)
    return {"acados RTI": acados_plans.acados_plans(ocp, "RTI", best, " ".join(FLAGS)), "acados SQP": solvers[best]}


def ways(name: str, ocp: Any, horizons: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, Solve]:
    """Every solver, warm-started."""
    once = fp.FixedPointSolver(iterations=1, most_iterations=1 if ocp.bounds_states else 100)
    found = {OURS: ours(fp.FixedPointSolver(), ocp), ONCE: ours(once, ocp)}
    if name in LINEAR and _there("daqp"):
        found["DAQP"] = condensed(ocp)
    if _there("acados_template.acados_code_gen_options"):
        found |= acados(ocp, horizons)
    return {**found, "fatrop": shooting(fp.Fatrop, ocp), IPOPT: shooting(fp.Ipopt, ocp)}


def _there(package: str) -> bool:
    try:
        __import__(package)
    except ImportError:
        print(f"{package} is not installed: its columns are left out")
        return False
    return True


def timed(solvers: dict[str, Solve], horizons: list[tuple[np.ndarray, np.ndarray]]) -> tuple[dict[str, Any], dict]:
    """Plans of every solver, and its seconds per plan: the lower quartile of the passes."""
    plans, seconds = {}, {name: [] for name in solvers}
    for turn in range(PASSES):
        for name, solve in solvers.items():
            if turn and np.nansum(seconds[name]) > SPENT:
                continue
            every = [solve(s0, data, cold=COLD or not k) for k, (s0, data) in enumerate(horizons)]
            plans[name] = [one[0] for one in every]
            seconds[name].append([one[1] for one in every])
    return plans, {name: np.nanquantile(each, 0.25, axis=0) for name, each in seconds.items()}


def active(ocp: Any, horizons: list[tuple[np.ndarray, np.ndarray]], plans: list[np.ndarray]) -> np.ndarray:
    """Whether a limit is met in these plans, to 1e-4 of its range."""
    predict, boxes = predicted(ocp), ((ocp.state_lower, ocp.input_lower), (ocp.state_upper, ocp.input_upper))
    low, high = (np.concatenate(box)[:, None] for box in boxes)
    size = np.where(np.isfinite(high - low), high - low, 2.0)
    every = [np.vstack([predict(h[0], u, h[1])[:, 1:], u]) for h, u in zip(horizons, plans, strict=True)]
    return np.array([(np.minimum(values - low, high - values) < 1e-4 * size).any() for values in every])


def rows_of(name: str) -> tuple[list[dict[str, str]], list[dict[str, str]]]:
    """Rows of times and distances, and of errors of the closed loops."""
    times, errors, problem = [], [], LOOPS[name]()
    loops = {f"{word} model": Loop(problem, word == "right") for word in ("right", "wrong")}
    ocp = loops["right model"].ocp
    first, exact = ours(fp.FixedPointSolver(), ocp), shooting(fp.Ipopt, ocp, compiled=False, accuracy=1e-10)
    solvers = ways(name, ocp, loops["right model"].flown(first)[0])
    for which, loop in loops.items():
        horizons = loop.flown(first)[0]
        best = [exact(s0, data, cold=not k)[0] for k, (s0, data) in enumerate(horizons)]
        both, held = [timed(solvers, horizons) for _ in range(2)], active(ocp, horizons, best)
        title = f"{name} ({ocp.stages} x {ocp.state.size}), {which}"
        for chosen, what in ((~held, "inactive"), (held, "active")):
            chosen = chosen & (np.arange(len(held)) > 0)
            if chosen.sum() >= PLANS // 20:
                times.append({"loop": title, "limits": f"{what} in {chosen.sum()}", **cells(both, best, chosen)})
                print(times[-1], flush=True)
        own = {way: f"{loop.flown(solve)[1]:.4g}" for way, solve in solvers.items()}
        errors.append({"loop": title, **own, "with FPI": f"{loop.adapted():.4g}"})
        print(errors[-1], flush=True)
    return times, errors


def cells(both: list[tuple[dict, dict]], best: list[np.ndarray], chosen: np.ndarray) -> dict[str, str]:
    """For every solver the median time of the chosen plans, its ratio to ours (mean of both measurements), and the distance."""
    found, unit = {}, [np.median(seconds[OURS][chosen]) for _, seconds in both]
    for way, plans in both[0][0].items():
        middle = [np.median(seconds[way][chosen]) for _, seconds in both]
        away = [float(np.abs(p - b).max() / np.abs(b).max()) for p, b in zip(plans, best, strict=True)]
        away = np.array(away)[chosen]
        us, ratio = (float(np.exp(np.log(v).mean())) for v in (1e6 * np.array(middle), np.divide(middle, unit)))
        far = int((~(away < 1e-2)).sum())
        text = f"{us:.0f} us" if way == OURS else f"{ratio:.0f}" if ratio >= 10 else f"{ratio:.2g}"
        found[way] = f"{text}; {np.median(away):.0e}" + (f", {far} far" if far else "")
    return found


def main() -> None:
    """Measure the loops named on the command line, or all."""
    names = [a for a in sys.argv[1:] if not a.startswith("--")] or list(LOOPS)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    tables = [rows_of(name) for name in names]
    for k, title in enumerate(("speed", "speed in loops")):
        rows = [row for table in tables for row in table[k]]
        heads = [head for head in dict.fromkeys(head for row in rows for head in row) if not k or head not in ALIKE]
        write_table(title, heads, [[row.get(head, "") for head in heads] for row in rows])
    print(acados_plans.version())


if __name__ == "__main__":
    main()
