"""Plans of acados on a horizon in standard form: the same Functions of dynamics and cost, limits of states hard.

Its Hessian is that of the cost alone, for every stage, and it takes full steps. Seconds are `time_tot`, or the CPU time of `solve`
where that is less.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

_names = itertools.count()
_generated = tempfile.TemporaryDirectory(prefix="acados")


def again_with_acados() -> None:
    """Start again with the folders that the wheel of acados asks for in its environment; one from sources has them set."""
    try:
        import acados
    except ImportError:
        return
    inside = Path(acados.DIR) / "interfaces" / "acados_template"
    inside.mkdir(parents=True, exist_ok=True)
    if not (inside / "acados_template").exists():
        (inside / "acados_template").symlink_to(Path(acados.__file__).parent / "acados_template")
    wanted = {"ACADOS_SOURCE_DIR": acados.DIR, "TERA_PATH": acados.TERA_PATH, "LD_LIBRARY_PATH": acados.LIB_DIR}
    sys.path.insert(0, str(Path(acados.__file__).parent))
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **wanted})


def version() -> str:
    """Which acados this is: the commit of its sources, or the wheel."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return f"comma-deps-acados {importlib.metadata.version('comma-deps-acados')}"
    command = ["git", "-C", os.environ.get("ACADOS_SOURCE_DIR", os.devnull), "rev-parse", "--short=8", "HEAD"]
    return f"acados {subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or 'unknown'}"


def choices(stages: int) -> list[tuple[str, int]]:
    """QP solvers and numbers of blocks to choose from; DAQP where this acados has it."""
    interior = [("PARTIAL_CONDENSING_HPIPM", stages), ("PARTIAL_CONDENSING_HPIPM", stages // 4)]
    has_daqp = any(Path(os.environ["ACADOS_SOURCE_DIR"]).glob("lib/libdaqp*"))
    return [*interior, ("FULL_CONDENSING_DAQP", stages)] if has_daqp else interior


def acados_plans(ocp: Any, kind: str, choice: tuple[str, int], flags: str) -> Callable[..., Any]:
    """A warm-started SQP or RTI: (s0, data, cold=False) -> (inputs, seconds).

    Args:
        flags: of the compiler of the Functions.
    """
    solver, n = _built(ocp, kind, *choice, flags), ocp.stages
    begun, sizes = False, {"x": ocp.state.size, "u": ocp.input.size, "pi": ocp.state.size}

    def later() -> None:
        """One stage later; the last one is repeated."""
        for name, size in sizes.items():
            column = solver.get_flat(name)
            solver.set_flat(name, np.concatenate([column[size:], column[-size:]]))

    def solve(s0: np.ndarray, data: np.ndarray, *, cold: bool = False) -> tuple[np.ndarray, float]:
        nonlocal begun
        if cold or not begun:
            solver.reset()
            solver.set_flat("x", np.tile(s0, n + 1))
        else:
            later()
        for bound in ("lbx", "ubx"):
            solver.set(0, bound, s0)
        solver.set_flat("p", data.ravel(order="F"))
        begin = time.process_time_ns()
        status = solver.solve()
        taken = (time.process_time_ns() - begin) / 1e9
        inputs = np.array(solver.get_flat("u")).reshape(n, -1).T
        begun = bool(np.isfinite(inputs).all()) and status in (0, 2, 5)  # 2: out of iterations, 5: an RTI step is ready
        return inputs, min(taken, float(np.ravel(solver.get_stats("time_tot"))[0]))

    return solve


def _built(ocp: Any, kind: str, quadratic: str, blocks: int, flags: str) -> Any:
    from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

    model, made = AcadosModel(), AcadosOcp()
    s, u, p = (ca.SX.sym(n, k) for n, k in (("s", ocp.state.size), ("u", ocp.input.size), ("p", ocp.data.size)))
    model.name, model.x, model.u, model.p = f"horizon{next(_names)}", s, u, p
    model.disc_dyn_expr = ocp.dynamics(s, u, p)
    model.cost_expr_ext_cost = ocp.stage_cost(s, u, p)[0]
    model.cost_expr_ext_cost_e = ocp.terminal_cost(s, p)
    made.model, made.parameter_values = model, np.zeros(ocp.data.size)
    made.cost.cost_type = made.cost.cost_type_e = "EXTERNAL"
    own = made.constraints
    bounded = np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper))
    low, high = (np.clip(v, -1e8, 1e8) for v in (ocp.state_lower[bounded], ocp.state_upper[bounded]))
    own.idxbx, own.lbx, own.ubx = bounded, low, high
    own.idxbx_e, own.lbx_e, own.ubx_e = bounded, low, high
    own.idxbu, own.lbu, own.ubu = np.arange(ocp.input.size), ocp.input_lower, ocp.input_upper
    own.x0 = np.zeros(ocp.state.size)
    options = made.solver_options
    options.N_horizon, options.tf = ocp.stages, float(ocp.stages)  # a stage's cost counts once, as it stands
    options.qp_solver, options.integrator_type = quadratic, "DISCRETE"
    options.nlp_solver_type = "SQP_RTI" if kind == "RTI" else "SQP"
    if quadratic.startswith("PARTIAL"):
        options.qp_solver_cond_N = blocks
    options.hessian_approx = "GAUSS_NEWTON"
    options.nlp_solver_max_iter, options.qp_solver_warm_start = 200, 1
    made.code_gen_options.ext_fun_compile_flags = flags
    with contextlib.chdir(_generated.name):  # acados writes its C beside the caller otherwise
        return AcadosOcpSolver(made, json_file=f"{model.name}.json", verbose=False)
