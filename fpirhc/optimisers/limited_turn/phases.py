"""How a phase begins: pure, interior, or from a first guess."""

from __future__ import annotations

import casadi as ca

from fpirhc.optimisers.guess import guesses
from fpirhc.optimisers.limited_settings import DESCENT, LAST_START, LEAST_DAMPING, MU_END, MU_LEAST, MU_WARM, REFERENCE
from fpirhc.optimisers.limited_turn.call import Call
from fpirhc.optimisers.limited_turn.state import (
    BEGINS,
    COLD,
    INTERIOR,
    KEPT,
    PURE,
    WARM,
    State,
    as_best,
    as_last,
    choose,
    fixed,
    point,
)


def enter_pure(call: Call, s: State, place: int) -> State:
    """Begin a phase of pure steps; `place` is BEGINS or ENDS."""
    c = call.certified(point(s), s["z"])
    begun = fixed(phase=PURE, place_of=place, misses=0, steps=0)
    return {**s, **as_best(s), **as_last(c), "error": c.error, **begun}


def enter_interior(call: Call, s: State) -> State:
    """Leave the pure phase: for an interior phase near its best plan, or back to the interior plan it came from."""
    cost = call.scales.cost
    s = {**s, **fixed(phase=INTERIOR, again=1, use_exact=1, filtered=0, raises=0, halvings=0)}
    best = {"point_inputs": s["best_inputs"], "point_states": s["best_states"], "z": s["best_z"]}
    back = {**s, **best, **fixed(fresh=1)}
    near = fixed(mu=MU_WARM * cost, slacks=WARM, floor=MU_END * cost)
    starts = choose(s, s["misses"] == 0, {**s, **near}, {**back, **near})
    floor = 0.01 * s["floor"]
    stuck = ca.logic_or(s["stuck"], floor < MU_LEAST * cost)
    returns = {**back, "floor": floor, "stuck": stuck, **fixed(slacks=KEPT)}
    return choose(s, s["place_of"] == BEGINS, starts, returns)


def restart(call: Call, s: State) -> State:
    """Begin again from the next first guess; the iteration is stuck after the last one."""
    start = s["start"] + 1
    cold = begin_cold(call, {**s, "start": start}, None)
    return choose(s, start > LAST_START, {**s, "start": start, **fixed(stuck=1)}, cold)


def begin_cold(call: Call, s: State, inputs: ca.MX | None) -> State:
    """Begin without a memory.

    Args:
        call: the problem and its arguments.
        s: the state, with the number of the first guess in `start`.
        inputs: first inputs (nu, N); None: the feedforward. The states are held at s0, or follow the reference.
    """
    n, reach = call.ocp.stages, ca.DM(0.01 * call.scales.inputs)
    references, forward = guesses(call.ocp)(call.data)
    on_reference = ca.logic_or(s["start"] == REFERENCE, s["start"] == DESCENT)
    states = ca.if_else(on_reference, references, ca.repmat(call.s0, 1, n + 1))
    hair = ca.repmat(ca.fmin(reach, 0.25 * (call.upper - call.lower)), 1, n)
    first = forward[:, :n] if inputs is None else inputs
    low, high = ca.repmat(call.lower, 1, n) + hair, ca.repmat(call.upper, 1, n) - hair
    none = {"gains": 0 * s["gains"], "costates": 0 * s["costates"]}
    guess = {"point_inputs": ca.fmin(ca.fmax(first, low), high), "point_states": states}
    descends = s["start"] >= DESCENT
    zeros = fixed(filtered=0, raises=0, halvings=0, use_exact=0, price=call.scales.cost)
    zeros |= {"descends": descends, "delta": LEAST_DAMPING * descends}
    mu = fixed(mu=call.scales.cost, floor=MU_END * call.scales.cost)
    return {**s, **none, **guess, **zeros, **mu, **fixed(phase=INTERIOR, slacks=COLD, fresh=1)}
