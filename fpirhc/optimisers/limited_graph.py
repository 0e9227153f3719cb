"""The iteration with limits as one composed graph: what the loops in C are tested against, and what runs without a compiler."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.sweep import Expansion, expand, expansion_shapes
from fpirhc.optimisers.base import FEASIBLE, FINITE, clip, is_finite, sane, stationarity
from fpirhc.optimisers.certified import certified, certify
from fpirhc.optimisers.guess import guesses
from fpirhc.optimisers.limited_memory import limited_memory
from fpirhc.optimisers.limited_settings import FILTER, MU_END, MU_WARM, LimitedSettings
from fpirhc.optimisers.turn import BEGINS, PURE, WARM, State, Turn, as_point, choose, constant, fixed, point
from fpirhc.status import Status

_SCALARS = (
    *("mu", "floor", "delta", "error", "alpha", "alpha_dual", "theta", "phi", "dphi"),
    *("last_error", "last_left", "last_violation", "last_broken"),
    *("phase", "place_of", "fresh", "again", "slacks", "misses", "steps", "halvings", "raises", "filtered", "start"),
    *("bent", "stuck", "rolled", "accepted", "count", "ends"),
)


def limited_graph(ocp: OptimalControl, settings: LimitedSettings, name: str) -> ca.Function:
    """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory)."""
    given = [ca.MX.sym(k, *shape) for k, shape in _given_shapes(ocp).items()]
    memory = ca.MX.sym("memory", limited_memory(ocp).size)
    posed = sane(*given)
    begun = _begun(ocp, settings, given, memory)
    begun["ends"] = ca.logic_not(posed)
    packed = ca.vertcat(*(ca.vec(v) for v in [*given, *begun.values()]))
    shapes = {**_given_shapes(ocp), **{k: ca.MX(v).shape for k, v in begun.items()}}
    turns = _guarded_turn(ocp, settings, shapes).fold(settings.iterations + 1)
    state = dict(zip(shapes, _unpacked(turns(packed), shapes), strict=True))
    return ca.Function(name, [*given, memory], _finished(ocp, settings, state, given, memory, posed))


def _given_shapes(ocp: OptimalControl) -> dict[str, tuple[int, int]]:
    nu = ocp.input.size
    return {"s0": (ocp.state.size, 1), "data": (ocp.data.size, ocp.stages + 1), "lower": (nu, 1), "upper": (nu, 1)}


def _guarded_turn(ocp: OptimalControl, settings: LimitedSettings, shapes: dict[str, tuple[int, int]]) -> ca.Function:
    """Function column -> column after one turn, or the same once the iteration has ended."""
    column = ca.MX.sym("column", sum(rows * columns for rows, columns in shapes.values()))
    state = dict(zip(shapes, _unpacked(column, shapes), strict=True))
    s0, data, lower, upper = (state[k] for k in _given_shapes(ocp))
    after = Turn(ocp, settings, data, lower, upper, s0).turned(state)
    work = ca.Function("fpirhc_limited_turn", [column], [ca.vertcat(*(ca.vec(ca.MX(after[k])) for k in shapes))])
    rest = ca.Function("fpirhc_limited_rest", [column], [column])
    chosen = ca.Function.if_else("fpirhc_limited_turn_if_needed", work, rest)
    return ca.Function("fpirhc_limited_turn_guarded", [column], [chosen(state["ends"] == 0, column)])


def _unpacked(column: ca.MX, shapes: dict[str, tuple[int, int]]) -> list[ca.MX]:
    ends = np.cumsum([0, *(rows * columns for rows, columns in shapes.values())]).tolist()
    parts = ca.vertsplit(column, ends)
    return [ca.reshape(part, *shape) for part, shape in zip(parts, shapes.values(), strict=True)]


def _begun(ocp: OptimalControl, settings: LimitedSettings, given: list[ca.MX], memory: ca.MX) -> State:
    """The state of the iteration before its first turn: the remembered plan, or a first guess."""
    s0, data, lower, upper = given
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    usable = is_finite(memory)
    kept = limited_memory(ocp).split(ca.if_else(usable, memory, 0))
    turn = Turn(ocp, settings, data, lower, upper, s0)
    rows = turn.limits.unit.shape[0]
    empty = Expansion(*(ca.MX.zeros(*shape) for shape in expansion_shapes(ocp)))
    limits = {name: ca.MX.zeros(rows, 2 * n) for name in ("t", "e", "z", "dt", "de", "dz", "next_z", "kept_z")}
    state: State = {**as_point(empty), **limits, **{name: ca.MX(0) for name in _SCALARS}}
    state |= {"kept_inputs": empty.inputs, "kept_states": empty.states, "filter": ca.MX.zeros(FILTER, 2)}
    state |= {"v": empty.inputs, "gains": ca.reshape(kept["plan_gains"], nu, ns * n), "du": empty.inputs}
    state |= {"dx": empty.states, "costates": ca.reshape(kept["plan_costates"], ns, n), "swept": ca.MX.zeros(ns, n)}
    state |= {"last_error": ca.MX(10 * FINITE), "last_left": ca.MX(10 * FINITE)}
    state |= {"last_violation": ca.MX(10 * FINITE), "last_broken": ca.MX(10 * FINITE)}
    remembered = ca.reshape(kept["plan_inputs"], nu, n)
    warm = {
        "point_inputs": clip(remembered, lower, upper),
        "point_states": ca.horzcat(s0, ca.reshape(kept["plan_states"], ns, n)),
        "z": ca.reshape(kept["plan_multipliers"], rows, 2 * n),
        "mu": kept["plan_barrier"] * turn.scales.cost,
        "floor": constant(MU_END * turn.scales.cost),
        "delta": kept["plan_damping"],
        **fixed(phase=PURE, place_of=BEGINS, fresh=1, slacks=WARM, bent=1, start=-1),
    }
    told = ca.norm_inf(ca.vec(memory[: nu * n])) <= FINITE
    first = ca.if_else(told, ca.reshape(memory[: nu * n], nu, n), 0)
    begun = ca.if_else(ca.norm_inf(ca.vec(first)) > 0, first, guesses(ocp)(data)[1][:, :n])
    known = ca.logic_and(usable, kept["plan_barrier"] > 0)
    both = choose(state, known, {**state, **warm}, turn.cold({**state, "z": state["z"]}, begun))
    return {name: ca.MX(both[name]) for name in state}


def _finished(
    ocp: OptimalControl, settings: LimitedSettings, s: State, given: list[ca.MX], memory: ca.MX, posed: ca.MX
) -> list[ca.MX]:
    """Roll the last plan out where it is not, judge it, and remember."""
    s0, data, lower, upper = given
    turn, old = Turn(ocp, settings, data, lower, upper, s0), point(s)
    again = Expansion(*expand(ocp)(old.inputs, old.states, s["gains"], 1, s0, data, lower, upper))
    needed = ca.logic_or(ca.logic_not(s["rolled"]), s["fresh"] > 0)
    numbers = [again.value, again.following, again.by_state, again.by_input, again.tail, again.a, again.b]
    usable = ca.logic_or(ca.logic_not(needed), is_finite(ca.vertcat(*(ca.vec(v) for v in numbers))))
    p = Expansion(*(ca.if_else(needed, a, b) for a, b in zip(again, old, strict=True)))
    c = certified(ocp, turn.limits, turn.scales, p, s["z"])
    slope = certify(ocp, turn.limits, p, s["z"], turn.limits.distance(p) <= FEASIBLE)
    c = c._replace(left=stationarity(ocp, p.inputs, slope, lower, upper))
    ok = ca.logic_and(ca.logic_and(posed, usable), c.error < FINITE)
    solved = ca.if_else(c.violation > FEASIBLE, int(Status.INFEASIBLE), int(Status.OK))
    # A call of few iterations may still get inside; one that has tried everything has not.
    unsolved = int(Status.NOT_CONVERGED) if settings.realtime else ca.fmax(solved, int(Status.NOT_CONVERGED))
    judged = ca.if_else(turn.is_done(c), solved, unsolved)
    status = ca.if_else(ok, judged, int(Status.NON_FINITE))
    status = ca.if_else(ca.mmax(lower - upper) > 0, int(Status.INFEASIBLE), status)
    told = ca.if_else(ok, ca.vertcat(p.value, c.left, c.violation), ca.MX.zeros(3))
    layout = limited_memory(ocp)
    before = ca.reshape(memory[: p.inputs.numel()], *p.inputs.shape)
    last = ca.if_else(is_finite(memory), before, 0)
    plan = clip(ca.if_else(ok, p.inputs, last), lower, upper)
    kept = layout.join(
        {
            "plan_inputs": ca.vec(p.inputs),
            "plan_states": ca.vec(p.states[:, 1:]),
            "plan_costates": ca.vec(s["costates"]),
            "plan_gains": ca.vec(s["gains"]),
            "plan_multipliers": ca.vec(s["z"]),
            "plan_barrier": s["mu"] / turn.scales.cost if settings.realtime else ca.MX(MU_WARM),
            "plan_damping": s["delta"],
        }
    )
    forgotten = ca.if_else(posed, ca.MX.zeros(layout.size), memory)
    return [plan, ca.vertcat(told, s["count"], status), ca.if_else(ok, kept, forgotten)]
