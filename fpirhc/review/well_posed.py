"""Is the problem well posed? Every quantity that a run needs along the reference must be finite."""

from __future__ import annotations

import numpy as np

from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid

QUESTION = "Is the problem well posed?"


def well_posed(grid: ReviewGrid) -> Answer:
    """Return whether the reference is smooth enough, and its commands finite over the box of parameters."""
    plant = grid.problem.plant
    whole = np.isfinite(grid.states).all(axis=1) & np.isfinite(grid.responses).all(axis=1)
    if not whole.all():
        when = grid.times[int(np.argmin(whole))]
        change = "Give a reference with as many finite derivatives as the plant's order."
        return Answer(
            QUESTION,
            Verdict.NO,
            f"the reference or a derivative is not finite at t = {when:g} {grid.problem.time_unit}",
            change,
        )
    finite = np.isfinite(grid.commands).all(axis=2)
    own = finite[0] & np.isfinite(grid.needed(plant.approximate)).all(axis=1)
    share = float(finite.mean())
    numbers = {"finite_share": share}
    if not own.all():
        when = grid.times[int(np.argmin(own))]
        text = f"plant or model has no finite command for the reference at t = {when:g} {grid.problem.time_unit}"
        return Answer(
            QUESTION, Verdict.NO, text, "Keep the reference away from states where the response is singular.", numbers
        )
    if share < 1:
        text = f"finite commands at {100 * share:.3g} % of the points and draws of the parameters"
        return Answer(
            QUESTION, Verdict.UNKNOWN, text, "Narrow the box of the parameters, or move the reference.", numbers
        )
    return Answer(
        QUESTION,
        Verdict.YES,
        f"finite at {len(grid.times)} points with {len(grid.draws)} parameter draws{_simulated(grid)}",
        "",
        numbers,
    )


def _simulated(grid: ReviewGrid) -> str:
    """Half a sentence about the inner states, empty without any."""
    names = [grid.problem.plant.state.elements[k] for k in grid.inner]
    if not names:
        return ""
    has, are = ("has", "is") if len(names) == 1 else ("have", "are")
    if grid.problem.plant.outputs:
        return f"; {', '.join(names)} {are} simulated, while the outputs follow their reference"
    return f"; {', '.join(names)} {has} no task and {are} simulated"
