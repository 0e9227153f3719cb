"""Do integrators follow the plant? Poles of a stage of the horizon, and of a cycle, are compared with those of the plant.

A step of length h follows a mode lambda where one of its poles is near exp(lambda h). An explicit step of a fast mode does not: its
pole is a polynomial of lambda h and may lie outside the unit circle although the mode decays.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.horizon.horizon import Horizon
from fpirhc.plant.integrators import Integrator, poles, stiffness
from fpirhc.plant.maps import poles_over
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import ReviewGrid, state_slopes
from fpirhc.review.loops import is_planned, thinned
from fpirhc.review.question import Answer, Case, ControllerQuestion, ProblemQuestion, Verdict
from fpirhc.review.questions.reality import RealPoint, real_points

CLOSE = 0.05  # distance of a pole of the step from exp(pole of the plant x step)
_FINER = (2, 4, 8, 16, 32, 64)  # times the sub-steps in use


@dataclass(frozen=True)
class StepPoles:
    """Poles of one step beside those of the plant."""

    apart: float  # largest distance of exp(lambda h) from the nearest pole of the step
    fastest: float  # largest |lambda|, per unit of time
    largest: float  # largest |pole| of the step
    decays: bool  # whether no mode of the plant grows

    @property
    def unstable(self) -> bool:
        """Whether the step grows although the plant does not."""
        return self.decays and self.largest > 1 + CLOSE

    @property
    def follows(self) -> bool:
        """Whether the step follows every mode."""
        return not self.unstable and self.apart <= CLOSE


@dataclass(frozen=True, eq=False)
class Place:
    """A point at which a plant is linearised: state, input and parameters."""

    state: np.ndarray
    command: np.ndarray
    parameters: np.ndarray


def first_place(grid: ReviewGrid, parameters: np.ndarray) -> Place:
    """Return the start of the reference with these parameters."""
    return Place(grid.states[0], grid.needed(parameters)[0], parameters)


def step_poles(plant: Plant, integrator: Integrator, step: float, place: Place) -> StepPoles:
    """Return the poles of one step at a point."""
    rates = np.linalg.eigvals(state_slopes(plant, place.state, place.command, place.parameters).a)
    exact, matrix = poles_over(plant, rates, step), _matrix(plant, integrator, step, place)
    fastest, decays = float(np.abs(rates).max()), bool(np.abs(exact).max() <= 1 + 1e-9)
    if not np.isfinite(matrix).all():  # it grows beyond every number
        return StepPoles(np.inf, fastest, np.inf, decays)
    poles = np.linalg.eigvals(matrix)
    return StepPoles(
        float(max(np.abs(poles - one).min() for one in exact)), fastest, float(np.abs(poles).max()), decays
    )


HORIZON, CYCLE = "Horizon(discretisation={})", "Problem(integrator={})"


def advice(setting: str, plant: Plant, integrator: Integrator, step: float, place: Place) -> str:
    """Return, in a sentence, the integrator that follows the plant: explicit with few sub-steps, else implicit.

    `setting` is where it is set, such as `HORIZON`.
    """
    implicit = setting.format("RadauIIA()")
    in_use = setting.format(f"{type(integrator).__name__}()") == implicit
    for method in (integrator, Horizon(stages=1, step=step).discretisation):
        for times in _FINER:
            finer = method.finer(times)
            if finer is not None and step_poles(plant, finer, step, place).follows:
                other = "" if in_use else f", or {implicit} for modes that need not be followed"
                return f"Use {setting.format(finer)}, which follows every mode{other}."
    if in_use:
        return f"Shorten the step; no number of sub-steps up to {_FINER[-1]} times that in use follows every mode."
    return f"Use {implicit}; no number of explicit sub-steps up to {_FINER[-1]} times that in use follows every mode."


def stiff_advice(grid: ReviewGrid, believed: np.ndarray, *, planned: bool) -> str:
    """Return what to change where a step of the horizon or of the simulated plant grows by itself; empty where none does."""
    problem, plant = grid.problem, grid.problem.plant
    try:
        place, horizon, cycle = first_place(grid, believed), problem.horizon, problem.integrator
        if (
            planned
            and horizon is not None
            and step_poles(plant, horizon.discretisation, horizon.longest, place).unstable
        ):
            cure = advice(HORIZON, plant, horizon.discretisation, horizon.longest, place)
            return f"Its discretisation grows. {cure}"
        if not cycle.opaque and step_poles(plant, cycle, problem.period, place).unstable:
            return f"The integrator of the plant grows. {advice(CYCLE, plant, cycle, problem.period, place)}"
    except (FpirhcError, np.linalg.LinAlgError):
        return ""
    return ""


def _matrix(plant: Plant, integrator: Integrator, step: float, place: Place) -> np.ndarray:
    """D x+ / d x of one step."""
    function = integrator.step(plant, step)
    x, u, p, w = (ca.SX.sym(function.name_in(k), function.size1_in(k)) for k in range(4))
    slope = ca.Function("fpirhc_step_matrix", [x, u, p, w], [ca.jacobian(function(x, u, p, w), x)])
    return np.asarray(slope(place.state, place.command, place.parameters, np.zeros(len(plant.names))).full())


DISCRETISATION = "Does the discretisation of the horizon follow the plant?"


def discretisation_follows(grid: ReviewGrid) -> Answer | None:
    """Return how far poles of a stage are from exp(lambda h) at the start of the reference; None without one or for a map."""
    return stage_follows(grid, grid.problem.plant.approximate, DISCRETISATION)


def stage_follows(grid: ReviewGrid, believed: np.ndarray, question: str) -> Answer | None:
    """Return the same for a model with the believed parameters, shape (np,)."""
    problem, plant = grid.problem, grid.problem.plant
    if problem.horizon is None or problem.horizon.discretisation.steps_maps:
        return None
    h, discretisation = problem.horizon.longest, problem.horizon.discretisation
    place = first_place(grid, believed)
    try:
        poles = step_poles(plant, discretisation, h, place)
        change = "" if poles.follows else advice(HORIZON, plant, discretisation, h, place)
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(question, Verdict.UNKNOWN, f"the poles are not known: {error}")
    text = f"stage of {h:g} {problem.time_unit}, fastest mode {poles.fastest:.3g} {problem.rate_unit}"
    text += f"; poles of the stage are off by {poles.apart:.2g} at most"
    numbers = {"apart": poles.apart, "fastest_mode": poles.fastest, "largest_pole": poles.largest}
    if poles.unstable:
        text += f"; the plant's modes decay, but the discretisation grows by {poles.largest:.3g} per stage"
        return Answer(question, Verdict.NO, text, change, numbers)
    return Answer(question, Verdict.YES if poles.follows else Verdict.CAUTION, text, change, numbers)


OWN_MODEL = "Does the discretisation of the horizon follow the controller's own model?"


def own_model_stage(case: Case) -> Answer | None:
    """Return how far the poles of one stage are from those of the controller's model; None where it is the problem's model."""
    approximate = case.problem.plant.approximate
    if not is_planned(case.controller) or np.array_equal(case.believed, approximate):
        return None
    return stage_follows(case.grid, case.believed, OWN_MODEL)


PLANT = "Does the integrator follow the simulated plant?"
_POINTS = 5  # of the reference


def integrator_follows(grid: ReviewGrid) -> Answer | None:
    """Return how far poles of a cycle are from those of the plant; None for a map and for methods that control their error."""
    problem, plant = grid.problem, grid.problem.plant
    if problem.integrator.opaque or problem.integrator.steps_maps:
        return None
    usable = [k for k in range(len(grid.times)) if np.isfinite(grid.commands[0, k]).all()]
    points = [usable[k] for k in np.unique(np.linspace(0, len(usable) - 1, _POINTS).astype(int))] if usable else []
    places = [Place(grid.states[k], grid.commands[0, k], plant.exact) for k in points]
    try:
        poles = [step_poles(plant, problem.integrator, problem.period, place) for place in places]
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(PLANT, Verdict.UNKNOWN, f"the poles are not known: {error}")
    if not poles:
        return Answer(PLANT, Verdict.UNKNOWN, "the inverse does not exist along the reference")
    worst = max(range(len(poles)), key=lambda k: (poles[k].unstable, poles[k].apart))
    one = poles[worst]
    text = f"cycle of {problem.period:g} {problem.time_unit}, fastest mode {one.fastest:.3g} {problem.rate_unit}"
    text += f"; poles of the cycle are off by {one.apart:.2g} at most"
    numbers = {"apart": one.apart, "fastest_mode": one.fastest, "largest_pole": one.largest}
    if one.follows:
        return Answer(PLANT, Verdict.YES, text, "", numbers)
    change = advice(CYCLE, plant, problem.integrator, problem.period, places[worst])
    return Answer(PLANT, Verdict.NO if one.unstable else Verdict.CAUTION, text, change, numbers)


REALITY = "Does the integrator follow the reality along the reference?"


def reality_followed(grid: ReviewGrid) -> Answer | None:
    """Return whether a decaying mode of the reality grows where it settles on the reference; None without a reality."""
    problem = grid.real
    if problem is None:
        return None
    points = real_points(grid) or _placed(grid)
    plant, integrator = problem.real_plant, problem.real_integrator
    fastest_first = sorted(points, key=lambda one: -np.abs(poles(plant, one.real, one.command, plant.exact)).max())
    for point in fastest_first:
        stiff = stiffness(plant, integrator, problem.period, point.real, point.command, plant.exact)
        if stiff:
            what, _, remedy = stiff.partition("; use ")
            where = f"at t = {grid.times[point.place]:g} {problem.time_unit} "
            return Answer(REALITY, Verdict.NO, where + what, f"Use Reality({remedy}).")
    return Answer(REALITY, Verdict.YES, f"no decaying mode grows at {len(points)} points of the reference")


def _placed(grid: ReviewGrid) -> tuple[RealPoint, ...]:
    """Some points of the reference, for a reality that nowhere settles: the states of its own are those of its start."""
    assert grid.real is not None
    known, points = grid.real.truth.shared(grid.problem.plant), []
    for k in thinned(range(len(grid.times)), _POINTS):
        state = grid.real.real_start.copy()
        state[list(known.values())] = grid.states[k, list(known)]
        points.append(RealPoint(k, state, grid.real.inputs_before))
    return tuple(points)


QUESTIONS = (
    ProblemQuestion(discretisation_follows, DISCRETISATION, order=5),
    ProblemQuestion(integrator_follows, PLANT, order=20),
    ProblemQuestion(reality_followed, REALITY, order=21),
    ControllerQuestion(own_model_stage, OWN_MODEL, order=50, adaptive=False),
)
