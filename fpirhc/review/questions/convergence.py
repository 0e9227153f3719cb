"""Does the deformation converge, are the zero dynamics stable, and is the sampling fast enough? The verdict of a review.

Zero dynamics: with x' = A x + B u and the responses y^(r) = C x + D u at zero, u = -D^-1 C x, the states that leave the derivatives
below them at zero move by themselves. Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import tracking_law
from fpirhc.deformation.base import Deformation
from fpirhc.plant.maps import growth_of, quick_step_of
from fpirhc.review.grid import ReviewGrid, StateSlopes, is_late, state_slopes
from fpirhc.review.loops import (
    LITTLE,
    Loops,
    dead_cycles,
    eigenvalues_near,
    is_planned,
    largest_product,
    loops_over_box,
)
from fpirhc.review.question import Answer, Case, ControllerQuestion, Verdict, by_run, duration, per_cycle
from fpirhc.review.questions.integration import stiff_advice
from fpirhc.simulation.linearise.linear_loop import NEUTRAL, LinearLoop
from fpirhc.summary import in_percent
from fpirhc.symbolic.live import nominal
from fpirhc.task.problem import Problem

ZERO_DYNAMICS = "Are the zero dynamics stable?"
_INSIDE = 1e-12  # of the largest singular value, below which a direction moves no derivative below the responses
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
    grown = float(quick_step_of(grid.problem.plant, np.array([[rate]]), period)[0, 0]) - 1
    return radius - 1 <= _BESIDE * grown


def zero_dynamics_modes(grid: ReviewGrid, places: Sequence[int]) -> list[np.ndarray]:
    """Return the eigenvalues of the zero dynamics at points of the reference, per unit of time; none where all is controlled."""
    plant = grid.problem.plant
    return [_modes(state_slopes(plant, grid.states[k], grid.commands[0, k], plant.exact)) for k in places]


def _modes(slopes: StateSlopes) -> np.ndarray:
    """Eigenvalues of A - B D^-1 C on the states that leave all derivatives below the responses at zero, Y x = 0."""
    _, sizes, turned = np.linalg.svd(slopes.y)
    inside = turned[int((sizes > _INSIDE * sizes.max(initial=0.0)).sum()) :].T
    motion = slopes.a - slopes.b @ np.linalg.solve(slopes.d, slopes.c)
    return np.asarray(np.linalg.eigvals(inside.T @ motion @ inside))


def zero_dynamics(problem: Problem, rate: float | None, planned: bool, loops: Loops) -> Answer:
    """Return whether the zero dynamics are stable, with their rate and its sign.

    Args:
        rate: largest real part of the zero dynamics, per unit of time; None where there are none.
        planned: whether the controller is a plan; with these states in its cost it may hold unstable ones.
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
        verdict = Verdict.CAUTION if neutral or little else Verdict.UNKNOWN if loops.learns else Verdict.NO
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
    return Answer(ZERO_DYNAMICS, Verdict.CAUTION if neutral else Verdict.UNKNOWN, text, change, numbers)


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
        return Answer(RATES, Verdict.CAUTION, text, change, numbers)
    believed = controller.plant_model(grid.problem).parameters(grid.problem.plant)
    change = stiff_advice(grid, believed, planned=is_planned(controller)) or (
        "Lower the rate, shorten the period, or predict over the dead time (Predicted)."
        if cycles
        else "Lower the rate, or shorten the period."
    )
    if radius < 1 + NEUTRAL:
        change = "A mode neither grows nor decays: weigh the state or the input in which it is."
        return Answer(RATES, Verdict.CAUTION, text, change, numbers)
    return Answer(RATES, Verdict.NO, text, change, numbers)


def _rate(controller: Controller) -> float | None:
    """Rate of the tracking law, per unit of time, where the controller has such a law."""
    law = tracking_law(controller)
    return None if law is None else law.speed


def _rates(case: Case) -> Answer | None:
    return rates_inside(case.grid, case.controller, case.loops) if case.feeds_back else None


def _zero_dynamics(case: Case) -> Answer:
    return zero_dynamics(case.problem, zero_dynamics_rate(case.grid), is_planned(case.controller), case.loops)


CONVERGES = "Does the deformation converge?"
BOX = "Does it converge all over the box of parameters?"
_OF_THE_PLANT = "The slowest mode is that of the zero dynamics, which no gain changes: see there."
_SURE = math.log(100)
_NEAR = 0.1  # distance from a mode of the zero dynamics, as a share of its own distance from 1


def converges(grid: ReviewGrid, controller: Controller, loops: Loops, doubts: list[str]) -> Answer:
    """Return whether the deformation of a controller converges."""
    if not loops.loops:
        return Answer(CONVERGES, Verdict.UNKNOWN, f"no linear loop: {loops.reason}", "Run it and look at the factor.")
    radii, left_out = _own_radii(grid, loops)
    growth = np.log(np.maximum(radii, 1e-300)) * grid.problem.cycles
    worst = float(radii.max())
    text = f"the slowest mode of the linear loop {per_cycle(worst, grid.problem)}"
    if left_out:
        text += f", beside those of the states that move by themselves, {float(loops.radii.max()):.6g}"
    numbers = {"radius": worst, "smallest_radius": float(radii.min())}
    if changing := _changing_on_line(controller, loops):
        change = f"{changing} on line; the factor is that of the first cycle."
        return Answer(CONVERGES, Verdict.UNKNOWN, text, change, numbers)
    if growth.min() > _SURE:
        return Answer(
            CONVERGES, Verdict.NO, f"{text}: it grows all along the reference", _mend(grid, controller, loops), numbers
        )
    if growth.max() > -_SURE:
        ends = [f"{end:.6g}" for end in (radii.min(), worst)]
        text += f" (between {' and '.join(ends)} along the reference)" if ends[0] != ends[1] else ""
        slow = _slow(grid, controller, loops, worst)
        verdict = Verdict.CAUTION if slow else Verdict.UNKNOWN
        return Answer(CONVERGES, verdict, text, slow or _mend(grid, controller, loops), numbers)
    against = [*([] if controller.deforms == "target" else _steep(grid, controller)), *doubts]
    if against:
        return Answer(
            CONVERGES, Verdict.UNKNOWN, f"{text}, but {'; '.join(against)}", "See the questions named.", numbers
        )
    return Answer(CONVERGES, Verdict.YES, text, "", numbers)


def _converges(case: Case) -> Answer:
    """The verdict; runs decide where the linear loop is not known, is that of the first cycle, or neither converges nor grows."""
    if not case.loops.loops:
        return by_run(case, CONVERGES, f"no linear loop: {case.loops.reason}")
    answer = converges(case.grid, case.controller, case.loops, case.doubts)
    changing = _changing_on_line(case.controller, case.loops)
    if answer.verdict != Verdict.UNKNOWN or (not changing and answer.numbers["smallest_radius"] >= 1):
        return answer
    ran = by_run(
        case, CONVERGES, f"{answer.evidence} in the first cycle; {changing} on line" if changing else answer.evidence
    )
    change = ran.change if changing or not answer.change else answer.change
    return replace(ran, change=change, numbers={**answer.numbers, **ran.numbers})


def _changing_on_line(controller: Controller, loops: Loops) -> str:
    """What changes while the controller runs, for the beginning of a sentence; empty where nothing does."""
    if loops.learns:
        return f"{type(controller).__name__} changes its model"
    constant = controller.deformation.iteration.constant
    return "" if constant else f"{_changing(controller.deformation)} changes its map"


def _changing(deformation: Deformation) -> str:
    """The name of the innermost part that changes on line."""
    while deformation.inner is not None and not deformation.inner.iteration.constant:
        deformation = deformation.inner
    return type(deformation).__name__


def box_converges(case: Case) -> Answer:
    """Return in how many draws of the parameters the linear loop converges; caution where it is not all of them."""
    grid, own = case.grid, case.loops
    if not own.loops:
        return Answer(BOX, Verdict.UNKNOWN, f"no linear loop: {own.reason}")
    # Without draws the box is a point: approximate and exact parameters are the same.
    radii = np.array([one.radius for one in loops_over_box(grid, case.controller, own) or own.loops])
    share = float((radii < 1).mean())
    worst = float(max(radii.max(), own.radii.max()))  # the box has its middle too
    draws = f"{len(radii)} draw{'s' * (len(radii) > 1)}"
    text = f"in {100 * share:.3g} % of {draws}; the worst mode is multiplied by {worst:.6g} per cycle"
    numbers = {"share": share, "radius": worst}
    if share == 1 and worst < 1:
        return Answer(BOX, Verdict.YES, text, "", numbers)
    change = "Lower the gain, or narrow the box of the parameters."
    if of_zero_dynamics(grid, worst):
        change = _OF_THE_PLANT
    elif own.radii.min() >= 1:
        change = "It does not converge along the reference either: see there."
    elif share == 1:
        change = "It does not converge at some points of the reference: see there."
    return Answer(BOX, Verdict.CAUTION, text, change, numbers)


def _slow(grid: ReviewGrid, controller: Controller, loops: Loops, worst: float) -> str:
    """What is quicker, where it converges at every point and is slow beside the loop with the right model; else nothing."""
    ideal = loops.ideal.radius if loops.ideal is not None else 1.0
    if worst <= ideal < 1:
        return "It converges as slowly as with the right model: the loop is slow without adaptation, not the iteration."
    if not ideal < worst < 1:
        return ""
    time = duration(_SURE / -math.log(worst) * grid.problem.period, grid.problem)
    leaks = ", or a leak with a smaller pole," if nominal(controller.deformation.iteration.leak) else ""
    return (
        f"It converges, and takes {time} for a factor of 100, more than the run has: a larger gain{leaks} is quicker."
    )


def _mend(grid: ReviewGrid, controller: Controller, loops: Loops) -> str:
    growing = max(float(loops.radii.max()), loops.ideal.radius if loops.ideal is not None else 0.0)
    if growing >= 1 and of_zero_dynamics(grid, growing):
        return _OF_THE_PLANT
    if loops.ideal is not None and loops.ideal.radius >= 1:
        believed = controller.plant_model(grid.problem).parameters(grid.problem.plant)
        stiff = stiff_advice(grid, believed, planned=is_planned(controller))
        outer = "The outer loop does not converge even with the right model"
        return f"{outer}. {stiff}" if stiff else f"{outer}: lower its rate, or predict over the dead time."
    iteration = controller.deformation.iteration
    if is_late(grid.problem) and iteration.slows_desired and iteration.pairing is None:
        return "Pair the deformation through the dead time."
    return "See the questions about the gain, the form and the tracking law."


def _own_radii(grid: ReviewGrid, loops: Loops) -> tuple[np.ndarray, bool]:
    """Largest |pole| at every point without the decaying modes of the zero dynamics, and whether any has been left out.

    A slow compartment fills at its own rate, however fast the deformation converges.
    """
    modes = zero_dynamics_modes(grid, loops.places)
    radii = np.array([_without(one, rates) for one, rates in zip(loops.loops, modes, strict=True)])
    return radii, bool((radii < loops.radii).any())


def _without(loop: LinearLoop, rates: np.ndarray) -> float:
    """Largest |pole| where each decaying rate takes away the pole that is nearest to it."""
    poles = loop.poles[~loop.hidden]
    for one in rates[rates.real < 0]:
        exact = np.exp(one * loop.period * len(loop.cycles))
        nearest = int(np.argmin(np.abs(poles - exact))) if poles.size else 0
        if poles.size and abs(poles[nearest]) < 1 and abs(poles[nearest] - exact) < _NEAR * abs(1 - exact):
            poles = np.delete(poles, nearest)
    return float(np.abs(poles).max(initial=0.0) ** (1 / len(loop.cycles)))


def _steep(grid: ReviewGrid, controller: Controller) -> list[str]:
    """Reasons why large errors may not converge: the steepest secant of the map leaves its limit near the reference."""
    deformation = controller.deformation
    believed = controller.plant_model(grid.problem).parameters(grid.problem.plant)
    eigenvalues = eigenvalues_near(grid, believed, grid.draws[:1], deformation.iteration, near=True).ravel()
    if not eigenvalues.size:
        return ["the response Jacobian is not finite near the reference"]
    reached = float((deformation.secant_gain() * np.abs(eigenvalues) ** 2 / eigenvalues.real).max())
    limit = largest_product(grid.problem, deformation, eigenvalues)
    if (deformation.secant_gain() * eigenvalues.real).min() <= 0:
        return ["near the reference the response Jacobian changes its sign"]
    if reached <= limit:
        return []
    return [
        f"near the reference its steepest secant times an eigenvalue reaches {reached:.3g}, and the limit is {limit:.3g}"
    ]


QUESTIONS = (
    ControllerQuestion(_converges, CONVERGES, order=1, of_targets=True),
    ControllerQuestion(box_converges, BOX, order=2, of_targets=True),
    ControllerQuestion(_rates, RATES, order=20, adaptive=False),
    ControllerQuestion(_zero_dynamics, ZERO_DYNAMICS, order=21, adaptive=False),
)
