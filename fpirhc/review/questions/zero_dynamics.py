"""Are the zero dynamics stable? They are the motion of the other states while the controlled ones stay on the reference.

With x' = A x + B u and the responses y^(r) = C x + D u of the controlled coordinates at zero, u = -D^-1 C x, the states that leave
the derivatives below them at zero move by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import tracking_law
from fpirhc.plant.maps import growth_of, step_of
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import LITTLE, Loops, is_planned
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.spectra import dead_cycles
from fpirhc.review.stages import stiff_advice
from fpirhc.review.state_slopes import StateSlopes, state_slopes
from fpirhc.simulation.linearise.linear_loop import NEUTRAL
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem

ZERO_DYNAMICS = "Are the zero dynamics stable?"
_BESIDE = 1.1  # the growth of the zero dynamics is that of the plant, and the nominal loop is that of the model
_STILL = 1e-4  # growth over the run, as a share, below which a mode is neutral


def zero_dynamics_rate(grid: ReviewGrid) -> float | None:
    """Return the largest real part of the zero dynamics along the reference, per unit of time; None where there are none.

    Of a map it is the largest rate with which one of its modes grows; minus infinity where all end within a few cycles.
    """
    plant = grid.problem.plant
    if sum(plant.response_orders.values()) == plant.state.size:
        return None
    modes = zero_dynamics_modes(grid, [k for k in range(len(grid.times)) if np.isfinite(grid.commands[0, k]).all()])
    growth = growth_of(plant)
    return max((float(growth(one).max()) for one in modes), default=float("nan"))


def of_zero_dynamics(grid: ReviewGrid, radius: float) -> bool:
    """Whether the loop grows no faster than the states that the controlled coordinates leave to themselves."""
    rate, period = zero_dynamics_rate(grid), grid.problem.period
    if rate is None or not rate > 0:
        return False
    grown = float(step_of(grid.problem.plant, np.array([[rate]]), period)[0, 0]) - 1
    return radius - 1 <= _BESIDE * grown


def zero_dynamics_modes(grid: ReviewGrid, places: Sequence[int]) -> list[np.ndarray]:
    """Return the eigenvalues of the zero dynamics at points of the reference, per unit of time; none where all is controlled."""
    plant = grid.problem.plant
    return [_modes(state_slopes(plant, grid.states[k], grid.commands[0, k], plant.exact)) for k in places]


def _modes(slopes: StateSlopes) -> np.ndarray:
    """Eigenvalues of A - B D^-1 C on the states that leave all derivatives below the responses at zero, Y x = 0."""
    from scipy.linalg import null_space  # it takes longer to import than a problem to load

    inside = null_space(slopes.y)
    motion = slopes.a - slopes.b @ np.linalg.solve(slopes.d, slopes.c)
    return np.asarray(np.linalg.eigvals(inside.T @ motion @ inside))


def zero_dynamics(problem: Problem, rate: float | None, planned: bool, loops: Loops) -> Answer:
    """Return whether the zero dynamics are stable, with their rate and its sign.

    Args:
        problem: the problem.
        rate: largest real part of the zero dynamics, per unit of time; None where there are none.
        planned: whether the controller is a plan; with these states in its cost it may hold unstable ones.
        loops: linear loops of the controller.
    """
    if rate is None:
        return Answer(ZERO_DYNAMICS, Verdict.YES, "there are none: every coordinate is controlled")
    numbers, text = {"rate": rate}, _text(problem, rate)
    neutral = abs(rate) * problem.duration <= _STILL
    if ((planned and rate > 0) or neutral) and loops.loops:
        radius = float(loops.radii.max())
        numbers["radius"] = radius
        text += f"; the slowest mode of the linear loop is multiplied by {radius:.6g} per cycle"
        if radius < 1:
            held = text.replace("unstable: ", "unstable by themselves and held by the plan: ", 1)
            return Answer(ZERO_DYNAMICS, Verdict.YES, held, "", numbers)
        little = radius < 1 + NEUTRAL or min(rate * problem.duration, radius**problem.cycles - 1) < LITTLE
        verdict = Verdict.UNKNOWN if loops.learns or neutral or little else Verdict.NO
        return Answer(
            ZERO_DYNAMICS, verdict, text, "Weigh the other states in the cost, or lengthen the horizon.", numbers
        )
    if rate < 0 and not neutral:
        return Answer(ZERO_DYNAMICS, Verdict.YES, text, "", numbers)
    if rate * problem.duration > LITTLE and not planned:
        change = "Let a plan carry those states in its cost, use time slots, or control another coordinate."
        return Answer(ZERO_DYNAMICS, Verdict.NO, text, change, numbers)
    change = "Run it and look at the coordinates that are not controlled."
    if planned and rate > 0 and not neutral:
        change = f"A plan holds them only if its cost weighs those states. {change}"
    return Answer(ZERO_DYNAMICS, Verdict.UNKNOWN, text, change, numbers)


def _text(problem: Problem, rate: float) -> str:
    unit = problem.rate_unit
    if rate == -np.inf:
        return "stable: while the reference is followed they end within as many cycles as they have states"
    if not np.isfinite(rate):
        return "their rate is not known: the reference has no finite command"
    if abs(rate) * problem.duration <= _STILL:
        return "the slowest of them neither grows nor decays"
    if rate > 0:
        grown = rate * problem.duration
        over = f", by {in_percent(grown)} over the run" if grown <= LITTLE else ""
        return f"unstable: while the reference is followed they grow at up to {rate:.3g} {unit}{over}"
    return f"stable: while the reference is followed they decay at {-rate:.3g} {unit} or faster"


RATES = "Is the sampling fast enough for the tracking law?"


def rates_inside(grid: ReviewGrid, controller: Controller, loops: Loops) -> Answer:
    """Return the two products, and whether the loop of plant = model without deformation converges."""
    period, cycles = grid.problem.period, dead_cycles(grid.problem)
    rate = _rate(controller)
    numbers = {} if rate is None else {"rate_period": rate * period, "rate_dead_time": rate * cycles * period}
    text = f"dead time {cycles:g} cycles"
    if rate is not None:
        text = f"rate x period {rate * period:.3g}, rate x dead time {rate * cycles * period:.3g}"
    if loops.ideal is None:
        return Answer(RATES, Verdict.UNKNOWN, f"{text}; no linear loop: {loops.reason}", "", numbers)
    radius = loops.ideal.radius
    numbers["ideal_radius"] = radius
    text += f"; in the nominal loop, plant = model, the slowest mode is multiplied by {radius:.6g} per cycle"
    if radius < 1:
        return Answer(RATES, Verdict.YES, text, "", numbers)
    if of_zero_dynamics(grid, radius):
        change = "It is the mode of the zero dynamics, which no rate and no period changes: see there."
        return Answer(RATES, Verdict.UNKNOWN, text, change, numbers)
    believed = controller.plant_model(grid.problem).parameters(grid.problem.plant)
    change = stiff_advice(grid, believed, planned=is_planned(controller)) or (
        "Lower the rate, shorten the period, or predict over the dead time (Predicted)."
        if cycles
        else "Lower the rate, or shorten the period."
    )
    if radius < 1 + NEUTRAL:
        change = "A mode neither grows nor decays: weigh the state or the input in which it is."
        return Answer(RATES, Verdict.UNKNOWN, text, change, numbers)
    return Answer(RATES, Verdict.NO, text, change, numbers)


def _rate(controller: Controller) -> float | None:
    """Rate of the tracking law, per unit of time, where the controller has such a law."""
    law = tracking_law(controller)
    return None if law is None else law.speed


def _rates(case: Case) -> Answer:
    return rates_inside(case.grid, case.controller, case.loops)


def _zero_dynamics(case: Case) -> Answer:
    return zero_dynamics(case.problem, zero_dynamics_rate(case.grid), is_planned(case.controller), case.loops)


QUESTIONS = (
    ControllerQuestion(_rates, RATES, order=20, adaptive=False),
    ControllerQuestion(_zero_dynamics, ZERO_DYNAMICS, order=21, adaptive=False),
)
