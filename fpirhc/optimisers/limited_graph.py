"""The iteration with limits as one composed graph: the reference for tests of the loops in C, and what runs without a compiler.

A turn expands a plan, judges it, and finds the next one by a sweep. A phase of pure steps accepts a plan that halves the scaled
error E of the first-order conditions, with patience for a few steps, because a change of the active limits raises E at first. A
phase of interior steps accepts a plan by a filter as in IPOPT. Where the filter accepts none, a Levenberg-Marquardt term grows,
then another first plan is tried, and at last descents (docs/theory.md).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.hessian_models import ExactHessian, GaussNewton
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.riccati import Expansion, expand, expansion_shapes, sweep
from fpirhc.optimisers import limited_settings as constants
from fpirhc.optimisers.base import FEASIBLE, KEPT, clip, sane, stationarity
from fpirhc.optimisers.bounds import BOUNDARY, Certified, Interior, cannot_be_kept, certify, largest_gap
from fpirhc.optimisers.limited_phases import (
    AS_IS,
    BEGINS,
    COLD,
    PURE,
    WARM,
    Call,
    State,
    as_best,
    as_last,
    as_point,
    begin_cold,
    box,
    choose,
    constant,
    descending,
    enter_interior,
    enter_pure,
    fixed,
    guesses,
    judge_interior,
    merit,
    merit_slope,
    point,
    priced,
    restart,
)
from fpirhc.optimisers.limited_settings import LimitedSettings, limited_memory
from fpirhc.optimisers.search import deformed_move
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
    after = _Turn(call).turned(state)
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
        "floor": constant(constants.MU_END * call.scales.cost),
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
    state |= {"best_inputs": empty.inputs, "best_states": empty.states, "filter": ca.MX.zeros(constants.FILTER, 2)}
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
            "plan_barrier": ca.MX(constants.MU_WARM),
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
    usable = ca.logic_or(ca.logic_not(needed), _is_usable(again))
    p = Expansion(*(ca.if_else(needed, a, b) for a, b in zip(again, old, strict=True)))
    p, usable = _better_in_force(call, s, memory, p, usable)
    return p, call.certified(p, s["z"])._replace(left=_returned_left(call, p, s["z"])), usable


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
    there = ca.logic_and(ca.logic_and(known, m["plan_barrier"] > 0), ca.logic_and(s["met"] == 0, _is_usable(old)))
    taken = ca.logic_and(there, better)
    chosen = Expansion(*(ca.if_else(taken, a, b) for a, b in zip(old, p, strict=True)))
    return chosen, ca.logic_or(usable, taken)


def _status(call: Call, s: State, p: Expansion, c: Certified, ok: ca.MX) -> ca.MX:
    solved = ca.if_else(call.limits.outside(p) > KEPT, int(Status.INFEASIBLE), int(Status.OK))
    # A call that ends at its most iterations may still get inside, unless multipliers prove that it does not; one that has tried
    # everything has not.
    far = ca.logic_and(call.limits.outside(p) > FEASIBLE, ca.logic_or(s["stuck"], _cannot_be_kept(call, p, s["z"])))
    unsolved = ca.if_else(far, int(Status.INFEASIBLE), int(Status.NOT_CONVERGED))
    status = ca.if_else(ok, ca.if_else(call.is_done(c, constants.ROLLED_OUT), solved, unsolved), int(Status.NON_FINITE))
    return ca.if_else(ca.mmax(call.lower - call.upper) > 0, int(Status.INFEASIBLE), status)


class _Turn:
    def __init__(self, call: Call) -> None:
        ocp = call.ocp
        self._call, self._direction, self._expand = call, _Direction(call), expand(ocp)
        self._deformed = deformed_move(call.settings.map, ocp.input.size * ocp.stages)

    def turned(self, s: State) -> State:
        """Return the whole state after one turn."""
        final = s["count"] >= self._call.settings.iterations
        p, rolled, usable = self._next(s)
        s = {**s, **self._judged(s, p, rolled, usable)}
        met = self._limits_met(s)
        ends = ca.logic_or(ca.logic_or(final, s["stuck"]), met)
        s = {**s, "ends": ends, "met": met, "count": s["count"] + ca.logic_not(ends)}
        needed = ca.logic_and(s["fresh"] == 0, ca.logic_or(s["accepted"], s["again"]))
        return self._direction.directed(s, ca.logic_and(needed, ca.logic_not(ends)))

    def _limits_met(self, s: State) -> ca.MX:
        last = Certified(s["error"] * 0, s["last_left"], s["last_violation"], s["last_broken"], s["last_error"])
        left = _returned_left(self._call, point(s), s["z"])
        done = ca.logic_and(self._call.is_done(last), left <= self._call.settings.tolerance)
        return ca.logic_and(ca.logic_and(s["fresh"] == 0, s["phase"] == PURE), done)

    def _next(self, s: State) -> tuple[Expansion, ca.MX, ca.MX]:
        """The next plan, expanded; whether it is rolled out, and whether it is finite."""
        call, old, fresh = self._call, point(s), s["fresh"] > 0
        pure = ca.logic_and(ca.logic_not(fresh), s["phase"] == PURE)
        share, descent = ca.if_else(ca.logic_or(fresh, pure), 0, s["alpha"]), descending(s)
        deformed = ca.reshape(self._deformed(ca.vec(s["v"])), old.inputs.shape)
        move = ca.if_else(descent, s["v"], s["du"])
        inputs = old.inputs + ca.if_else(share > 0, share * move, 0) + ca.if_else(pure, deformed, 0)
        states = old.states + ca.if_else(ca.logic_and(share > 0, ca.logic_not(descent)), share * s["dx"], 0)
        gaps = ca.if_else(descent, (1 - share) * (old.next_states - old.states[:, 1:]), 0)
        starts = ca.logic_and(ca.logic_and(s["fresh"] == 1, s["slacks"] == COLD), s["start"] == constants.ROLLED)
        rolled = ca.if_else(fresh, starts, ca.logic_or(pure, descent))
        p = Expansion(*self._expand(inputs, states, s["gains"], rolled, gaps, call.s0, call.data, *box(call, s)))
        return p, rolled, _is_usable(p)

    def _judged(self, s: State, p: Expansion, rolled: ca.MX, usable: ca.MX) -> State:
        fresh, pure = s["fresh"] > 0, s["phase"] == PURE
        guessed = self._judge_fresh(s, p, rolled, usable)
        stepped = _judge_pure(self._call, s, p, usable), judge_interior(self._call, s, p, usable)
        judged = choose(s, fresh, guessed, choose(s, pure, *stepped))
        whole = ca.logic_and(rolled, judged["descends"] == 0)
        return {**judged, "rolled": ca.if_else(judged["accepted"], whole, s["rolled"])}

    def _judge_fresh(self, s: State, p: Expansion, rolled: ca.MX, usable: ca.MX) -> State:
        """A plan that was not made by a sweep: first guesses, remembered plans, and the last one again."""
        call, new = self._call, {**s, **as_point(p), **fixed(fresh=0)}
        far = ca.mmax(ca.fabs(p.states) - 100 * ca.horzcat(call.spread[:, 0], call.spread)) > 0
        fit = ca.logic_and(usable, ca.logic_not(ca.logic_and(rolled, far)))
        pure = enter_pure(call, new, BEGINS)
        begun = choose(new, new["phase"] == PURE, pure, new)
        first = choose(s, fit, begun, {**restart(call, new), **fixed(accepted=1)})
        again = choose(s, usable, new, {**s, **fixed(fresh=0)})
        retried = s["fresh"] == 2
        judged = choose(s, retried, again, first)
        return {**judged, "accepted": ca.if_else(retried, usable, 1)}


def _returned_left(call: Call, p: Expansion, z: ca.MX) -> ca.MX:
    """Return the stationarity with which a plan is returned: multipliers of limits that are not near count as zero."""
    slope = certify(call.ocp, call.limits, p, z, call.limits.distance(p) <= FEASIBLE * call.limits.unit)
    return stationarity(call.ocp, p.inputs, slope, call.lower, call.upper)


def _is_usable(p: Expansion) -> ca.MX:
    """Whether the numbers of an expansion that a sweep reads are finite."""
    numbers = [p.value, p.next_states, p.by_state, p.by_input, p.tail, p.a, p.b]
    return is_finite(ca.vertcat(*(ca.vec(v) for v in numbers)))


def _judge_pure(call: Call, s: State, p: Expansion, usable: ca.MX) -> State:
    """Return the state with the plan accepted, or at the begin of an interior phase."""
    c = call.certified(p, s["next_z"])
    halved = c.error <= 0.5 * s["error"]
    waits = ca.logic_and(s["misses"] < constants.PATIENCE, c.error < constants.HOPELESS)
    patient = ca.logic_and(ca.logic_or(halved, waits), s["steps"] + 1 <= constants.PURE_STEPS)
    ok = ca.logic_and(ca.logic_and(usable, c.error < FINITE), patient)
    taken = {**s, **as_point(p), **as_last(c), "z": s["next_z"], "costates": s["swept"], "steps": s["steps"] + 1}
    # Gauss-Newton goes on only where the contraction that was seen ends the call with one more step.
    arrives = c.error**2 <= constants.AHEAD * call.settings.scaled_tolerance(call.scales) * s["error"]
    taken["use_exact"] = ca.logic_or(s["use_exact"], ca.logic_not(arrives))
    taken["misses"] = ca.if_else(halved, 0, s["misses"] + 1)
    taken["error"] = ca.if_else(halved, c.error, s["error"])
    better = ca.logic_and(halved, s["place_of"] == BEGINS)
    taken = choose(taken, better, {**taken, **as_best(taken)}, taken)
    return choose(s, ok, {**taken, **fixed(accepted=1)}, {**enter_interior(call, s), **fixed(accepted=0)})


def _cannot_be_kept(call: Call, p: Expansion, z: ca.MX) -> ca.MX:
    return cannot_be_kept(call.ocp, call.limits, p, z, constants.SURE)


class _Direction:
    """Builds the sweeps of one call: with the Hessian of the settings, and with Gauss-Newton where that is not convex."""

    def __init__(self, call: Call) -> None:
        ocp, scales = call.ocp, call.scales
        damping = ocp.step * ocp.curvature, 0.01 * scales.cost / scales.states**2
        models = call.settings.hessian or ExactHessian(), GaussNewton()
        self._call = call
        self._exact, self._plain = (sweep(ocp, model, scales.bounded, damping) for model in models)

    def directed(self, s: State, needed: ca.MX) -> State:
        """Return the state with the next step where one is needed; with more damping where the sweep fails."""
        call, limits, p, pure = self._call, self._call.limits, point(s), s["phase"] == PURE
        slope = certify(call.ocp, limits, p, s["z"])
        weights, leans, held = limits.pure(p, s["z"], slope, largest_gap(p, call.scales))
        y = Interior(s["t"], s["e"], s["z"])
        placed = limits.inside(p, s["z"], s["mu"], s["slacks"] == WARM)
        y = Interior(*(ca.if_else(s["slacks"] == AS_IS, a, b) for a, b in zip(y, placed, strict=True)))
        t, e = limits.path(p, s["mu"])
        anew = ca.if_else(s["slacks"] == COLD, ca.if_else(limits.present, s["mu"] / t, 0), y.z)
        y = Interior(*(ca.if_else(s["descends"], a, b) for a, b in zip((t, e, anew), y, strict=True)))
        barrier = limits.interior(p, y, s["mu"])
        weight, lean = (ca.if_else(pure, a, b) for a, b in zip((weights, leans), barrier, strict=True))
        v, gains, dx, du, swept, ok = self._swept(s, p, weight, lean, needed)
        use_exact = ca.logic_or(s["use_exact"], ca.logic_not(pure))
        now = {**s, "z": ca.if_else(pure, held, y.z), "use_exact": use_exact, **fixed(again=0)}
        now = choose(now, pure, now, {**now, "t": y.t, "e": y.e, **fixed(slacks=AS_IS)})
        delta = ca.fmax(10 * s["delta"], 1e-6)
        failed = {**now, "delta": delta, **fixed(fresh=2, use_exact=1)}
        failed = choose(failed, delta > 1e8, restart(call, failed), failed)
        stepped = {**now, "v": v, "gains": gains, "dx": dx, "du": du, "swept": swept}
        steps = {**stepped, "next_z": limits.pure_multipliers(p, held, du, dx)}
        inside = self._inside(stepped, p, y, s["mu"])
        directed = choose(now, ok, choose(stepped, pure, steps, inside), failed)
        return choose(s, needed, directed, s)

    def _inside(self, s: State, p: Expansion, y: Interior, mu: ca.MX) -> State:
        """The state with the moves of slacks, elastics and multipliers, their shares, and the measures of the filter."""
        call = self._call
        by = call.limits.moves(p, y, mu, s["du"], s["dx"])
        tau = ca.fmax(BOUNDARY, 1 - mu / call.scales.cost)
        alpha, alpha_dual = call.limits.shares(y, by, tau)
        inside = {**s, "dt": by.t, "de": by.e, "dz": by.z, "alpha": alpha, "alpha_dual": alpha_dual}
        inside["theta"], inside["phi"] = merit(call, p, y, mu)
        inside["dphi"] = merit_slope(call, inside, p)
        return choose(inside, inside["descends"] > 0, priced(call, inside, p), inside)

    def _swept(self, s: State, p: Expansion, weight: ca.MX, lean: ca.MX, needed: ca.MX) -> list[ca.MX]:
        arguments = [*p, weight, lean, s["costates"], s["delta"], self._call.data]
        none = _without_result(self._exact)
        exact_if = ca.Function.if_else("fpirhc_sweep_exact", self._exact, none)
        first = exact_if(ca.logic_and(needed, s["use_exact"]), *arguments)
        failed = ca.logic_and(needed, first[-1] == 0)
        second = ca.Function.if_else("fpirhc_sweep_plain", self._plain, none)(failed, *arguments)
        return [ca.if_else(failed, b, a) for a, b in zip(first, second, strict=True)]


def _without_result(function: ca.Function) -> ca.Function:
    """The same signature, with results of zero."""
    inputs = [ca.MX.sym(f"i{k}", *function.size_in(k)) for k in range(function.n_in())]
    return ca.Function("fpirhc_no_sweep", inputs, [ca.MX.zeros(*function.size_out(k)) for k in range(function.n_out())])
