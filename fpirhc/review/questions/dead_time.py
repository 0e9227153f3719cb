"""Does the loop bear a wrong dead time? By a cycle, as its poles say, by a tenth, as runs say, and one that nobody stated.

A pairing without a leak couples its interleaved iterations as soon as the dead time is wrong: high modes grow at any gain. The true
dead time is made longer and shorter by 1, 2, 5, ... cycles, for all inputs together and, where they differ, for each alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.controllers.wrappers.predicted import other_predictions
from fpirhc.errors import FpirhcError
from fpirhc.review.grid import is_late, scaled
from fpirhc.review.prediction import CYCLES
from fpirhc.review.question import SEE_CONVERGENCE, Answer, Case, ControllerQuestion, Verdict, judged
from fpirhc.review.questions.margins import margins
from fpirhc.review.questions.reality import real_loops
from fpirhc.review.questions.speed import gain_times
from fpirhc.simulation.linearise.linear_loop import LinearLoop
from fpirhc.simulation.model_as_plant import shortened
from fpirhc.simulation.simulate import simulate
from fpirhc.simulation.trials import ErrorPair, errors_of
from fpirhc.task.problem import Problem

WRONG_DEAD_TIME = "Does it bear a dead time that is wrong by a cycle?"
_STEPS = (1, 2, 5, 10, 20, 50)  # cycles
_CHANGE = (
    "Give the pairing an uncertainty of some cycles (Increment or ModelReferenced, which leak), or lower the gain."
)


def bears_wrong_dead_time(case: Case) -> Answer | None:
    """Return by how many cycles the dead time may be wrong; None where there is none and none is believed."""
    pairing = case.controller.deformation.iteration.pairing
    if not is_late(case.problem) and (pairing is None or pairing.cycles == 0):
        return None
    if not case.loops.loops:
        return Answer(WRONG_DEAD_TIME, Verdict.UNKNOWN, f"no linear loop: {case.loops.reason}")
    radius = float(case.loops.radii.max())
    if radius >= 1:
        text = f"with the dead time as it is the slowest mode is multiplied by {radius:.6g} per cycle"
        return Answer(WRONG_DEAD_TIME, Verdict.CAUTION, text, "See the convergence.", {"radius": radius})
    borne, beyond = _borne(case)
    if borne:
        more = (
            "or more"
            if beyond is None
            else f"at {beyond[0]} the slowest mode is multiplied by {beyond[1]:.6g} per cycle"
        )
        return Answer(WRONG_DEAD_TIME, Verdict.YES, f"it bears {borne} cycles, {more}", "", {"borne": float(borne)})
    assert beyond is not None
    margin = _margin_below_one(case)
    text = f"delay margin {margin:.3g} cycles; wrong by one cycle, the slowest mode is multiplied by {beyond[1]:.6g} per cycle"
    verdict = Verdict.UNKNOWN if case.loops.learns or not case.controller.deformation.iteration.constant else Verdict.NO
    numbers = {"borne": 0.0, "radius_one_cycle": beyond[1]} | ({"delay_margin": margin} if margin < 1 else {})
    return Answer(WRONG_DEAD_TIME, verdict, text, _CHANGE, numbers)


def _borne(case: Case) -> tuple[int, tuple[int, float] | None]:
    """The largest tried error that is borne, and the smallest that is not with its factor per cycle."""
    borne, longest = 0, max(case.problem.dead_time.inputs.values(), default=0.0) + case.problem.dead_time.measurement
    for step in _STEPS:
        if step > max(1.0, longest / case.problem.period):
            break
        radius = max(_radius(case, *change) for change in _wrong(case.problem, step))
        if radius >= 1:
            return borne, (step, radius)
        borne = step
    return borne, None


def _wrong(problem: Problem, step: int) -> list[tuple[list[int], int]]:
    """Numbers of inputs, all together and where they differ each alone, with the cycles by which they are later or earlier."""
    late = [problem.dead_time.inputs.get(name, 0.0) / problem.period for name in problem.plant.inputs]
    groups = [list(range(len(late))), *([[k] for k in range(len(late))] if len(set(late)) > 1 else [])]
    earlier = [group for group in groups if all(late[k] - step > -1e-9 for k in group)]
    return [*((group, step) for group in groups), *((group, -step) for group in earlier)]


def _radius(case: Case, inputs: list[int], cycles: int) -> float:
    """Largest |pole| where the loop is slowest with the true dead time, and at the first point."""
    places = {0, int(np.argmax(case.loops.radii))}
    return max(case.loops.loops[k].delayed(inputs, cycles).radius for k in places)


def _margin_below_one(case: Case) -> float:
    """The delay margin of the loop, in cycles; it may be above one where a dead time that is too long is the harm."""
    loop = case.loops.loops[int(np.argmax(case.loops.radii))]
    delays = [margins(loop, i)[2] / case.problem.period for i in range(len(case.problem.plant.inputs))]
    return min(delays)


UNSTATED = "Does it bear a latency of three cycles that nobody stated?"
_LATENCY = 3  # cycles: a link, a driver, a filter
_SHARES = np.geomspace(0.95, 0.02, 24)  # of the gain


def bears_latency(case: Case) -> Answer | None:
    """Return up to how many cycles of latency the loop is stable, and with which gain up to three.

    None where a dead time is stated or believed, without adaptation, and where the loop is not stable without latency.
    """
    deformation, loops = case.controller.deformation, case.loops
    pairing = deformation.iteration.pairing
    late = is_late(case.problem) or (pairing is not None and pairing.cycles != 0)
    if late or not deformation.adapts or not loops.loops or loops.radii.max() >= 1:
        return None
    model = [loops.loops[k] for k in {0, int(np.argmax(loops.radii))}]
    answer = _latency_of(case, model, "")
    real = _real_pair(case, case.controller)
    beside = _latency_of(case, real, "with the reality, ") if real else answer
    return beside if beside.numbers["borne"] < answer.numbers["borne"] else answer


def _latency_of(case: Case, loops: Sequence[LinearLoop], whose: str) -> Answer:
    """The answer of some loops.

    Args:
        whose: beginning of the evidence for loops with the reality; empty for those of the model.
    """
    radii = [_later(case, loops, cycles) for cycles in range(1, _LATENCY + 1)]
    borne = next((k for k, radius in enumerate(radii) if radius >= 1), _LATENCY)
    numbers = {"borne": float(borne)}
    if borne == _LATENCY:
        text = f"{whose}{_LATENCY} cycles later, the slowest mode is multiplied by {radii[-1]:.6g} per cycle"
        return Answer(UNSTATED, Verdict.YES, text, "", numbers)
    borne_text = f"{borne} cycle{'s' * (borne > 1)} later it converges, and with one more" if borne else "1 cycle later"
    text = f"{whose}{borne_text} the slowest mode is multiplied by {radii[borne]:.6g} per cycle"
    measure = f"measure the latency and state it, {case.grid.states_dead_time}"
    share = None if whose else _share_that_bears(case)
    if share is None:
        lower = "Lower the gain" if _may_help(case, whose) else "No lower gain bears them"
        return Answer(UNSTATED, Verdict.CAUTION, text, f"{lower}; {measure}.", numbers)
    lower = f"{share:.2g} times the gain, {gain_times(case.controller.deformation, share)},"
    change = f"{lower} bears them, in this loop of the model; or {measure}."
    return Answer(UNSTATED, Verdict.CAUTION, text, change, {**numbers, "share": share})


def _may_help(case: Case, whose: str) -> bool:
    """Whether a lower gain may bear what this one does not: with the reality, where the loop without adaptation does."""
    if not whose:
        return case.by_gain is None
    bare = _real_pair(case, without_deformation(case.controller))
    return bool(bare) and max(_later(case, bare, cycles) for cycles in range(1, _LATENCY + 1)) < 1


def _real_pair(case: Case, controller: Controller) -> list[LinearLoop]:
    """The loop with the reality where it is slowest; none without a reality that has one, and where it grows by itself."""
    try:
        loops = real_loops(case.grid, controller) if case.grid.real is not None else []
    except (FpirhcError, np.linalg.LinAlgError):
        return []
    slowest = max(loops, key=lambda one: one.radius, default=None)
    return [slowest] if slowest is not None and slowest.radius < 1 else []


def _later(case: Case, loops: Sequence[LinearLoop], cycles: int) -> float:
    """Largest |pole| with all commands later by so many cycles."""
    return max(one.delayed(range(len(case.problem.plant.inputs)), cycles).radius for one in loops)


def _share_that_bears(case: Case) -> float | None:
    """The largest share of the gain with which the loop is stable up to the latency; None where none is known."""
    by_gain, inputs = case.by_gain, range(len(case.problem.plant.inputs))
    if by_gain is None:
        return None
    pairs = by_gain.along(len(case.loops.places))
    for share in map(float, _SHARES):
        loops = [by_gain.at(share * by_gain.gains[1], pair) for pair in pairs]
        later = (one.delayed([*inputs], k) for one in loops for k in range(1, _LATENCY + 1))
        if all(one.radius < 1 for one in (*loops, *later)):
            return share
    return None


PAYS_LATE = "Does adaptation pay with a dead time that is wrong by a tenth?"
_PERCENT = 10.0


def pays_when_late(case: Case) -> Answer | None:
    """Return the errors with the dead time 10 % longer and shorter, by whole cycles; None without one."""
    problem = case.grid.real or case.problem
    if not is_late(problem):
        return None
    short = shortened(problem, CYCLES)
    try:
        errors = {name: _errors(scaled(short, p), case.controller) for name, p in _CHANGES.items()}
    except FpirhcError as error:
        return Answer(PAYS_LATE, Verdict.UNKNOWN, f"no run: {error}")
    text = "; ".join(f"{name}: {one.sentence}" for name, one in errors.items())
    numbers = {f"{name}_{which}": value for name, one in errors.items() for which, value in _numbers(one).items()}
    cycles, radius = _a_tenth_later(case)
    verdict = judged(all(one.passes for one in errors.values()), errors.values(), spared=case.controller.learns)
    if verdict == Verdict.YES:
        if radius < 1:
            return Answer(PAYS_LATE, Verdict.YES, text, "", numbers)
        text += f"; but {cycles} cycles off, the slowest mode is multiplied by {radius:.6g} per cycle, which short runs hardly show"
        change = "Weigh the inputs more, lower the rate or the gain, or measure the dead time better than to a tenth."
        return Answer(PAYS_LATE, Verdict.CAUTION, text, change, {**numbers, "radius": radius})
    change = "Lower the gain or the rate of the loop, or measure the dead time better than to a tenth."
    change = SEE_CONVERGENCE if case.diverges else change
    return Answer(PAYS_LATE, verdict, text, change, numbers)


_CHANGES = {"longer": _PERCENT, "shorter": -_PERCENT}


def _a_tenth_later(case: Case) -> tuple[int, float]:
    """A tenth of the longest dead time in whole cycles, and the largest |pole| that far off; zero where it is not known."""
    longest = max(case.problem.dead_time.inputs.values(), default=0.0) + case.problem.dead_time.measurement
    cycles = math.ceil(_PERCENT / 100 * longest / case.problem.period - 1e-9)
    if not case.loops.loops or case.diverges or not cycles:
        return cycles, 0.0
    return cycles, max(_radius(case, *change) for change in _wrong(case.problem, cycles))


def _errors(late: Problem, controller: Controller) -> ErrorPair:
    return errors_of(
        late, [simulate(late, one, seed=0, compiled=False) for one in (without_deformation(controller), controller)]
    )


def _numbers(one: ErrorPair) -> dict[str, float]:
    return {"without": one.without[one.worst], "with": one.adapted[one.worst]}


KNOWS = "Does the prediction know what the model lacks?"
_LESS = 0.5  # of the error, below which another prediction is named


def prediction_knows(case: Case) -> Answer | None:
    """Return the errors with the model's prediction and with others; None where another one is in use."""
    problem = case.grid.real or case.problem
    others = other_predictions(case.controller)
    if not others:
        return None
    short, names = shortened(problem, CYCLES), {}
    try:
        own = simulate(short, case.controller, seed=0, compiled=False)
    except FpirhcError as error:
        return Answer(KNOWS, Verdict.UNKNOWN, f"no run: {error}")
    for name, other in others.items():
        try:
            names[name] = errors_of(short, (own, simulate(short, other, seed=0, compiled=False)))
        except FpirhcError:  # a plant that this prediction does not serve
            continue
    if not names:
        return Answer(KNOWS, Verdict.UNKNOWN, "no other prediction serves this plant")
    sizes = {name: max(pair.adapted[n] / pair.ranges[n] for n in pair.adapted) for name, pair in names.items()}
    pair = next(iter(names.values()))
    size = max(pair.without[n] / pair.ranges[n] for n in pair.without)
    best = min(sizes, key=lambda name: sizes[name])
    text = f"rms error {size:.3g} of the range with the model's prediction, {sizes[best]:.3g} with {best}"
    numbers = {"error": size, **{f"error with {name}": value for name, value in sizes.items() if math.isfinite(value)}}
    verdict = Verdict.YES if sizes[best] > _LESS * size else Verdict.CAUTION
    return Answer(KNOWS, verdict, text, f"Predict with what acts: Predicted(..., by={best}).", numbers)


QUESTIONS = (
    ControllerQuestion(bears_wrong_dead_time, WRONG_DEAD_TIME, order=50, of_targets=True),
    ControllerQuestion(bears_latency, UNSTATED, order=52),
    ControllerQuestion(pays_when_late, PAYS_LATE, order=51, of_targets=True),
    ControllerQuestion(prediction_knows, KNOWS, order=53, adaptive=False),
)
