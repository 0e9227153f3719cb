"""The state of the iteration with limits: a mapping of expressions, of which a part of a turn returns what it changes."""

from __future__ import annotations

from functools import cache

import casadi as ca

from fpirhc.horizon.sweep import Expansion
from fpirhc.optimisers.certified import Certified

State = dict[str, ca.MX]
PURE, INTERIOR = 0, 1  # phase
BEGINS, ENDS = 0, 1  # place_of: whether a pure phase stands before an interior one or after it
KEPT, COLD, WARM = 0, 1, 2  # slacks: as they are, made from the distances, or from the distances and the multipliers
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
