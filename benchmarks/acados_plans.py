"""Plans of acados on a horizon in standard form: the same Functions of dynamics and cost, SQP with HPIPM, limits of states hard.

Its Hessian is that of the cost alone, for every stage; `exact` adds that of the dynamics. Seconds are those that acados tells.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl

_names = itertools.count()
_generated = tempfile.TemporaryDirectory(prefix="acados")


def again_with_acados() -> None:
    """Start again with the folders that acados asks for in its environment."""
    import acados

    inside = Path(acados.DIR) / "interfaces" / "acados_template"
    inside.mkdir(parents=True, exist_ok=True)
    if not (inside / "acados_template").exists():
        (inside / "acados_template").symlink_to(Path(acados.__file__).parent / "acados_template")
    wanted = {"ACADOS_SOURCE_DIR": acados.DIR, "TERA_PATH": acados.TERA_PATH, "LD_LIBRARY_PATH": acados.LIB_DIR}
    sys.path.insert(0, str(Path(acados.__file__).parent))
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **wanted})


def acados_plans(
    ocp: OptimalControl, *, exact: bool, accuracy: float
) -> Callable[..., tuple[np.ndarray, float, np.ndarray]]:
    """A warm-started solver: (s0, data) -> (inputs, seconds, diagnostics)."""
    solver, n = _built(ocp, exact=exact, accuracy=accuracy), ocp.stages
    begun = False

    def solve(s0: np.ndarray, data: np.ndarray, *, cold: bool = False) -> tuple[np.ndarray, float, np.ndarray]:
        nonlocal begun
        if cold or not begun:
            solver.reset()
            for k in range(n + 1):
                solver.set(k, "x", s0)
        solver.set(0, "lbx", s0)
        solver.set(0, "ubx", s0)
        for k in range(n + 1):
            solver.set(k, "p", data[:, k])
        status = solver.solve()
        inputs = np.array([solver.get(k, "u") for k in range(n)]).T
        seconds, iterations = (float(np.ravel(solver.get_stats(name))[0]) for name in ("time_tot", "sqp_iter"))
        begun = bool(np.isfinite(inputs).all()) and status in (0, 2)  # else from nothing again; 2: out of iterations
        _shift(solver, n)
        return inputs, seconds, np.array([0.0, 0.0, 0.0, iterations, float(status != 0)])

    return solve


def _shift(solver: Any, stages: int) -> None:
    """One stage later; the last one is repeated."""
    for name, ends in (("x", stages), ("u", stages - 1), ("pi", stages - 1)):
        for k in range(ends):
            solver.set(k, name, solver.get(k + 1, name))


def _built(ocp: OptimalControl, *, exact: bool, accuracy: float) -> Any:
    from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

    model, made = AcadosModel(), AcadosOcp()
    s, u, p = (ca.SX.sym(n, k) for n, k in (("s", ocp.state.size), ("u", ocp.input.size), ("p", ocp.data.size)))
    model.name, model.x, model.u, model.p = f"horizon{next(_names)}", s, u, p
    model.disc_dyn_expr = ocp.dynamics(s, u, p)
    model.cost_expr_ext_cost = ocp.stage_cost(s, u, p)[0]
    model.cost_expr_ext_cost_e = ocp.terminal_cost(s, p)
    made.model, made.dims.N, made.parameter_values = model, ocp.stages, np.zeros(ocp.data.size)
    made.cost.cost_type = made.cost.cost_type_e = "EXTERNAL"
    own = made.constraints
    bounded = np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper))
    low, high = (np.clip(v, -1e8, 1e8) for v in (ocp.state_lower[bounded], ocp.state_upper[bounded]))
    own.idxbx, own.lbx, own.ubx = bounded, low, high
    own.idxbx_e, own.lbx_e, own.ubx_e = bounded, low, high
    own.idxbu, own.lbu, own.ubu = np.arange(ocp.input.size), ocp.input_lower, ocp.input_upper
    own.x0 = np.zeros(ocp.state.size)
    options = made.solver_options
    options.tf = float(ocp.stages)  # a stage's cost counts once, as it stands
    options.qp_solver, options.integrator_type, options.nlp_solver_type = "PARTIAL_CONDENSING_HPIPM", "DISCRETE", "SQP"
    options.hessian_approx = "EXACT" if exact else "GAUSS_NEWTON"
    options.regularize_method = "CONVEXIFY" if exact else "NO_REGULARIZE"
    options.nlp_solver_max_iter, options.qp_solver_warm_start = 200, 1
    options.nlp_solver_tol_stat = options.nlp_solver_tol_eq = accuracy
    options.nlp_solver_tol_ineq = options.nlp_solver_tol_comp = accuracy
    options.globalization = "MERIT_BACKTRACKING"
    with contextlib.chdir(_generated.name):  # acados writes its C beside the caller otherwise
        return AcadosOcpSolver(made, json_file=f"{model.name}.json")
