"""Is the sampling fast enough for the tracking law? It is, where the nominal loop converges: that of plant = model."""

from __future__ import annotations

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import tracking_law
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import Loops
from fpirhc.review.maps import dead_cycles
from fpirhc.review.planned import is_planned
from fpirhc.review.stages import stiff_advice
from fpirhc.review.zero_dynamics import of_zero_dynamics
from fpirhc.simulation.linearise.linear_loop import NEUTRAL

QUESTION = "Is the sampling fast enough for the tracking law?"


def rates_inside(grid: ReviewGrid, controller: Controller, loops: Loops) -> Answer:
    """Return the two products, and whether the loop of plant = model without deformation converges."""
    period, cycles = grid.problem.period, dead_cycles(grid.problem)
    rate = _rate(controller)
    numbers = {} if rate is None else {"rate_period": rate * period, "rate_dead_time": rate * cycles * period}
    text = f"dead time {cycles:g} cycles"
    if rate is not None:
        text = f"rate x period {rate * period:.3g}, rate x dead time {rate * cycles * period:.3g}"
    if loops.ideal is None:
        return Answer(QUESTION, Verdict.UNKNOWN, f"{text}; no linear loop: {loops.reason}", "", numbers)
    radius = loops.ideal.radius
    numbers["ideal_radius"] = radius
    text += f"; in the nominal loop, plant = model, the slowest mode is multiplied by {radius:.6g} per cycle"
    if radius < 1:
        return Answer(QUESTION, Verdict.YES, text, "", numbers)
    if of_zero_dynamics(grid, radius):
        change = "It is the mode of the zero dynamics, which no rate and no period changes: see there."
        return Answer(QUESTION, Verdict.UNKNOWN, text, change, numbers)
    believed = controller.plant_model(grid.problem).parameters(grid.problem.plant)
    change = stiff_advice(grid, believed, planned=is_planned(controller)) or (
        "Lower the rate, shorten the period, or predict over the dead time (Predicted)."
    )
    if radius < 1 + NEUTRAL:
        change = "A mode neither grows nor decays: weigh the state or the input in which it is."
        return Answer(QUESTION, Verdict.UNKNOWN, text, change, numbers)
    return Answer(QUESTION, Verdict.NO, text, change, numbers)


def _rate(controller: Controller) -> float | None:
    """Rate of the tracking law, per unit of time, where the controller has such a law."""
    law = tracking_law(controller)
    return None if law is None else law.speed
