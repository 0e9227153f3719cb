"""Is the map fast enough? Its largest step per cycle against how fast the request must change."""

from __future__ import annotations

import math

import numpy as np

from fpirhc.deformation.base import Deformation
from fpirhc.disturbance import Disturbance, Noise, Pulse, Sine, Step
from fpirhc.problem import Problem
from fpirhc.studies.review.along import Along
from fpirhc.studies.review.answer import Answer, Verdict

QUESTION = "Is the map fast enough for reference and disturbances?"
_SPARE = 2.0  # how many times faster than the reference it should be
_POINTS = 2001


def slew_enough(al: Along, deformation: Deformation, believed: np.ndarray) -> Answer:
    """Return the slew limit of the map beside max |d r*/dt| along the reference and what disturbances add to it."""
    problem = al.problem
    speed = _speed(al, believed)
    sudden = max((abs(_jump(d)) * _effect(al, name) for name, d in problem.disturbances.items()), default=0.0)
    steady = sum(_swing(d) * _effect(al, name) for name, d in problem.disturbances.items())
    needed, step = speed + steady, deformation.largest_step()
    numbers = {"needed": needed, "limit": step / problem.period, "jump": sudden}
    text = f"the request changes by up to {needed:.3g} per second"
    if not math.isfinite(step):
        return Answer(QUESTION, Verdict.YES, f"{text}; the map's step has no bound", "", numbers)
    text += f", the map by {step / problem.period:.3g}"
    if sudden:
        text += f"; a jump of a disturbance takes it {math.ceil(sudden / step)} cycles"
    ratio = step / problem.period / max(needed, 1e-300)
    change = f"Raise the map's scale at least {_SPARE / ratio:.2g} times, or leave it out to have it chosen."
    if ratio < 1:
        return Answer(QUESTION, Verdict.NO, text, change, numbers)
    return Answer(QUESTION, Verdict.YES if ratio >= _SPARE else Verdict.UNKNOWN, text, "" if ratio >= _SPARE else change, numbers)


def _speed(al: Along, believed: np.ndarray) -> float:
    """Largest |d r*/dt|, by differences between points much closer than those of the review."""
    problem, plant = al.problem, al.problem.plant
    times = np.linspace(0.0, problem.duration, _POINTS)
    states, responses = (np.asarray(v.full()) for v in problem.reference.function(plant).map(_POINTS)(times[None, :]))
    exact, model = (np.repeat(p[:, None], _POINTS, axis=1) for p in (plant.exact, believed))
    commands = plant.inverse_function.map(_POINTS)(states, responses[list(plant.controlled_indices)], exact)
    requests = np.asarray(plant.controlled_response_function.map(_POINTS)(states, commands, model).full())
    speeds = np.linalg.norm(np.diff(requests, axis=1), axis=0) / (times[1] - times[0])
    return float(speeds[np.isfinite(speeds)].max(initial=0.0))


def _jump(disturbance: Disturbance) -> float:
    return disturbance.size if isinstance(disturbance, Step | Pulse) else 0.0


def _swing(disturbance: Disturbance) -> float:
    """How fast it changes, per second; noise is no motion that a map should follow."""
    if isinstance(disturbance, Noise) or not isinstance(disturbance, Sine):
        return 0.0
    return abs(2 * math.pi * disturbance.frequency * disturbance.amplitude)


def _effect(al: Along, name: str) -> float:
    """What one unit of a disturbance changes in the responses: 1 on a coordinate, the exact gain on an input."""
    problem: Problem = al.problem
    plant = problem.plant
    if name not in plant.inputs:
        return 1.0
    unit = np.array([1.0 if i == name else 0.0 for i in plant.inputs])
    command = np.nan_to_num(al.commands[0, 0])
    respond = plant.controlled_response_function
    moved = respond(al.states[0], command + unit, plant.exact) - respond(al.states[0], command, plant.exact)
    return float(np.linalg.norm(moved.full()))
