"""Why a plan does not keep its limits, read from the plan of least violation itself.

A limit that the first state violates already, one that cannot be kept on the way, one that is violated to the end, and an end that
is out of reach have different remedies. An optimiser that ends with the least violation shows which it is: where the limit is
passed, whether the plan comes back, and which inputs stand at their limits meanwhile.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.scales import tolerated

_EQUATION = 1e-6  # limits closer together than this are an equation
_AT_LIMIT = 1e-3  # of its range: an input this near counts as at its limit
_MOSTLY = 0.5  # share of the stages on which an input that stands at its limit is named


@dataclass(frozen=True, eq=False)
class Breach:
    """One side of one limit, and by how much the states s_0 ... s_N are beyond it.

    Args:
        name: of the state.
        unit: of the state.
        limit: the number.
        side: 'above' or 'below'.
        beyond: shape (N + 1,), zero where the limit is kept; s_0 of a written entry counts as kept.
        equation: whether both sides are the same.
        tolerated: violation that still counts as kept.
    """

    name: str
    unit: str
    limit: float
    side: str
    beyond: np.ndarray
    equation: bool
    tolerated: float

    @property
    def stages(self) -> np.ndarray:
        """The nodes after the first one at which it is violated."""
        return 1 + np.flatnonzero(self.beyond[1:] > self.tolerated)


def breaches(ocp: OptimalControl, states: np.ndarray) -> list[Breach]:
    """Return the hard limits that a trajectory violates after its first state, the largest violation first.

    Args:
        ocp: the problem.
        states: X, shape (ns, N + 1).
    """
    violated, most = [], tolerated(ocp)
    for k in np.flatnonzero(ocp.hard).tolist():
        low, high = ocp.state_lower[k], ocp.state_upper[k]
        with np.errstate(invalid="ignore"):  # a plan that is not finite is beyond no limit
            sides = ("above", high, states[k] - high), ("below", low, low - states[k])
        for side, limit, over in sides:
            beyond = np.where(np.isfinite(over), np.maximum(over, 0), 0.0)
            if k >= ocp.state.size - ocp.written:
                beyond[0] = 0
            equation = bool(high - low <= _EQUATION)
            one = Breach(
                ocp.state.elements[k], ocp.state.units[k], float(limit), side, beyond, equation, float(most[k])
            )
            if one.stages.size:
                violated.append(one)
    return sorted(violated, key=lambda b: -float(b.beyond[1:].max()))


def reasons(
    ocp: OptimalControl, states: np.ndarray, inputs: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]
) -> tuple[str, ...]:
    """Return one sentence for every violated limit: what stops the plan, and whether a soft limit would help.

    Args:
        ocp: the problem.
        states: X, shape (ns, N + 1), of a plan of least violation.
        inputs: U, shape (nu, N).
        bounds: lower and upper limits of the inputs, shape (nu,) each.
    """
    violated = breaches(ocp, states)
    sentences = []
    for breach in violated:
        stuck = _at_their_limits(ocp, inputs[:, : int(breach.stages[-1])], bounds)
        others = [f"'{b.name}'" for b in violated if b is not breach]
        sentences.append(_sentence(ocp, breach, stuck, others))
    return tuple(sentences)


def _sentence(ocp: OptimalControl, breach: Breach, stuck: list[str], others: list[str]) -> str:
    last, most = int(breach.stages[-1]), float(breach.beyond[1:].max())
    amount = f"{most:.3g} {breach.unit}".strip()
    length = f"{ocp.stages} stages ({ocp.stages * ocp.step:g} {ocp.time_unit})"
    held = f" with {' and '.join(stuck)} at the limit" if stuck else ""
    if breach.equation and breach.name.endswith(" at the end"):
        return (
            f"'{breach.name}' misses the reference by {amount}{held}: a horizon of {length} is too short to reach it; "
            f"lengthen it, or take '{breach.name.removesuffix(' at the end')}' out of Horizon(terminal=...)"
        )
    limit = f"'{breach.name}' {breach.side} {breach.limit:g}"
    begins = breach.beyond[0] > breach.tolerated
    start = f"begins {breach.beyond[0]:.3g} {breach.unit} beyond it".replace("  ", " ") if begins else "begins inside"
    if last == ocp.stages:
        left = f"{breach.beyond[-1]:.3g} {breach.unit}".strip()
        why = "softening would not bring it inside" if begins else "softening would only let it leave"
        return (
            f"{limit}: {start} and is still {left} beyond at the end of {length}{held}; {why}. {_remedy(stuck, others)}"
        )
    back = f"stage {last + 1} ({(last + 1) * ocp.step:g} {ocp.time_unit})"
    middle = "cannot be back" if begins else f"passes it by {amount} and cannot be back"
    return (
        f"{limit}: {start}, {middle} before {back}{held}; softening helps: with "
        f"Limits(soft={{{_softened(breach.name)!r}: ...}}) the limit is violated until then, and kept afterwards"
    )


def _remedy(stuck: list[str], others: list[str]) -> str:
    if stuck:
        return "Give the inputs more range, lengthen the horizon, or widen the limit"
    if others:
        return f"No input is at its limit, so limits contradict one another: it stands against {', '.join(others)}"
    return "No input is at its limit: the inputs do not reach this state within the horizon; lengthen it or widen the limit"


def _softened(name: str) -> str:
    return name.removesuffix(" rate").removesuffix(" with margin")


def _at_their_limits(ocp: OptimalControl, inputs: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> list[str]:
    """Inputs that stand at a limit on most of these stages."""
    lower, upper = bounds
    with np.errstate(invalid="ignore"):
        reach = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    near = _AT_LIMIT * reach[:, None]
    share = ((inputs - lower[:, None] <= near) | (upper[:, None] - inputs <= near)).mean(axis=1)
    return [f"'{ocp.input.elements[k]}'" for k in np.flatnonzero(share >= _MOSTLY)]
