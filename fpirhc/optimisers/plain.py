"""The iteration of `FixedPointSolver` on horizons without limits of states: as loops in C, or as one composed graph."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.errors import CompileError, NotInstalled
from fpirhc.horizon.hessian_models import HessianModel, hessian_end, hessian_stage, partial_count, split_stage
from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers import LAST, clip, compiled_plan, sane, shift, shift_gains, stationarity, status_of, with_last
from fpirhc.optimisers import search as line_search
from fpirhc.optimisers.search import BOX_PIVOT, Anchor, Arguments, Search, deformed_move, first_gamma, rounds
from fpirhc.status import Status
from fpirhc.symbolic.driver import Driver, plans_are_compiled, with_driver
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import FINITE, is_finite
from fpirhc.symbolic.layout import Layout, Signal, scalar

MOST = 100  # iterations of one converging call
CAP = 50  # the same of one in a loop
CLOSE = 1e-4  # of the size of an input: the tolerance unless one is given
_MOST_PLAIN = 30  # plain steps after which a converging call gives up
_TEXTS = ("kernels", "fixed_point")


@dataclass(frozen=True)
class PlainSettings:
    """Settings of one Function."""

    tolerance: float  # of the stationarity, in the unit of the inputs
    map: Deformation  # the deformation that makes the next plan
    hessian: HessianModel  # second derivatives of the quadratic model
    damping: float  # added to the curvature of the inputs, in units of it
    iterations: int  # of one call that does not converge; 0: it ends where the plan is solved, after at most `CAP`
    converging: bool  # whether a call goes on until the tolerance is met

    @property
    def most(self) -> int:
        """Most iterations of one call."""
        return MOST if self.converging else self.iterations or CAP

    @property
    def ends(self) -> bool:
        """Whether a call ends where the plan is solved."""
        return self.converging or not self.iterations

    @property
    def stops(self) -> dict[str, object]:
        """Definitions for the loops in C of when a call ends."""
        return {"STOP_EARLY": int(self.ends), "CONVERGING": int(self.converging), "ITERATIONS": self.most}


def plain_memory(ocp: OptimalControl) -> Layout:
    """Return the layout of the plan, its states and feedback, and the line search's step lengths."""
    n, state, inputs = ocp.stages, ocp.state.elements, ocp.input.elements
    return Layout(
        (
            Signal("plan_inputs", tuple(f"{i}@{k}" for k in range(n) for i in inputs)),
            Signal("plan_states", tuple(f"{s}@{k}" for k in range(n) for s in state)),
            Signal("plan_gains", tuple(f"{i}/{s}@{k}" for k in range(n) for s in state for i in inputs)),
            scalar("plan_gamma"),
            scalar("plan_step"),
        )
    )


def plain_step(ocp: OptimalControl, settings: PlainSettings) -> ca.Function:
    """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory)."""
    with contextlib.suppress(NotInstalled, CompileError):
        if plans_are_compiled():
            alike = replace(settings, converging=False)
            library = _LIBRARIES.of((ocp, settings.map), (alike,), lambda: _library(ocp, alike))
            return with_last(ocp, library, int(settings.converging))
    name = "fpirhc_fixed_point_converging" if settings.converging else "fpirhc_fixed_point"
    driver = plain_driver(ocp, settings, settings.stops)
    return with_driver(name, driver, lambda unique: plain_graph(ocp, settings, unique))


def _library(ocp: OptimalControl, settings: PlainSettings) -> ca.Function:
    """The driver alone as a library, whose last argument says whether a call stops where the plan is converged."""
    converging = f"({LAST} > 0)"
    stops: dict[str, object] = {
        "STOP_EARLY": converging if settings.iterations else "1",
        "CONVERGING": converging,
        "ITERATIONS": f"({converging} ? {MOST} : {settings.iterations or CAP})",
    }
    driver = plain_driver(ocp, settings, stops)
    return compiled_plan(ocp, "fpirhc_fixed_point_both", driver, plain_memory(ocp).size)


_LIBRARIES: Latest[ca.Function] = Latest(8)


def shifted_plain(ocp: OptimalControl, memory: ca.MX) -> ca.MX:
    """Return the memory one stage later; the last stage, which is repeated, has no feedback."""
    layout, ns, nu, n = plain_memory(ocp), ocp.state.size, ocp.input.size, ocp.stages
    parts = layout.split(memory)
    shifted_parts = {
        "plan_inputs": ca.vec(shift(ca.reshape(parts["plan_inputs"], nu, n), ocp)),
        "plan_states": ca.vec(shift(ca.reshape(parts["plan_states"], ns, n), ocp)),
        "plan_gains": shift_gains(parts["plan_gains"], nu * ns, ocp),
    }
    return layout.join({**parts, **shifted_parts})


def plain_driver(ocp: OptimalControl, settings: PlainSettings, stops: Mapping[str, object]) -> Driver:
    """Return the loops in C with what they call; `stops` are the definitions of when a call ends."""
    leaves = {
        **split_stage(ocp),
        "hessian": hessian_stage(ocp, settings.hessian),
        "end": hessian_end(ocp),
        "deformed": deformed_move(settings.map, ocp.input.size * ocp.stages),
    }
    folder = resources.files("fpirhc.optimisers")
    texts = [folder.joinpath(f"{name}.c").read_text(encoding="utf-8") for name in _TEXTS]
    hessian = leaves["hessian"]
    needed = any(hessian.jac_sparsity(k, 3).nnz() for k in range(hessian.n_out()))
    # Those of all nodes stay where second derivatives need them, else of the end and two others.
    costates = ocp.stages + 1 if needed else min(ocp.stages + 1, 3)
    scale = ", ".join(repr(float(v)) for v in ocp.scale)
    metric = {"SCALE": f"{{{scale}}}", "FIRST_GAMMA": repr(first_gamma(ocp))}
    constants = {**_sizes(ocp), "COSTATES": costates, **metric, **_constants(ocp, settings), **stops}
    return Driver("\n".join(texts), leaves, constants, _room(ocp, costates))


def _room(ocp: OptimalControl, costates: int) -> int:
    """Numbers of the struct Search of fixed_point.c."""
    nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
    plan = 2 * n * nu + (n + 1) * ns + 1
    course = n * (nu + nu * nu + partial_count(ocp)) + costates * ns + ns * ns
    return 2 * plan + course + 6


def _sizes(ocp: OptimalControl) -> dict[str, object]:
    return {
        "NS": ocp.state.size,
        "NU": ocp.input.size,
        "NT": ocp.data.size,
        "NM": partial_count(ocp),
        "N": ocp.stages,
        "MEMORY": plain_memory(ocp).size,
    }


def _constants(ocp: OptimalControl, settings: PlainSettings) -> dict[str, object]:
    return {
        "TOLERANCE": repr(float(settings.tolerance)),
        "DAMPING": repr(float(settings.damping)),
        "SHARE": line_search.SHARE,
        "ARMIJO": line_search.ARMIJO,
        "SHORTER": line_search.SHORTER,
        "SHORTEST": line_search.SHORTEST,
        "DRAWN_IN": line_search.DRAWN_IN,
        "FLAT": line_search.FLAT,
        "ROUNDING": f"OF_TYPE({line_search.ROUNDING}, 1e-6)",
        "PLAIN": _MOST_PLAIN,
        "UNTRIED": f"(FINITE / {FINITE / line_search.UNTRIED:g})",
        "PIVOT": BOX_PIVOT,
        "ROUNDS": rounds(ocp.input.size),
        "CONVERGED": int(Status.OK),
        "NOT_CONVERGED": int(Status.NOT_CONVERGED),
        "INFEASIBLE": int(Status.INFEASIBLE),
        "NON_FINITE": int(Status.NON_FINITE),
    }


_SEARCHES: Latest[Search] = Latest(4)


def plain_graph(ocp: OptimalControl, settings: PlainSettings, name: str) -> ca.Function:
    """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory)."""
    arguments, memory = call_symbols(ocp)
    own = settings.hessian, settings.map, settings.damping
    search = _SEARCHES.of((ocp, settings.map), own[::2], lambda: Search(ocp, *own))
    anchor = first_anchor(ocp, arguments, memory)
    if settings.ends:
        anchor, count = _converged(ocp, settings, search, arguments, anchor)
        return ca.Function(name, [*arguments, memory], _results(ocp, settings, arguments, memory, anchor, count - 1))
    for _ in range(settings.iterations):
        anchor, plan = search.tried(anchor, arguments)
        anchor = search.directed(anchor, plan, arguments)
    anchor, plan = search.tried(anchor, arguments)
    anchor = search.looked(anchor, plan, arguments)
    results = _results(ocp, settings, arguments, memory, anchor, settings.iterations)
    return ca.Function(name, [*arguments, memory], results)


def call_symbols(ocp: OptimalControl) -> tuple[Arguments, ca.MX]:
    """Return symbols of the arguments and of the memory of one call."""
    nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
    s0, data = ca.MX.sym("s0", ns), ca.MX.sym("data", ocp.data.size, n + 1)
    lower, upper = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
    return Arguments(s0, data, lower, upper), ca.MX.sym("memory", plain_memory(ocp).size)


def first_anchor(ocp: OptimalControl, arguments: Arguments, memory: ca.MX) -> Anchor:
    """Return the remembered plan, not evaluated yet; a memory that is not finite is forgotten."""
    nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
    remembered = plain_memory(ocp).split(ca.if_else(is_finite(memory), memory, 0))
    inputs = clip(ca.reshape(remembered["plan_inputs"], nu, n), arguments.lower, arguments.upper)
    none = ca.MX.zeros(nu, n)
    first = first_gamma(ocp)
    resume = ca.if_else(remembered["plan_step"] > 0, ca.fmin(remembered["plan_step"], 1), 1)
    # After a rejected T a longer gamma would be rejected again, in every call of one iteration.
    longer = ca.if_else(resume < line_search.SHORTEST, 1, 2) * remembered["plan_gamma"]
    gamma = ca.if_else(remembered["plan_gamma"] > 0, ca.fmin(longer, first), first)
    return Anchor(
        inputs=inputs,
        states=ca.reshape(remembered["plan_states"], ns, n),
        move=none,
        gains=ca.reshape(remembered["plan_gains"], nu, ns * n),
        plain=clip(none, arguments.lower, arguments.upper),
        slope=none,
        value=ca.MX(FINITE),
        envelope=ca.MX(FINITE),
        step=ca.MX(1),
        gamma=gamma,
        resume=resume,
        sent=ca.MX(FINITE),
        curved=ca.MX.zeros(nu, nu * n),
    )


def _converged(
    ocp: OptimalControl, settings: PlainSettings, search: Search, arguments: Arguments, anchor: Anchor
) -> tuple[Anchor, ca.MX]:
    """The anchor after the last iteration that is needed, and how many plans were tried."""
    symbols = Anchor(*(ca.MX.sym(name, *v.shape) for name, v in zip(Anchor._fields, anchor, strict=True)))
    count, plain, ended = counts = [ca.MX.sym(name) for name in ("count", "plain", "ended")]
    tried, plan = search.tried(symbols, arguments)
    looked, tolerance = search.looked(tried, plan, arguments), settings.tolerance
    residual = stationarity(ocp, looked.inputs, looked.slope, arguments.lower, arguments.upper)
    solved = ca.logic_and(
        looked.value < line_search.UNTRIED, ca.logic_and(residual <= tolerance, looked.sent <= tolerance)
    )
    # In open loop a sweep at the plan before has to say so too.
    solved = ca.logic_and(solved, symbols.sent <= tolerance) if settings.converging else solved
    plainer = plain + (symbols.step < line_search.SHORTEST)
    ends = ca.logic_or(ca.logic_or(solved, plainer >= _MOST_PLAIN), count >= settings.most)
    directed = search.directed(looked, plan, arguments)
    after = [ca.if_else(ends, old, new) for old, new in zip(looked, directed, strict=True)]
    given = [*arguments, *symbols, *counts]
    work = ca.Function("fpirhc_iteration", given, [*after, count + 1, plainer, ends])
    rest = ca.Function("fpirhc_rest", given, [*symbols, *counts])
    once = ca.Function(
        "fpirhc_iterated", given, list(ca.Function.if_else("fpirhc_if_needed", work, rest)(1 - ended, *given))
    )
    count_of_few = math.isqrt(settings.most)  # a graph of all iterations side by side takes longer to build
    few = ca.Function("fpirhc_few", once.mx_in(), _iterated([once] * count_of_few, once.mx_in()))
    times = divmod(settings.most + 1, count_of_few)
    begin = [*arguments, *anchor, ca.MX(0), ca.MX(0), ca.MX(0)]
    *last, tries, _, _ = _iterated([few] * times[0] + [once] * times[1], begin)
    return Anchor(*last), tries


def _iterated(functions: Sequence[ca.Function], values: Sequence[ca.MX]) -> list[ca.MX]:
    """What Functions (arguments, values) -> values give one after the other."""
    given, state = values[: len(Arguments._fields)], list(values[len(Arguments._fields) :])
    for function in functions:
        state = function.call([*given, *state])
    return state


def _results(
    ocp: OptimalControl,
    settings: PlainSettings,
    arguments: Arguments,
    memory: ca.MX,
    anchor: Anchor,
    iterations: ca.MX | int,
) -> list[ca.MX]:
    """Plan, diagnostics and memory at the end of a call."""
    posed, evaluated = sane(*arguments), anchor.value < line_search.UNTRIED
    finite = ca.logic_and(posed, evaluated)
    residual = stationarity(ocp, anchor.inputs, anchor.slope, arguments.lower, arguments.upper)
    empty = ca.mmax(arguments.lower - arguments.upper) > 0
    tolerance = settings.tolerance
    status = status_of(finite, ca.fmax(residual, anchor.sent), 0, tolerance)
    status = ca.if_else(empty, int(Status.INFEASIBLE), status)
    numbers = ca.if_else(finite, ca.vertcat(anchor.value, residual), ca.MX.zeros(2))
    solved = plain_memory(ocp).join(
        {
            "plan_inputs": ca.vec(anchor.inputs),
            "plan_states": ca.vec(anchor.states),
            "plan_gains": ca.vec(anchor.gains),
            "plan_gamma": anchor.gamma,
            "plan_step": anchor.step,
        }
    )
    # A remembered plan under which a well-posed problem overflows is given up, so that the next call can succeed.
    next_memory = ca.if_else(finite, solved, ca.if_else(posed, _afresh(ocp, arguments), memory))
    return [anchor.inputs, ca.vertcat(numbers, 0, iterations, status), next_memory]


def _afresh(ocp: OptimalControl, arguments: Arguments) -> ca.MX:
    """The memory of a plan in the middle of the limits: without any input a plant may run empty."""
    lower, upper = arguments.lower, arguments.upper
    both = ca.logic_and(ca.fabs(lower) <= FINITE, ca.fabs(upper) <= FINITE)
    middle = ca.if_else(both, 0.5 * (lower + upper), 0)
    rest = plain_memory(ocp).size - ocp.stages * ocp.input.size
    return ca.vertcat(ca.repmat(middle, ocp.stages, 1), ca.MX.zeros(rest))
