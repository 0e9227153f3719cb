"""Does the deformation reach the wrong parameters? It corrects the response of the controlled coordinates and nothing else.

    |response(x^N, u*; exact, but this parameter believed) - response(x^N, u*; exact)|

A parameter that is not in this response, such as the load behind a flexible shaft whose motor is controlled, is not adapted to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.plant.chain import controlled_unit
from fpirhc.plant.motion import with_space
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import ReviewGrid, each, inner_places
from fpirhc.review.question import Answer, Case, ControllerQuestion, Verdict, by_run
from fpirhc.task.problem import Problem

REACHED = "Does the deformation reach the wrong parameters?"


def reaches_parameters(case: Case) -> Answer:
    """Return which wrong parameters are in the controlled response, and which are not; beside a reality two runs answer."""
    plant = case.problem.plant
    names = plant.parameter.elements
    wrong = _wrong(plant, case.believed)
    if not wrong and case.grid.elsewhere:
        runs = by_run(case, REACHED, "what differs is the reality, and no parameter of the model's own plant")
        return runs if runs.verdict == Verdict.YES else replace(runs, verdict=Verdict.UNKNOWN)
    if not wrong:
        return Answer(REACHED, Verdict.YES, "every parameter of the model is right", "", {"wrong": 0.0, "reached": 0.0})
    present = _present(plant)
    reached, missed = ([names[k] for k in wrong if present[k] is there] for there in (True, False))
    sizes = {names[k]: _effect(case.grid, case.believed, k) for k in wrong if present[k]}
    numbers = {"wrong": float(len(wrong)), "reached": float(len(reached))}
    numbers |= {f"effect_{name}": size for name, size in sizes.items()}
    idle = _without_task(plant, case.grid.inner, missed)
    text = "; ".join([*_reached(plant, sizes), *_missed(missed, idle)])
    if reached and not max(sizes.values()):
        change = "It corrects them off the reference: after a start or a disturbance."
        return Answer(REACHED, Verdict.CAUTION, text, change, numbers)
    if reached and not set(missed) - set(idle):
        return Answer(REACHED, Verdict.YES, text, "", numbers)
    change = f"Control a coordinate in whose response {missed[0]} is, or correct {', '.join(missed)} in the model."
    if reached:
        return Answer(REACHED, Verdict.CAUTION, text, change, numbers)
    return Answer(REACHED, Verdict.NO, text, f"{change} A deformation has nothing to correct.", numbers)


def not_reached(problem: Problem, believed: np.ndarray) -> str:
    """Return a sentence on the wrong parameters that no adaptation corrects; empty where it reaches all, or beside a reality."""
    if problem.reality is not None:
        return ""
    plant = problem.plant
    present = _present(plant)
    missed = [plant.parameter.elements[k] for k in _wrong(plant, believed) if not present[k]]
    idle = _without_task(plant, inner_places(problem), missed)
    names = [name for name in missed if name not in idle]
    if not names:
        return ""
    words = ", ".join(names)
    return (
        f"The controlled response does not depend on {words}, which the model has wrong and adaptation cannot correct."
    )


def _wrong(plant: Plant, believed: np.ndarray) -> list[int]:
    return [k for k, (value, exact) in enumerate(zip(believed, plant.exact, strict=True)) if value != exact]


_NOTHING = 1e-9  # of the largest effect, below which an effect is rounding


def _reached(plant: Plant, sizes: dict[str, float]) -> list[str]:
    unit = with_space(controlled_unit(plant))
    ordered = sorted(sizes.items(), key=lambda pair: -pair[1])
    least = _NOTHING * max(sizes.values(), default=0.0)
    shown, idle = [f"{v:.3g}{unit} ({n})" for n, v in ordered if v > least], [n for n, v in ordered if v <= least]
    said = ["the response changes by up to " + ", ".join(shown)] if shown else []
    return (
        [*said, f"along the reference the response is the same for all values of {', '.join(idle)}"] if idle else said
    )


def _missed(names: list[str], idle: list[str]) -> list[str]:
    if not names:
        return []
    note = f" ({', '.join(idle)}: only in states without a task)" if idle else ""
    return [f"the response does not depend on {', '.join(names)}{note}"]


def _without_task(plant: Plant, inner: Sequence[int], names: list[str]) -> list[str]:
    """Those of the parameters that are in the responses of simulated states alone, see `fpirhc.review.grid`."""
    pattern = np.asarray(ca.DM(plant.equations.response.jac_sparsity(0, 2), 1).full()) != 0
    simulated = {plant.state.elements[k].rstrip("'") for k in inner}
    of = {
        name: {c for c, row in zip(plant.names, pattern, strict=True) if row[k]}
        for k, name in enumerate(plant.parameter.elements)
    }
    return [name for name in names if of[name] and of[name] <= simulated]


def _present(plant: Plant) -> list[bool]:
    """Whether each parameter is in the controlled response, from the pattern of the symbols."""
    pattern = np.asarray(ca.DM(plant.equations.controlled_response.jac_sparsity(0, 2), 1).full())
    return [bool(column.any()) for column in pattern.T]


def _effect(grid: ReviewGrid, believed: np.ndarray, place: int) -> float:
    """Largest change of the response along the reference where this parameter alone is the believed one."""
    plant = grid.problem.plant
    changed = plant.exact.copy()
    changed[place] = believed[place]
    rows = [np.tile(p, (len(grid.times), 1)) for p in (changed, plant.exact)]
    with_it, without = (each(plant.equations.controlled_response, grid.states, grid.commands[0], p) for p in rows)
    change = np.linalg.norm(with_it - without, axis=1)
    return float(change[np.isfinite(change)].max(initial=0.0))


QUESTIONS = (ControllerQuestion(reaches_parameters, REACHED, order=65),)
