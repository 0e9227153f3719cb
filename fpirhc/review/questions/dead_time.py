"""Does the loop bear a dead time that is wrong by one cycle? The linear loop is built with other dead times.

A pairing without a leak couples its interleaved iterations as soon as the dead time is wrong: high modes grow at any gain. The true
dead time is made longer and shorter by 1, 2, 5, ... cycles, for all inputs together and, where they differ, for each alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.late import is_late, shifted
from fpirhc.review.loops import loops_at
from fpirhc.review.margins import margins
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.task.problem import Problem

TEXT = "Does it bear a dead time that is wrong by a cycle?"
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
        return Answer(TEXT, Verdict.UNKNOWN, f"no linear loop: {case.loops.reason}")
    radius = float(case.loops.radii.max())
    if radius >= 1:
        text = f"with the dead time as it is the slowest mode is multiplied by {radius:.6g} per cycle"
        return Answer(TEXT, Verdict.UNKNOWN, text, "See the convergence.", {"radius": radius})
    try:
        borne, beyond = _borne(case)
    except FpirhcError as error:
        return Answer(TEXT, Verdict.UNKNOWN, str(error))
    if borne:
        more = (
            "or more"
            if beyond is None
            else f"at {beyond[0]} the slowest mode is multiplied by {beyond[1]:.6g} per cycle"
        )
        return Answer(TEXT, Verdict.YES, f"it bears {borne} cycles, {more}", "", {"borne": float(borne)})
    assert beyond is not None
    margin = _margin_below_one(case)
    text = f"delay margin {margin:.3g} cycles; wrong by one cycle, the slowest mode is multiplied by {beyond[1]:.6g} per cycle"
    verdict = Verdict.UNKNOWN if case.loops.learns or not case.controller.deformation.iteration.constant else Verdict.NO
    numbers = {"borne": 0.0, "radius_one_cycle": beyond[1]} | ({"delay_margin": margin} if margin < 1 else {})
    return Answer(TEXT, verdict, text, _CHANGE, numbers)


QUESTION = ControllerQuestion(bears_wrong_dead_time, order=20, of_targets=True)


def _borne(case: Case) -> tuple[int, tuple[int, float] | None]:
    """The largest tried error that is borne, and the smallest that is not with its factor per cycle."""
    borne, longest = 0, max(case.problem.dead_time.inputs.values(), default=0.0) + case.problem.dead_time.measurement
    for step in _STEPS:
        if step > max(1.0, longest / case.problem.period):
            break
        radius = max(_radius(case, problem) for problem in _wrong(case.problem, step))
        if radius >= 1:
            return borne, (step, radius)
        borne = step
    return borne, None


def _wrong(problem: Problem, step: int) -> list[Problem]:
    """Problems whose dead time is longer and shorter by a step."""
    inputs = tuple(problem.plant.inputs)
    groups = [inputs]
    if len({problem.dead_time.inputs.get(name, 0.0) for name in inputs}) > 1:
        groups += [(name,) for name in inputs]
    changes = [dict.fromkeys(group, sign * step) for group in groups for sign in (1, -1)]
    return [shifted(problem, c) for c in changes if _possible(problem, c)]


def _possible(problem: Problem, change: dict[str, int]) -> bool:
    times = problem.dead_time.inputs
    return all(times.get(name, 0.0) / problem.period + cycles > -1e-9 for name, cycles in change.items())


def _radius(case: Case, problem: Problem) -> float:
    """Largest |pole| where the loop is slowest with the true dead time, and at the first point."""
    places = {case.loops.places[0], case.loops.places[int(np.argmax(case.loops.radii))]}
    grid = replace(case.grid, problem=problem)
    return max(loop.radius for loop in loops_at(grid, case.controller, sorted(places)))


def _margin_below_one(case: Case) -> float:
    """The delay margin of the loop, in cycles; it may be above one where a dead time that is too long is the harm."""
    loop = case.loops.loops[int(np.argmax(case.loops.radii))]
    delays = [margins(loop, i)[2] / case.problem.period for i in range(len(case.problem.plant.inputs))]
    return min(delays)
