"""The iteration of `FixedPoint` on horizons with limits of states, and where its plain iteration does not contract.

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import resources

import casadi as ca
import numpy as np

from fpirhc.horizon.hessian_models import (
    ExactHessian,
    GaussNewton,
    hessian_end,
    hessian_stage,
    partial_count,
    split_hessian,
    split_stage,
)
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.riccati import PIVOT
from fpirhc.optimisers import limited_settings as constants
from fpirhc.optimisers.base import FEASIBLE, KEPT, LAST, plan_library, shift, shift_gains, with_last
from fpirhc.optimisers.bounds import BOUNDARY, ENOUGH, HAIR, STIFF, Scales, scales
from fpirhc.optimisers.limited_graph import limited_graph
from fpirhc.optimisers.limited_phases import guess
from fpirhc.optimisers.limited_settings import LimitedSettings, limited_memory
from fpirhc.optimisers.search import deformed_move
from fpirhc.status import Status
from fpirhc.symbolic.driver import Driver, plans_are_compiled, with_driver
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import FINITE
from fpirhc.symbolic.native import Native

_TEXTS = ("kernels", "limited_sweep", "limited_bounds", "limited")


def limited_step(ocp: OptimalControl, settings: LimitedSettings) -> ca.Function:
    """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory)."""
    if plans_are_compiled():
        alike = replace(settings, iterations=0)
        library = _LIBRARIES.of((ocp, settings.map), (alike,), lambda: _library(ocp, alike))
        if library.compiled:
            return with_last(ocp, library.function, settings.iterations)
    return with_driver("fpirhc_limited", _driver(ocp, settings), lambda name: limited_graph(ocp, settings, name))


def _library(ocp: OptimalControl, settings: LimitedSettings) -> Native:
    """The driver alone as a library, whose last argument is the number of iterations that a call may take."""
    driver = _driver(ocp, settings, LAST)
    return plan_library(ocp, "fpirhc_limited_both", driver, limited_memory(ocp).size)


_LIBRARIES: Latest[Native] = Latest(8)


def shifted_limited(ocp: OptimalControl, memory: ca.MX) -> ca.MX:
    """Return the memory one stage later; the last stage, which is repeated, has no feedback."""
    layout, n, nu, ns = limited_memory(ocp), ocp.stages, ocp.input.size, ocp.state.size
    parts = layout.split(memory)
    rows = layout["plan_multipliers"].size // (2 * n)
    sides = ca.horzsplit(ca.reshape(parts["plan_multipliers"], rows, 2 * n), n)
    shifted_parts: dict[str, ca.MX] = {
        name: ca.vec(shift(ca.reshape(parts[name], size, n), ocp, node))
        for name, size, node in (("plan_inputs", nu, 0), ("plan_states", ns, 1), ("plan_costates", ns, 1))
    }
    shifted_parts["plan_gains"] = shift_gains(parts["plan_gains"], nu * ns, ocp)
    shifted_parts["plan_multipliers"] = ca.vec(ca.horzcat(*(shift(side, ocp) for side in sides)))
    return layout.join({**parts, **shifted_parts})


def _driver(ocp: OptimalControl, settings: LimitedSettings, iterations: str = "") -> Driver:
    """The loops in C with what they call; `iterations` are those of the settings unless the text is given."""
    measures = scales(ocp)
    leaves = {
        "evaluate": split_stage(ocp)["evaluate"],
        "linearise": split_stage(ocp)["linearise"],
        **split_hessian(ocp, settings.hessian or ExactHessian()),
        "plain": hessian_stage(ocp, GaussNewton()),
        "end": hessian_end(ocp),
        "deformed": deformed_move(settings.map, ocp.input.size * ocp.stages),
        "guess": guess(ocp),
    }
    folder = resources.files("fpirhc.optimisers")
    texts = [folder.joinpath(f"{name}.c").read_text(encoding="utf-8") for name in _TEXTS]
    sizes = {"NM": partial_count(ocp), "NH": leaves["curve"].numel_in(0), **_sizes(ocp, measures)}
    constants = {**sizes, **_constants(settings, measures), "ITERATIONS": iterations or settings.iterations}
    return Driver("\n".join(texts), leaves, constants, _room(ocp, measures))


def _room(ocp: OptimalControl, measures: Scales) -> int:
    """Numbers of the struct Room of limited.c."""
    nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
    inputs, states, limits = n * nu, (n + 1) * ns, n * (nu + len(measures.bounded))
    point = 2 * inputs + states + n * ns * (2 + ns + nu) + ns + ns * ns + 1
    direction = 2 * inputs + inputs * ns + 2 * states
    kept = 2 * inputs + 2 * states + 6 * limits + n * ns
    shared = max(states * (ns + 1) + 6 * limits, n * partial_count(ocp))
    return 2 * point + 2 * 6 * limits + direction + kept + shared


def _sizes(ocp: OptimalControl, measures: Scales) -> dict[str, object]:
    places = list(measures.bounded)
    return {
        "NS": ocp.state.size,
        "NU": ocp.input.size,
        "NT": ocp.data.size,
        "N": ocp.stages,
        "NB": len(places),
        "MEMORY": limited_memory(ocp).size,
        "PLACES": _row(np.array([*places, 0])),
        "CURVATURE": _row(ocp.step * ocp.curvature),
        "UNITS": _row(np.append(measures.rows, 1.0)),
        "SPREADS": _row(measures.states),
        "CAPACITIES": _row(np.append(measures.capacity, 0.0)),
        "HARD": _row(np.append(measures.hard.astype(float), 0.0)),
        "STATE_LOWER": _row(np.append(ocp.state_lower[places], 0.0)),
        "STATE_UPPER": _row(np.append(ocp.state_upper[places], 0.0)),
    }


def _constants(settings: LimitedSettings, measures: Scales) -> dict[str, object]:
    statuses = {
        "CONVERGED": Status.OK,
        **{s.name: s for s in (Status.NOT_CONVERGED, Status.INFEASIBLE, Status.NON_FINITE)},
    }
    return {
        **{name: value for name, value in vars(constants).items() if name.isupper()},
        **{name: int(status) for name, status in statuses.items()},
        "COST": repr(float(measures.cost)),
        "ENOUGH": ENOUGH,
        "STIFF": STIFF,
        "BOUNDARY": BOUNDARY,
        "HAIR": HAIR,
        "PIVOT": PIVOT,
        "NEAR_LIMIT": FEASIBLE,
        "KEPT_SHARE": KEPT,
        "ROUNDING": f"OF_TYPE({constants.ROUNDING}, 1e-5)",
        "DAMPING": repr(float(settings.damping)),
        "TOLERANCE": repr(float(settings.tolerance)),
        "FEASIBLE": repr(float(settings.feasible)),
        "SCALED_TOLERANCE": repr(settings.scaled_tolerance(measures)),
        "PLAIN_FIRST": int(settings.plain_first),
    }


def _row(values: np.ndarray) -> str:
    """A C initialiser; infinities become numbers beyond every finite one."""
    texts = (repr(v) if abs(v) <= FINITE else "-10 * FINITE" if v < 0 else "10 * FINITE" for v in values.tolist())
    return "{" + ", ".join(texts) + "}"
