"""The iteration of `FixedPoint` on horizons without limits of states: as loops in C, or as one composed graph."""

from __future__ import annotations

from importlib import resources

import casadi as ca

from fpirhc.horizon.hessian_models import hessian_end, hessian_stage
from fpirhc.horizon.live_data import SCALE, STEEPEST
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.riccati import PIVOT, rounds
from fpirhc.horizon.split_stage import partial_count, stage_leaves
from fpirhc.optimisers.anchor import ARMIJO, DRAWN_IN, ROUNDING, SHARE, SHORTER, SHORTEST, UNTRIED
from fpirhc.optimisers.base import shift, shift_gains
from fpirhc.optimisers.plain_graph import plain_graph
from fpirhc.optimisers.plain_settings import MOST_PLAIN, PlainSettings, plain_memory
from fpirhc.optimisers.search import deformed_move, first_gamma
from fpirhc.status import Status
from fpirhc.symbolic.driver import Driver, with_driver
from fpirhc.symbolic.expression import FINITE
from fpirhc.symbolic.live import LiveNumber, Number

_TEXTS = ("kernels", "fixed_point", "entry")


def plain_step(ocp: OptimalControl, settings: PlainSettings) -> ca.Function:
    """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory)."""
    name = "fpirhc_fixed_point_converging" if settings.converging else "fpirhc_fixed_point"
    return with_driver(name, plain_driver(ocp, settings), lambda unique: plain_graph(ocp, settings, unique))


def shifted_plain(ocp: OptimalControl, memory: ca.MX) -> ca.MX:
    """Return the memory one stage later; the last stage, which is repeated, has no feedback."""
    layout, ns, nu, n = plain_memory(ocp), ocp.state.size, ocp.input.size, ocp.stages
    parts = layout.split(memory)
    shifted_parts = {
        "plan_inputs": ca.vec(shift(ca.reshape(parts["plan_inputs"], nu, n))),
        "plan_states": ca.vec(shift(ca.reshape(parts["plan_states"], ns, n))),
        "plan_gains": shift_gains(parts["plan_gains"], nu * ns),
    }
    return layout.join({**parts, **shifted_parts})


def plain_driver(ocp: OptimalControl, settings: PlainSettings) -> Driver:
    """Return the loops in C with what they call."""
    stage, linearise = stage_leaves(ocp, ("evaluate", "pull"))
    leaves = {
        **stage,
        "hessian": hessian_stage(ocp, settings.hessian),
        "end": hessian_end(ocp),
        "deformed": deformed_move(settings.map, ocp.input.size * ocp.stages),
    }
    folder = resources.files("fpirhc.optimisers")
    texts = [folder.joinpath(f"{name}.c").read_text(encoding="utf-8") for name in _TEXTS]
    texts.insert(1, linearise)
    return Driver("\n".join(texts), leaves, {**_sizes(ocp), **_metric(ocp), **_constants(ocp, settings)})


def _sizes(ocp: OptimalControl) -> dict[str, object]:
    return {
        "NS": ocp.state.size,
        "NU": ocp.input.size,
        "NT": ocp.data.size,
        "NM": partial_count(ocp),
        "N": ocp.stages,
        "MEMORY": plain_memory(ocp).size,
    }


def _metric(ocp: OptimalControl) -> dict[str, object]:
    """Definitions of the scale and of the first gamma: numbers, or places in the data where settings are live."""
    if ocp.settings:
        return {"SCALE_AT": ocp.data.slice(SCALE).start, "STEEPEST_AT": ocp.data.slice(STEEPEST).start}
    scale = ", ".join(repr(float(v)) for v in ocp.scale)
    return {"SCALE": f"{{{scale}}}", "FIRST_GAMMA": repr(first_gamma(ocp))}


def _number(ocp: OptimalControl, number: Number) -> str:
    """A number of the code, or its place in the data of the first stage where it is live."""
    return f"data[{ocp.place_of(number)}]" if isinstance(number, LiveNumber) else repr(float(number))


def _constants(ocp: OptimalControl, settings: PlainSettings) -> dict[str, object]:
    return {
        "ITERATIONS": settings.iterations,
        "STOP_EARLY": int(settings.converging),
        "TOLERANCE": _number(ocp, settings.tolerance),
        "DAMPING": _number(ocp, settings.damping),
        "SHARE": SHARE,
        "ARMIJO": ARMIJO,
        "SHORTER": SHORTER,
        "SHORTEST": SHORTEST,
        "DRAWN_IN": DRAWN_IN,
        "ROUNDING": ROUNDING,
        "PLAIN": MOST_PLAIN,
        "UNTRIED": UNTRIED,
        "FINITE": FINITE,
        "PIVOT": PIVOT,
        "ROUNDS": rounds(ocp.input.size),
        "CONVERGED": int(Status.OK),
        "NOT_CONVERGED": int(Status.NOT_CONVERGED),
        "INFEASIBLE": int(Status.INFEASIBLE),
        "NON_FINITE": int(Status.NON_FINITE),
    }
