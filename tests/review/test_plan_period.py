"""Margins of plans that are made every n cycles: a run with the command multiplied by more, or by less, decides who is right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import abroad
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.controllers.contract import resolved
from fpirhc.problem_files.problem_file import Task
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along
from fpirhc.review.margins import margins


class Multiplied:
    """Inputs by name, all of them multiplied."""

    def __init__(self, inputs: Any, factor: float) -> None:
        self._inputs, self._factor = inputs, factor

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inputs, name) * self._factor


def multiplied(problem: fp.Problem, factor: float) -> fp.Problem:
    """The problem whose plant is given its inputs multiplied, which the controllers do not know."""
    plant: fp.Plant = problem.plant
    response: Callable[..., Any] = plant.response
    if max(plant.orders) == 1:
        other = replace(plant, response=lambda x, u, p: response(x, Multiplied(u, factor), p), inverse=None)
    else:
        other = replace(plant, response=lambda q, v, u, p: response(q, v, Multiplied(u, factor), p), inverse=None)
    return replace(problem, reality=fp.Reality(other))


def movement(problem: fp.Problem, controller: Any) -> float:
    """Median change of the command from cycle to cycle in the last third of a run."""
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    assert run.stop is None
    changes = np.abs(np.diff(run["command"], axis=0)).max(axis=1)
    return float(changes[-run.cycles // 3 :].mean())


@pytest.mark.parametrize(
    ("task", "controller", "duration", "up"),
    [
        (fp.load_problem("two_mass"), "RHC", 3.0, True),
        (fp.load_problem("leaking_tanks"), "RHC", None, True),
        (abroad.load("flexible_servo"), "RHC", None, True),
        (abroad.load("flexible_servo"), "RHC+FPI", None, False),
    ],
    ids=["two_mass", "leaking_tanks", "servo", "servo with adaptation"],
)
def test_a_command_multiplied_by_less_than_the_gain_margin_is_calm_and_by_more_is_not(
    task: Task, controller: str, duration: float | None, up: bool
) -> None:
    """The margin is 3.96 on the two masses, where a plan in every cycle would have 39.5; that of the last one is downwards."""
    problem = task.problem if duration is None else replace(task.problem, duration=duration, measure_from=0.0)
    one, grid = task.controllers[controller], review_grid(task.problem, 0.0, 0)
    loops = loops_along(grid, resolved(grid.problem, one)).loops
    margin = min(margins(loop, i)[0] for loop in loops for i in range(len(problem.plant.inputs)))
    factors = (0.85 * margin, 1.3 * margin) if up else (1 / (0.85 * margin), 1 / (1.3 * margin))
    calm, wild = (movement(multiplied(problem, factor), one) for factor in factors)
    assert wild > 5 * calm


def test_the_answer_is_that_of_the_whole_period() -> None:
    task = fp.load_problem("two_mass")
    answers = fp.review(task.problem, {"RHC": task.controllers["RHC"]}, mismatch=0.0, seed=0).controllers["RHC"]
    answer = next(a for a in answers if a.question == "Has the linear loop enough margin?")
    assert "per cycle, over the 10 cycles from plan to plan" in answer.evidence
    assert answer.numbers["gain_margin"] == pytest.approx(3.96, rel=0.02)
