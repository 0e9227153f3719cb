"""Is the map fast enough, and its range large enough? Its largest step per cycle is compared with the change of the request.

Along the reference the request changes by |d r*/dt|. After a start off the reference a plan changes it faster: the step must also
B^ (v_{k+1} - v_k), with the commands v of the linear loop of plant = model from this start, within the limits of the inputs.
Some maps are valid only for requests that are much smaller than a constant of theirs.
"""

from __future__ import annotations

import math

import numpy as np

from fpirhc.contraction.delayed import basin_of_plain_form
from fpirhc.deformation.base import Deformation
from fpirhc.errors import InvalidValue
from fpirhc.plant.chain import controlled_unit, derivatives_function
from fpirhc.plant.motion import controlled_places, with_space
from fpirhc.review.grid import ReviewGrid, below_responses, state_slopes
from fpirhc.review.loops import is_planned
from fpirhc.review.prediction import errors_without_adaptation, response_errors
from fpirhc.review.question import Answer, Case, ControllerQuestion, Verdict, graded
from fpirhc.review.questions.speed import law_of
from fpirhc.simulation.linearise.linear_loop import LinearLoop
from fpirhc.task.disturbance import disturbed_place

SLEW = "Is the map fast enough for reference and disturbances?"
RANGE = "Is the map's range large enough for the requests?"
_ROOM = 10.0  # times the largest request
SPARE = 2.0  # how many times faster than the reference the map should be
_POINTS = 2001
_CYCLES = 1000  # after the start


def slew_enough(grid: ReviewGrid, deformation: Deformation, believed: np.ndarray, ideal: LinearLoop | None) -> Answer:
    """Return the slew limit of the map beside the slew that the reference, the disturbances and the start need.

    Args:
        believed: parameters of the model, shape (np,).
        ideal: the linear loop of a plan with the right model; None where no plan is in the loop.
    """
    problem = grid.problem
    after_start = 0.0 if ideal is None else _speed_after_start(grid, believed, ideal)
    speed = max(_speed(grid, believed), after_start)
    sudden = max((d.jump * effect(grid, name) for name, d in problem.disturbances.items()), default=0.0)
    steady = sum(d.slew * effect(grid, name) for name, d in problem.disturbances.items())
    needed, step = speed + steady, deformation.largest_step()
    numbers = {"needed": needed, "limit": step / problem.period, "jump": sudden}
    rate = with_space(controlled_unit(problem.plant, 1))
    text = f"the request changes by up to {needed:.3g}{rate or f' per {problem.time_unit}'}"
    if after_start == speed > 0:
        text += " after the start"
    if not math.isfinite(step):
        return Answer(SLEW, Verdict.YES, f"{text}; the map's step has no bound", "", numbers)
    text += f", the map by {step / problem.period:.3g}{rate}"
    if sudden:
        cycles = math.ceil(sudden / step)
        text += f"; a jump of a disturbance takes the map {cycles} cycle{'s' * (cycles > 1)}"
    ratio = step / problem.period / max(needed, 1e-300)
    change = f"Raise the map's scale at least {SPARE / ratio:.2g} times."
    return Answer(SLEW, graded(ratio, SPARE), text, change, numbers)


def _speed(grid: ReviewGrid, believed: np.ndarray) -> float:
    """Largest |d r*/dt|, by differences between points much closer than those of the review."""
    problem, plant = grid.problem, grid.problem.plant
    times = np.linspace(0.0, problem.duration, _POINTS)
    states = grid.states_at(times).T
    responses = np.asarray(problem.reference.function(plant).map(_POINTS)(times[None, :])[1].full())
    exact, model = (np.repeat(p[:, None], _POINTS, axis=1) for p in (plant.exact, believed))
    commands = plant.equations.inverse.map(_POINTS)(states, responses[controlled_places(plant)], exact)
    requests = np.asarray(plant.equations.controlled_response.map(_POINTS)(states, commands, model).full())
    speeds = np.linalg.norm(np.diff(requests, axis=1), axis=0) / (times[1] - times[0])
    return float(speeds[np.isfinite(speeds)].max(initial=0.0))


def _speed_after_start(grid: ReviewGrid, believed: np.ndarray, ideal: LinearLoop) -> float:
    """Largest |d r/dt| of the plan's feedback from the problem's start."""
    plant = grid.problem.plant
    command = np.nan_to_num(grid.commands[0, 0])
    slopes = state_slopes(plant, grid.states[0], command, believed)
    deviations = ideal.carried(ideal.placed @ _start_deviation(grid, slopes.y), _CYCLES)[1]
    commands = np.clip(command + deviations, *grid.problem.limits.input_bounds(plant))
    count = len(ideal.cycles)  # plans move the command in steps
    changes = np.linalg.norm((commands[count:] - commands[:-count]) @ slopes.d.T, axis=1)
    return float(changes.max() / (count * grid.problem.period))


def _start_deviation(grid: ReviewGrid, shown: np.ndarray) -> np.ndarray:
    """Deviation of the first state from the reference; with outputs the smallest one that explains theirs."""
    problem, plant = grid.problem, grid.problem.plant
    if not plant.outputs:
        return problem.start_state - grid.states[0]
    reference = np.asarray(problem.reference.function(plant)(0.0)[0].full()).ravel()
    return np.asarray(np.linalg.pinv(shown) @ (problem.start_output - reference)[below_responses(plant)])


def effect(grid: ReviewGrid, name: str) -> float:
    """Return the change of the responses by one unit of a disturbance: on an input the exact gain, on a state their slope.

    One that adds to a coordinate changes its own response by one. One that adds to an output changes the response by its own
    derivative, which is zero for a jump.
    """
    plant = grid.problem.plant
    of_input, name = disturbed_place(name, plant.inputs)
    if not of_input:
        return _effect_of_state(grid, name) if name in plant.coordinates else 0.0
    unit = np.array([1.0 if i == name else 0.0 for i in plant.inputs])
    command = np.nan_to_num(grid.commands[0, 0])
    respond = plant.equations.controlled_response
    change = respond(grid.states[0], command + unit, plant.exact) - respond(grid.states[0], command, plant.exact)
    return float(np.linalg.norm(change.full()))


def _effect_of_state(grid: ReviewGrid, name: str) -> float:
    """Change of the outputs' responses by one unit that adds to the rate of a state, at the start of the reference."""
    plant = grid.problem.plant
    orders = plant.chains
    function = derivatives_function(plant, [(n, orders[n]) for n in plant.controlled_names])
    at = grid.states[0], np.nan_to_num(grid.commands[0, 0]), plant.exact
    unit = np.array([1.0 if n == name else 0.0 for n in plant.names])
    return float(np.linalg.norm((function(*at, unit) - function(*at, 0 * unit)).full()))


def range_enough(grid: ReviewGrid, deformation: Deformation, believed: np.ndarray) -> Answer | None:
    """Return the ratio of the map's constant to the largest request; None for a map without such a constant."""
    reach = deformation.iteration.reach
    if reach is None:
        return None
    size, name = reach.size, reach.name
    requests = grid.requests(believed)
    largest = float(np.nan_to_num(np.linalg.norm(np.hstack([requests, grid.responses]), axis=1)).max())
    ratio = size / max(largest, 1e-300)
    unit = with_space(controlled_unit(grid.problem.plant))
    text = f"{name} {size:.3g} is {ratio:.3g} times the largest request and response, {largest:.3g}{unit}"
    change = f"Use {name} = {_ROOM * largest:.2g} or more."
    return Answer(RANGE, graded(ratio, _ROOM), text, change, {"ratio": ratio})


BASIN = "Does it come back from the largest response error?"
# The basin is that of a single error. An error that lasts, as after a start off the reference, feeds the tracking law meanwhile:
# in simulated starts up to 0.43 of the basin was lost.
_LASTING, _WANTED = 2.5, 4.0


def comes_back(case: Case) -> Answer | None:
    """Return the largest response error beside the basin; None for other forms, laws without known poles, unbounded steps."""
    deformation = case.controller.deformation
    law, step = law_of(case.grid, case.controller), deformation.largest_step()
    plain = deformation.adapts and deformation.iteration.slows_desired and deformation.iteration.pairing is None
    if law is None or not plain or not (0 < step < math.inf):
        return None
    error = _largest_error(case)
    eigenvalue = _smallest_eigenvalue(case)
    if error is None or eigenvalue is None or law[1] < 2:
        return None
    (rate, poles), period = law, case.problem.period
    basin = basin_of_plain_form(step, poles, rate, period, eigenvalue=eigenvalue)
    ratio = basin / max(error, 1e-300)
    unit = with_space(controlled_unit(case.problem.plant))
    text = f"errors up to {error:.3g}{unit} are predicted; "
    text += f"it comes back from a single one of {basin:.3g}{unit}, {ratio:.3g} times as large"
    text += "" if ratio >= _WANTED else f", where {_WANTED:g} times are wanted, because errors that last add up"
    numbers = {"error": error, "basin": basin}
    unsure = ratio > _LASTING or not deformation.iteration.constant
    verdict = Verdict.YES if ratio >= _WANTED else Verdict.CAUTION if unsure else Verdict.NO
    change = f"Raise the map's scale at least {_WANTED / ratio:.2g} times."
    return Answer(BASIN, verdict, text, change, numbers)


def _largest_error(case: Case) -> float | None:
    """Largest |f - d| with and without adaptation, and the largest jump of a disturbance; None where nothing predicts it."""
    nominal = case.nominal
    if isinstance(nominal, str):
        return None
    both = [response_errors(nominal).error, errors_without_adaptation(nominal).error]
    with np.errstate(over="ignore", invalid="ignore"):  # the errors of a diverging loop
        sizes = np.linalg.norm(np.vstack(both), axis=1)
    jump = max((d.jump * effect(case.grid, name) for name, d in case.problem.disturbances.items()), default=0.0)
    return max(float(sizes.max()), jump) if np.isfinite(sizes).all() else None


def _smallest_eigenvalue(case: Case) -> float | None:
    """Smallest real part along the reference; None where it is not positive."""
    try:
        smallest = float(case.spectrum(case.grid.draws[:1]).eigenvalues.real.min())
    except InvalidValue:
        return None
    return smallest if smallest > 0 else None


def _slew(case: Case) -> Answer:
    ideal = case.loops.ideal if is_planned(case.controller) else None
    return slew_enough(case.grid, case.controller.deformation, case.believed, ideal)


QUESTIONS = (
    ControllerQuestion(_slew, SLEW, order=5, doubts=True),
    ControllerQuestion(
        lambda case: range_enough(case.grid, case.controller.deformation, case.believed), RANGE, order=6, doubts=True
    ),
    ControllerQuestion(comes_back, BASIN, order=8, doubts=True),
)
