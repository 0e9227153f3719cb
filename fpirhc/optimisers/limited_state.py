"""The state of the iteration with limits: what one call reads, what a turn changes, and how a phase begins."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import casadi as ca

from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.sweep import Expansion
from fpirhc.optimisers.bounds import Limited
from fpirhc.optimisers.certified import Certified, certified
from fpirhc.optimisers.limited_settings import (
    DESCENT,
    LAST_START,
    LEAST_DAMPING,
    MU_END,
    MU_LEAST,
    MU_WARM,
    REFERENCE,
    LimitedSettings,
)
from fpirhc.optimisers.scales import Scales, scales

PURE, INTERIOR = 0, 1  # phase
BEGINS, ENDS = 0, 1  # place_of: whether a pure phase stands before an interior one or after it
KEPT, COLD, WARM = 0, 1, 2  # slacks: as they are, made from the distances, or from the distances and the multipliers


@dataclass(frozen=True, eq=False)
class Call:
    """What all parts of a turn read.

    Args:
        ocp: the problem.
        settings: of the iteration.
        s0: the first state, shape (ns,).
        data: shape (ntheta, N + 1).
        lower: lower limits of the inputs, shape (nu,).
        upper: upper limits of the inputs, shape (nu,).
    """

    ocp: OptimalControl
    settings: LimitedSettings
    s0: ca.MX
    data: ca.MX
    lower: ca.MX
    upper: ca.MX
    scales: Scales = field(init=False)
    limits: Limited = field(init=False)
    spread: ca.DM = field(init=False)  # units of the states, shape (ns, N)

    def __post_init__(self) -> None:
        units = scales(self.ocp)
        object.__setattr__(self, "scales", units)
        object.__setattr__(self, "limits", Limited(self.ocp, units, self.lower, self.upper))
        object.__setattr__(self, "spread", ca.repmat(ca.DM(units.states), 1, self.ocp.stages))

    def certified(self, p: Expansion, z: ca.MX) -> Certified:
        """Return how far a plan with multipliers z is from the first-order conditions."""
        return certified(self.ocp, self.limits, self.scales, p, z)

    def is_done(self, c: Certified) -> ca.MX:
        """Whether a plan meets the first-order conditions to the tolerances."""
        t = self.settings
        feasible = ca.logic_and(c.broken <= t.feasible, c.error <= t.scaled_tolerance(self.scales))
        return ca.logic_and(c.left <= t.tolerance, feasible)


State = dict[str, ca.MX]
_POINT = tuple(f"point_{name}" for name in Expansion._fields)


@cache
def constant(value: float) -> ca.MX:
    """Return the number as an expression: the same object every time, so that `choose` does not change it."""
    return ca.MX(value)


def fixed(**values: float) -> State:
    """Return entries of the state that are numbers."""
    return {name: constant(value) for name, value in values.items()}


def point(s: State) -> Expansion:
    """Return the plan from which the next one starts, expanded."""
    return Expansion(*(s[name] for name in _POINT))


def as_point(p: Expansion) -> State:
    """Return the entries of the state that hold this plan."""
    return dict(zip(_POINT, p, strict=True))


def as_best(s: State) -> State:
    """Return the entries that hold the plan as the best one of its pure phase."""
    return {"best_inputs": s["point_inputs"], "best_states": s["point_states"], "best_z": s["z"]}


def as_last(c: Certified) -> State:
    """Return the entries that hold how far the last plan is from the first-order conditions."""
    return {"last_error": c.error, "last_left": c.left, "last_violation": c.violation, "last_broken": c.broken}


def choose(base: State, condition: ca.MX, yes: State, no: State) -> State:
    """Return `yes` or `no` over `base`; an entry that is the same object in both is not touched."""
    chosen_state: State = {}
    yes, no = {**base, **yes}, {**base, **no}
    for name in {**yes, **no}:
        one, other = yes[name], no[name]
        chosen_state[name] = one if one is other else ca.if_else(condition, one, other)
    return chosen_state


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


def guess(ocp: OptimalControl) -> ca.Function:
    """Function theta -> (reference as a stage's state (ns), feedforward (nu)).

    States without a reference are those of the nodes.
    """
    theta = ca.SX.sym("theta", ocp.data.size)
    reference, forward = (theta[ocp.data.slice(name)] for name in ("reference", "feedforward"))
    if ocp.inner:
        reference = ca.vertcat(*(reference[k] if k >= 0 else value for k, value in ocp.inner))
    rest = ocp.state.size - reference.numel() - ocp.written
    state = ca.vertcat(reference, *([forward] if rest else []), ca.SX.zeros(ocp.written))
    return ca.Function("fpirhc_guess", [theta], [ca.densify(state), ca.densify(forward)])


def guesses(ocp: OptimalControl) -> ca.Function:
    """Function data (ntheta, N + 1) -> (ns, N + 1), (nu, N + 1)."""
    return guess(ocp).map(ocp.stages + 1)
