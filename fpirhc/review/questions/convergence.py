"""Does the deformation converge? The verdict of a review.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import math

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.deformation.base import Deformation
from fpirhc.review.answer import Answer, Verdict, duration, per_cycle
from fpirhc.review.dead_time_variants import is_late
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import Loops, is_planned, loops_over_box
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.questions.zero_dynamics import of_zero_dynamics, zero_dynamics_modes
from fpirhc.review.spectra import eigenvalues_near, largest_product
from fpirhc.review.stages import stiff_advice
from fpirhc.simulation.linearise.linear_loop import LinearLoop
from fpirhc.symbolic.live import nominal

CONVERGES = "Does the deformation converge?"
BOX = "Does it converge all over the box of parameters?"
_OF_THE_PLANT = "The slowest mode is that of the zero dynamics, which no gain changes: see there."
_SURE = math.log(100)
_NEAR = 0.1  # distance from a mode of the zero dynamics, as a share of its own distance from 1


def converges(grid: ReviewGrid, controller: Controller, loops: Loops, doubts: list[str]) -> Answer:
    """Return whether the deformation of a controller converges.

    Args:
        grid: points of the reference and draws of the parameters.
        controller: the controller with its deformation.
        loops: its linear loops.
        doubts: reasons against convergence from other answers.
    """
    if not loops.loops:
        return Answer(CONVERGES, Verdict.UNKNOWN, f"no linear loop: {loops.reason}", "Run it and look at the factor.")
    radii, left_out = _own_radii(grid, loops)
    growth = np.log(np.maximum(radii, 1e-300)) * grid.problem.cycles
    worst = float(radii.max())
    text = f"the slowest mode of the linear loop {per_cycle(worst, grid.problem)}"
    if left_out:
        text += f", beside those of the states that move by themselves, {float(loops.radii.max()):.6g}"
    numbers = {"radius": worst, "smallest_radius": float(radii.min())}
    deformation = controller.deformation
    if not deformation.iteration.constant or loops.learns:
        what = (
            f"{type(controller).__name__} changes its model"
            if loops.learns
            else f"{_changing(deformation)} changes its map"
        )
        change = f"{what} on line; the factor is that of the first cycle."
        return Answer(CONVERGES, Verdict.UNKNOWN, text, change, numbers)
    if growth.min() > _SURE:
        return Answer(
            CONVERGES, Verdict.NO, f"{text}: it grows all along the reference", _mend(grid, controller, loops), numbers
        )
    if growth.max() > -_SURE:
        ends = [f"{end:.6g}" for end in (radii.min(), worst)]
        text += f" (between {' and '.join(ends)} along the reference)" if ends[0] != ends[1] else ""
        change = _slow(grid, controller, loops, worst) or _mend(grid, controller, loops)
        return Answer(CONVERGES, Verdict.UNKNOWN, text, change, numbers)
    against = [*([] if controller.deforms == "target" else _steep(grid, controller)), *doubts]
    if against:
        return Answer(
            CONVERGES, Verdict.UNKNOWN, f"{text}, but {'; '.join(against)}", "See the questions named.", numbers
        )
    return Answer(CONVERGES, Verdict.YES, text, "", numbers)


def _changing(deformation: Deformation) -> str:
    """The name of the innermost part that changes on line."""
    while deformation.inner is not None and not deformation.inner.iteration.constant:
        deformation = deformation.inner
    return type(deformation).__name__


def box_converges(case: Case) -> Answer:
    """Return in how many draws of the parameters the linear loop converges; unknown where it is not all of them."""
    grid, own = case.grid, case.loops
    if not own.loops:
        return Answer(BOX, Verdict.UNKNOWN, f"no linear loop: {own.reason}")
    # Without draws the box is a point: approximate and exact parameters are the same.
    radii = np.array([one.radius for one in loops_over_box(grid, case.controller, own) or own.loops])
    share, worst = float((radii < 1).mean()), float(radii.max())
    draws = f"{len(radii)} draw{'s' * (len(radii) > 1)}"
    text = f"in {100 * share:.3g} % of {draws}; the worst mode is multiplied by {worst:.6g} per cycle"
    numbers = {"share": share, "radius": worst}
    if share == 1:
        return Answer(BOX, Verdict.YES, text, "", numbers)
    change = "Lower the gain, or narrow the box of the parameters."
    if of_zero_dynamics(grid, worst):
        change = _OF_THE_PLANT
    elif own.radii.min() >= 1:
        change = "It does not converge along the reference either: see there."
    return Answer(BOX, Verdict.UNKNOWN, text, change, numbers)


def _slow(grid: ReviewGrid, controller: Controller, loops: Loops, worst: float) -> str:
    """What is quicker, where it converges at every point and is slow beside the loop with the right model; else nothing."""
    ideal = loops.ideal.radius if loops.ideal is not None else 1.0
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
    ControllerQuestion(
        lambda case: converges(case.grid, case.controller, case.loops, case.doubts), CONVERGES, order=1, of_targets=True
    ),
    ControllerQuestion(box_converges, BOX, order=2, of_targets=True),
)
