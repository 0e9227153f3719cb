"""The iteration with limits as one composed graph: the reference for tests of the loops in C, and what runs without a compiler."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.sweep import Expansion, expand, expansion_shapes
from fpirhc.optimisers.base import FEASIBLE, KEPT, clip, sane
from fpirhc.optimisers.certified import Certified
from fpirhc.optimisers.limited_settings import FILTER, MU_END, MU_WARM, LimitedSettings, limited_memory
from fpirhc.optimisers.limited_state import (
    BEGINS,
    PURE,
    WARM,
    Call,
    State,
    as_point,
    begin_cold,
    choose,
    constant,
    fixed,
    guesses,
    point,
)
from fpirhc.optimisers.limited_turn import Turn, is_usable, returned_left
from fpirhc.status import Status
from fpirhc.symbolic.expression import FINITE, is_finite

_SCALARS = (
    *("mu", "floor", "delta", "error", "alpha", "alpha_dual", "theta", "phi", "dphi"),
    *("last_error", "last_left", "last_violation", "last_broken"),
    *("phase", "place_of", "fresh", "again", "slacks", "misses", "steps", "halvings", "raises", "filtered", "start"),
    *("use_exact", "stuck", "rolled", "rewarms", "met", "accepted", "count", "ends", "descends", "price"),
)

_BLOCK = 20  # turns; most plans need fewer


def limited_graph(ocp: OptimalControl, settings: LimitedSettings, name: str) -> ca.Function:
    """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory)."""
    arguments = [ca.MX.sym(k, *shape) for k, shape in _argument_shapes(ocp).items()]
    memory = ca.MX.sym("memory", limited_memory(ocp).size)
    posed, call = sane(*arguments), Call(ocp, settings, *arguments)
    first = _first_state(call, memory)
    first["ends"] = ca.logic_not(posed)
    packed = ca.vertcat(*(ca.vec(v) for v in [*arguments, *first.values()]))
    shapes = {**_argument_shapes(ocp), **{k: ca.MX(v).shape for k, v in first.items()}}
    last = _repeated(_guarded_turn(ocp, settings, shapes), packed, settings.iterations + 1, shapes)
    state = dict(zip(shapes, _unpacked(last, shapes), strict=True))
    return ca.Function(name, [*arguments, memory], _results(call, state, memory, posed))


def _argument_shapes(ocp: OptimalControl) -> dict[str, tuple[int, int]]:
    nu = ocp.input.size
    return {"s0": (ocp.state.size, 1), "data": (ocp.data.size, ocp.stages + 1), "lower": (nu, 1), "upper": (nu, 1)}


def _guarded_turn(ocp: OptimalControl, settings: LimitedSettings, shapes: dict[str, tuple[int, int]]) -> ca.Function:
    """Function column -> column after one turn, or the same once the iteration has ended."""
    column = ca.MX.sym("column", sum(rows * columns for rows, columns in shapes.values()))
    state = dict(zip(shapes, _unpacked(column, shapes), strict=True))
    call = Call(ocp, settings, *(state[k] for k in _argument_shapes(ocp)))
    after = Turn(call).turned(state)
    work = ca.Function("fpirhc_limited_turn", [column], [ca.vertcat(*(ca.vec(ca.MX(after[k])) for k in shapes))])
    return _while_needed(work, shapes)


def _while_needed(work: ca.Function, shapes: dict[str, tuple[int, int]]) -> ca.Function:
    """Function column -> column after `work`, or the same once the iteration has ended."""
    column = ca.MX.sym("column", work.size1_in(0))
    ends = dict(zip(shapes, _unpacked(column, shapes), strict=True))["ends"]
    rest = ca.Function("fpirhc_limited_rest", [column], [column])
    work_or_rest = ca.Function.if_else("fpirhc_limited_if_needed", work, rest)
    return ca.Function("fpirhc_limited_guarded", [column], [work_or_rest(ends == 0, column)])


def _repeated(turn: ca.Function, column: ca.MX, count: int, shapes: dict[str, tuple[int, int]]) -> ca.MX:
    """Return the column after `count` turns. Blocks of turns are passed over as a whole once the iteration has ended."""
    blocks, others = divmod(count, _BLOCK)
    if blocks:
        column = _while_needed(turn.fold(_BLOCK), shapes).fold(blocks)(column)
    return turn.fold(others)(column) if others else column


def _unpacked(column: ca.MX, shapes: dict[str, tuple[int, int]]) -> list[ca.MX]:
    ends = np.cumsum([0, *(rows * columns for rows, columns in shapes.values())]).tolist()
    parts = ca.vertsplit(column, ends)
    return [ca.reshape(part, *shape) for part, shape in zip(parts, shapes.values(), strict=True)]


def _first_state(call: Call, memory: ca.MX) -> State:
    """The state of the iteration before its first turn: the remembered plan, or a first guess."""
    ocp, lower, upper = call.ocp, call.lower, call.upper
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    usable = is_finite(memory)
    remembered = limited_memory(ocp).split(ca.if_else(usable, memory, 0))
    rows = call.limits.unit.shape[0]
    empty = _empty_state(ocp, rows, remembered)
    warm = {
        "point_inputs": clip(ca.reshape(remembered["plan_inputs"], nu, n), lower, upper),
        "point_states": ca.horzcat(call.s0, ca.reshape(remembered["plan_states"], ns, n)),
        "z": ca.reshape(remembered["plan_multipliers"], rows, 2 * n),
        "mu": remembered["plan_barrier"] * call.scales.cost,
        "floor": constant(MU_END * call.scales.cost),
        "delta": remembered["plan_damping"],
        **fixed(phase=PURE, place_of=BEGINS, fresh=1, slacks=WARM, use_exact=not call.settings.plain_first, start=-1),
    }
    has_guess = is_finite(memory[: nu * n])
    guess = ca.if_else(has_guess, ca.reshape(memory[: nu * n], nu, n), 0)
    inputs = ca.if_else(ca.norm_inf(ca.vec(guess)) > 0, guess, guesses(ocp)(call.data)[1][:, :n])
    known = ca.logic_and(usable, remembered["plan_barrier"] > 0)
    first = choose(empty, known, {**empty, **warm}, begin_cold(call, empty, inputs))
    return {name: ca.MX(first[name]) for name in empty}


def _empty_state(ocp: OptimalControl, rows: int, remembered: dict[str, ca.MX]) -> State:
    """All entries of the state, zero but for the remembered feedback and costates; `rows` can be limited."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    empty = Expansion(*(ca.MX.zeros(*shape) for shape in expansion_shapes(ocp)))
    limits = {name: ca.MX.zeros(rows, 2 * n) for name in ("t", "e", "z", "dt", "de", "dz", "next_z", "best_z")}
    state: State = {**as_point(empty), **limits, **{name: ca.MX(0) for name in _SCALARS}}
    state |= {"best_inputs": empty.inputs, "best_states": empty.states, "filter": ca.MX.zeros(FILTER, 2)}
    state |= {"v": empty.inputs, "gains": ca.reshape(remembered["plan_gains"], nu, ns * n), "du": empty.inputs}
    costates = ca.reshape(remembered["plan_costates"], ns, n)
    state |= {"dx": empty.states, "costates": costates, "swept": ca.MX.zeros(ns, n)}
    state |= {"last_error": ca.MX(10 * FINITE), "last_left": ca.MX(10 * FINITE)}
    return state | {"last_violation": ca.MX(10 * FINITE), "last_broken": ca.MX(10 * FINITE)}


def _results(call: Call, s: State, memory: ca.MX, posed: ca.MX) -> list[ca.MX]:
    """Plan, diagnostics and memory after the last turn."""
    layout = limited_memory(call.ocp)
    p, c, usable = _last_plan(call, s, memory)
    ok = ca.logic_and(ca.logic_and(posed, usable), c.error < FINITE)
    numbers = ca.if_else(ok, ca.vertcat(p.value, c.left, c.violation), ca.MX.zeros(3))
    before = ca.reshape(memory[: p.inputs.numel()], *p.inputs.shape)
    last = ca.if_else(is_finite(memory), before, 0)
    plan = clip(ca.if_else(ok, p.inputs, last), call.lower, call.upper)
    next_memory = layout.join(
        {
            "plan_inputs": ca.vec(p.inputs),
            "plan_states": ca.vec(p.states[:, 1:]),
            "plan_costates": ca.vec(s["costates"]),
            "plan_gains": ca.vec(s["gains"]),
            "plan_multipliers": ca.vec(s["z"]),
            "plan_barrier": ca.MX(MU_WARM),
            "plan_damping": s["delta"],
        }
    )
    forgotten = ca.if_else(posed, ca.MX.zeros(layout.size), memory)
    diagnostics = ca.vertcat(numbers, s["count"], _status(call, s, p, c, ok))
    return [plan, diagnostics, ca.if_else(ok, next_memory, forgotten)]


def _last_plan(call: Call, s: State, memory: ca.MX) -> tuple[Expansion, Certified, ca.MX]:
    """The last plan, rolled out where it is not; how far it is from the first-order conditions; and whether it is finite."""
    ocp, old = call.ocp, point(s)
    none = ca.MX.zeros(ocp.state.size, ocp.stages)
    again = Expansion(
        *expand(ocp)(old.inputs, old.states, s["gains"], 1, none, call.s0, call.data, call.lower, call.upper)
    )
    needed = ca.logic_or(ca.logic_not(s["rolled"]), s["fresh"] > 0)
    usable = ca.logic_or(ca.logic_not(needed), is_usable(again))
    p = Expansion(*(ca.if_else(needed, a, b) for a, b in zip(again, old, strict=True)))
    p, usable = _better_in_force(call, s, memory, p, usable)
    return p, call.certified(p, s["z"])._replace(left=returned_left(call, p, s["z"])), usable


def _better_in_force(call: Call, s: State, memory: ca.MX, p: Expansion, usable: ca.MX) -> tuple[Expansion, ca.MX]:
    """The remembered plan, rolled out, where the call has not met the conditions and its own plan is not better."""
    ocp, known = call.ocp, is_finite(memory)
    m = limited_memory(ocp).split(ca.if_else(known, memory, 0))
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    states = ca.horzcat(call.s0, ca.reshape(m["plan_states"], ns, n))
    inputs, gains = ca.reshape(m["plan_inputs"], nu, n), ca.reshape(m["plan_gains"], nu, ns * n)
    none = ca.MX.zeros(ns, n)
    old = Expansion(*expand(ocp)(inputs, states, gains, 1, none, call.s0, call.data, call.lower, call.upper))
    better = ca.logic_or(ca.logic_not(usable), call.limits.priced(old) < call.limits.priced(p))
    there = ca.logic_and(ca.logic_and(known, m["plan_barrier"] > 0), ca.logic_and(s["met"] == 0, is_usable(old)))
    taken = ca.logic_and(there, better)
    chosen = Expansion(*(ca.if_else(taken, a, b) for a, b in zip(old, p, strict=True)))
    return chosen, ca.logic_or(usable, taken)


def _status(call: Call, s: State, p: Expansion, c: Certified, ok: ca.MX) -> ca.MX:
    solved = ca.if_else(call.limits.outside(p) > KEPT, int(Status.INFEASIBLE), int(Status.OK))
    # A call that ends at its most iterations may still get inside; one that has tried everything has not.
    far = ca.logic_and(c.violation > FEASIBLE, s["stuck"])
    unsolved = ca.if_else(far, int(Status.INFEASIBLE), int(Status.NOT_CONVERGED))
    status = ca.if_else(ok, ca.if_else(call.is_done(c), solved, unsolved), int(Status.NON_FINITE))
    return ca.if_else(ca.mmax(call.lower - call.upper) > 0, int(Status.INFEASIBLE), status)
