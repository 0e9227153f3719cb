"""acados' pendulum on a cart: acados' plans and ours from the same states, with the right model and with a wrong one.

    acados by its own instructions, with ACADOS_SOURCE_DIR and LD_LIBRARY_PATH set, or
    pip install comma-deps-acados && pip install --no-deps --force-reinstall casadi      (the wheel brings a casadi of its own)
    .venv/bin/python benchmarks/beside_acados.py [--write]          a minute; --write puts the table into docs/beside.md

Model, first state, weights, limits, 40 stages of 20 ms and a plan in every stage are those of acados' closed-loop example
(examples/acados_python/getting_started): from hanging at rest to upright, |F| <= 80 N. Both discretise by one Runge-Kutta step
per stage, so they solve the same problem. The simulator is scipy's DOP853 at 1e-10. The cost is the example's, summed over the
states and commands of 3 s, from rest at three angles. Difference is the largest one of a command from that of acados, and time the
median CPU time of a command, both from 0.3 rad with the right masses.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import fpirhc as fp

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]
from acados_plans import again_with_acados, version  # noqa: E402
from beside import Step, flown, ours  # noqa: E402
from table import write_table  # noqa: E402

PERIOD, STAGES, CYCLES = 0.02, 40, 150
HANGING, LEANING, NEAR = (np.array([0.0, angle, 0.0, 0.0]) for angle in (np.pi, 1.0, 0.3))
WEIGHTS, EFFORT, MOST = (1e3, 1e3, 1e-2, 1e-2), 1e-2, 80.0
MODEL = {"M": 1.0, "m": 0.1, "l": 0.8}
HEAVY = {"M": 1.5, "m": 0.2, "l": 0.8}  # what the plans do not know


def accelerations(angle: Any, rate: Any, force: Any, p: Any) -> tuple[Any, Any]:
    """X'' and angle'' of the example; the angle is 0 upright."""
    s, c = ca.sin(angle), ca.cos(angle)
    mass = p["M"] + p["m"] - p["m"] * c**2
    x = (-p["m"] * p["l"] * s * rate**2 + p["m"] * 9.81 * c * s + force) / mass
    turn = (-p["m"] * p["l"] * c * s * rate**2 + force * c + (p["M"] + p["m"]) * 9.81 * s) / (p["l"] * mass)
    return x, turn


def mover(values: dict[str, float]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The simulator with these masses and this length."""

    def rates(_: float, x: np.ndarray, force: float) -> np.ndarray:
        return np.array([x[2], x[3], *map(float, accelerations(x[1], x[3], force, values))])

    def move(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        run = solve_ivp(
            rates, (0.0, PERIOD), x, "DOP853", args=(float(np.clip(u[0], -MOST, MOST)),), rtol=1e-10, atol=1e-10
        )
        return np.asarray(run.y[:, -1])

    return move


def theirs(*, once: bool) -> Step:
    """Acados' example; once: one iteration per plan (SQP_RTI), else until it has converged."""
    from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

    model, x, u, xdot = AcadosModel(), ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("xdot", 4)
    model.name, model.x, model.u, model.xdot = f"cart{'_once' if once else ''}", x, u, xdot
    model.f_expl_expr = ca.vertcat(x[2], x[3], *accelerations(x[1], x[3], u, MODEL))
    model.f_impl_expr = xdot - model.f_expl_expr
    ocp = AcadosOcp()
    ocp.model, ocp.dims.N, ocp.solver_options.tf = model, STAGES, STAGES * PERIOD
    ocp.cost.cost_type = ocp.cost.cost_type_e = "LINEAR_LS"
    ocp.cost.W, ocp.cost.W_e = 2 * np.diag([*WEIGHTS, EFFORT]), 2 * np.diag(WEIGHTS)
    ocp.cost.Vx, ocp.cost.Vu = np.vstack([np.eye(4), np.zeros((1, 4))]), np.array([[0.0]] * 4 + [[1.0]])
    ocp.cost.Vx_e, ocp.cost.yref, ocp.cost.yref_e = np.eye(4), np.zeros(5), np.zeros(4)
    ocp.constraints.lbu, ocp.constraints.ubu, ocp.constraints.idxbu = np.array([-MOST]), np.array([MOST]), np.array([0])
    ocp.constraints.x0 = HANGING
    ocp.solver_options.qp_solver, ocp.solver_options.hessian_approx = "PARTIAL_CONDENSING_HPIPM", "GAUSS_NEWTON"
    ocp.solver_options.integrator_type, ocp.solver_options.sim_method_num_steps = "ERK", 1
    ocp.solver_options.nlp_solver_type, ocp.solver_options.nlp_solver_max_iter = "SQP_RTI" if once else "SQP", 200
    with contextlib.chdir(tempfile.mkdtemp(prefix="acados")):  # it writes its C beside the caller otherwise
        solver = AcadosOcpSolver(ocp, json_file=f"{model.name}.json")

    def step(_: float, state: np.ndarray) -> np.ndarray:
        for bound in ("lbx", "ubx"):
            solver.set(0, bound, state)
        solver.solve()  # out of iterations it has a plan too
        return np.asarray(solver.get(0, "u"))

    return step


def task(start: np.ndarray, values: dict[str, float]) -> fp.Problem:
    """The example from this start, with these values for the controller that knows them."""
    plant = fp.Plant(
        coordinates={"x": "m", "angle": "rad"},
        inputs={"F": "N"},
        controlled=("x",),
        response=lambda q, v, u, p: dict(
            zip(("x", "angle"), accelerations(q.angle, v.angle, u.F, {n: getattr(p, n) for n in MODEL}), strict=True)
        ),
        parameters={n: fp.Parameter(MODEL[n], values[n], "m" if n == "l" else "kg") for n in MODEL},
    )
    names = ("x", "angle", "x'", "angle'")
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"x": 0 * t, "angle": 0 * t}),
        start=dict(zip(names, map(float, start), strict=True)),
        period=PERIOD,
        duration=CYCLES * PERIOD,
        sensing=fp.Sensing(estimator=fp.VelocityDifference()),
        limits=fp.Limits(inputs={"F": (-MOST, MOST)}),
        horizon=fp.Horizon(stages=STAGES, step=PERIOD),
        cost=fp.Quadratic(
            states=dict(zip(names, WEIGHTS, strict=True)),
            effort={"F": EFFORT},
            terminal=dict(zip(names, WEIGHTS, strict=True)),
        ),
    )


def cost(states: np.ndarray, commands: np.ndarray) -> float:
    """The example's, of a whole run."""
    return PERIOD * float((states[:-1] ** 2 @ np.array(WEIGHTS)).sum() + EFFORT * (commands**2).sum())


plain = fp.RecedingHorizon(fp.FixedPointSolver(iterations=60, tolerance=1e-6))
filter_ = fp.DisturbanceKalman(
    drift={"x": 100.0, "angle": 100.0}, measured={"x": 1e-3, "angle": 1e-3, "x'": 1e-2, "angle'": 1e-2}
)
OURS = {
    "RHC": plain,
    "RHC+FPI, model-referenced": fp.RecedingHorizon(plain.optimiser, fp.ModelReferenced(fp.Affine(gain=-0.5))),
    "RHC offset-free": fp.Estimating(plain, filter_),
    "RHC, knows the values": fp.ExactModel(plain),
}


def main() -> None:
    """Fly every controller with the right masses and with the wrong ones, and print a row for each."""
    makers: dict[str, Callable[[fp.Problem], Step]] = {
        "acados, converged": lambda _: theirs(once=False),
        "acados, one iteration": lambda _: theirs(once=True),
        **{f"fpirhc, {name}": lambda problem, one=one: ours(problem, one) for name, one in OURS.items()},
    }
    cases = ((HANGING, MODEL), (LEANING, MODEL), (NEAR, MODEL), (NEAR, HEAVY))
    flights = {
        name: [flown(make(task(x, v)), x, mover(v), PERIOD, CYCLES) for x, v in cases] for name, make in makers.items()
    }
    unit, reference = flights["fpirhc, RHC"][2][2], flights["acados, converged"][2][1]
    rows = [
        (
            name,
            *(f"{cost(states, commands):.5g}" for states, commands, _ in own),
            f"{np.abs(own[2][1] - reference).max():.2g}",
            f"{own[2][2] / unit:.2g}",
        )
        for name, own in flights.items()
    ]
    heads = ["controller", "from pi", "from 1 rad", "from 0.3 rad", "from 0.3 rad, wrong masses", "difference, N"]
    write_table("beside acados", [*heads, "time of a command"], rows, ROOT / "docs" / "beside.md")
    print(f"A command of fpirhc's RHC takes {unit:.3g} ms; {version()}.")


if __name__ == "__main__":
    again_with_acados()
    main()
