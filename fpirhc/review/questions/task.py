"""Is the task what a controller can do? It is well posed, starts inside its limits, and stays where the review sees it."""

from __future__ import annotations

import numpy as np

from fpirhc.controllers.observed_state import UnobservableErrors, unobservable_errors
from fpirhc.errors import NotSupported
from fpirhc.plant.chain import relative_order
from fpirhc.plant.motion import outside_names
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.question import Answer, ProblemQuestion, Verdict, decided
from fpirhc.symbolic.live import nominal
from fpirhc.task.exogenous import real_values, rows_of
from fpirhc.task.problem import Problem

WELL_POSED = "Is the problem well posed?"


def well_posed(grid: ReviewGrid) -> Answer:
    """Return whether the reference is smooth enough, and its commands finite over the box of parameters."""
    plant = grid.problem.plant
    whole = np.isfinite(grid.states).all(axis=1) & np.isfinite(grid.responses).all(axis=1)
    if not whole.all():
        when = grid.times[int(np.argmin(whole))]
        change = "Give a reference with as many finite derivatives as the plant's order."
        return Answer(
            WELL_POSED,
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
            WELL_POSED, Verdict.NO, text, "Keep the reference away from states where the response is singular.", numbers
        )
    if share < 1:
        text = f"finite commands at {100 * share:.3g} % of the points and draws of the parameters"
        return Answer(
            WELL_POSED, Verdict.CAUTION, text, "Narrow the box of the parameters, or move the reference.", numbers
        )
    return Answer(
        WELL_POSED,
        Verdict.YES,
        f"finite at {len(grid.times)} points with {len(grid.draws)} parameter draw{'s' * (len(grid.draws) > 1)}{_simulated(grid)}",
        "",
        numbers,
    )


def _simulated(grid: ReviewGrid) -> str:
    """Half a sentence about the inner states, empty without any."""
    names = [grid.problem.plant.state.elements[k] for k in grid.inner]
    if not names:
        return ""
    has, are = ("has", "is") if len(names) == 1 else ("have", "are")
    if (np.ptp(grid.states, axis=0) == 0).all():
        return f"; {', '.join(names)} {are} where the plant rests on the reference"
    return f"; {', '.join(names)} {has} no task and {are} simulated"


ORDERS = "Are the relative orders those of the plant?"


def relative_orders(grid: ReviewGrid) -> Answer:
    """Return the structural order of every controlled coordinate; a sum below the size of the state leaves zero dynamics."""
    plant = grid.problem.plant
    declared = plant.response_orders
    structural = {name: relative_order(plant, name) for name in plant.controlled_names}
    text = ", ".join(f"{c} {r}" for c, r in structural.items())
    inside = plant.state.size - sum(declared.values())
    alone = "moves by itself" if inside == 1 else "move by themselves"
    which = "the only state" if plant.state.size == 1 else f"{inside} of {plant.state.size} states"
    whole = "; the controlled coordinates and their derivatives make up the whole state"
    text += f"; {which} {alone}" if inside else whole
    numbers = {**{f"order_{c}": float(r or 0) for c, r in structural.items()}, "internal_states": float(inside)}
    change = "Write the response as the derivative that the input acts on."
    return Answer(ORDERS, decided(structural == declared), text, change, numbers)


START = "Does the run start inside the limits of states?"


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
    soft = set(outside) <= {*problem.limits.soft, *problem.limits.prices}
    change = f"Move the start of {', '.join(outside)} inside the limits, widen them, or make them soft."
    verdict = Verdict.YES if not outside else Verdict.CAUTION if soft else Verdict.NO
    return Answer(START, verdict, text, change, numbers)


OUTSIDE = "Do signals from outside stay where the review sees them?"
_SAME = 1e-9  # relative distance that counts as none


def stay_nominal(grid: ReviewGrid) -> Answer | None:
    """Return whether every signal from outside has its nominal value all the time; None without signals."""
    problem = grid.real if grid.real is not None else grid.problem
    plant = problem.real_plant
    if not outside_names(plant):
        return None
    times = np.linspace(0.0, problem.duration, len(grid.times))
    rows = rows_of(real_values(plant, problem.signals), times, plant.exact)
    facts, moves = [], False
    for name in outside_names(plant):
        place = plant.parameter.elements.index(name)
        low, high, nominal = rows[:, place].min(), rows[:, place].max(), plant.parameters[name].exact
        moves |= max(abs(low - nominal), abs(high - nominal)) > _SAME * (1 + abs(nominal))
        values = f"{low:.6g}" if f"{low:.6g}" == f"{high:.6g}" else f"{low:.6g} to {high:.6g}"
        facts.append(f"{name} is {nominal:.6g} {plant.parameters[name].unit} here, {values} in the run")
    change = "Review other values too: outside(nominal=...)."
    return Answer(OUTSIDE, Verdict.CAUTION if moves else Verdict.YES, "; ".join(facts), change)


BELIEVED = "Are the believed states right after a while?"


def right_after_a_while(grid: ReviewGrid) -> Answer | None:
    """Return which errors no measurement corrects, and their slowest pole; None where every state is measured or estimated."""
    problem = grid.problem
    believed = problem.sensing.believed(problem.plant)
    if not believed:
        return None
    try:
        free = unobservable_errors(problem)
    except NotSupported:
        return None
    measured = ", ".join(problem.sensing.measures(problem.plant))
    if not free.states:
        return Answer(
            BELIEVED, decided(good=True), f"all errors of {', '.join(believed)} show in {measured}, which corrects them"
        )
    text = f"no measurement ({measured}) corrects the errors of {', '.join(free.states)}; {_decay(problem, free)}"
    change = f"Measure {free.states[0]}, or a quantity that depends on it."
    return Answer(BELIEVED, decided(free.decays), text, change, {"pole": free.pole})


def _decay(problem: Problem, free: UnobservableErrors) -> str:
    if free.decays:
        return f"they decay by themselves, with a time constant of {-1 / free.pole:.3g} {problem.time_unit} or less"
    return f"they do not decay by themselves (pole {free.pole:.3g} {problem.rate_unit})"


QUESTIONS = (
    ProblemQuestion(well_posed, WELL_POSED, order=1, doubts=True),
    ProblemQuestion(relative_orders, ORDERS, order=2),
    ProblemQuestion(right_after_a_while, BELIEVED, order=20),
    ProblemQuestion(stay_nominal, OUTSIDE, order=22),
    ProblemQuestion(start_keeps_limits, START, order=29),
)
