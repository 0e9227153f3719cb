"""Does the run start inside the limits of states? A plan that starts outside them cannot keep them."""

from __future__ import annotations

from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.question import ProblemQuestion
from fpirhc.symbolic.live import nominal

TEXT = "Does the run start inside the limits of states?"


def start_keeps_limits(grid: ReviewGrid) -> Answer | None:
    """Return the states that start outside their limits; None without such limits."""
    problem, limits = grid.problem, nominal(grid.problem.limits).states
    if not limits:
        return None
    state = problem.plant.state
    units = dict(zip(state.elements, state.units, strict=True))
    start = dict(zip(state.elements, map(float, problem.start_state), strict=True))
    outside = [name for name, (low, high) in limits.items() if not low <= start[name] <= high]
    text = "; ".join(
        f"{name} starts at {start[name]:.4g} {units[name]}, limits {limits[name][0]:.4g} and {limits[name][1]:.4g}"
        for name in outside or limits
    )
    numbers = {"outside": float(len(outside))}
    if not outside:
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    soft = set(outside) <= {*problem.limits.soft, *problem.limits.prices}
    change = f"Move the start of {', '.join(outside)} inside the limits, widen them, or make them soft."
    return Answer(TEXT, Verdict.UNKNOWN if soft else Verdict.NO, text, change, numbers)


QUESTION = ProblemQuestion(ask=start_keeps_limits, order=29)
