"""Margins of plans that are made every n cycles: a run with the command multiplied by more, or by less, decides who is right."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.controllers.contract import resolved
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along


def movement(problem: fp.Problem, controller: Any) -> float:
    """Median change of the command from cycle to cycle in the last third of a run."""
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    assert run.stop is None
    changes = np.abs(np.diff(run["command"], axis=0)).max(axis=1)
    return float(changes[-run.cycles // 3 :].mean())


def test_the_answer_is_that_of_the_whole_period() -> None:
    task = fp.load_problem("two_mass")
    answers = fp.review(task.problem, {"RHC": task.controllers["RHC"]}, mismatch=0.0, seed=0).controllers["RHC"]
    answer = next(a for a in answers if a.question == "Has the linear loop enough margin?")
    assert "per cycle, over the 10 cycles from plan to plan" in answer.evidence
    assert answer.numbers["gain_margin"] == pytest.approx(3.96, rel=0.02)


def deviation(problem: fp.Problem, controller: Any) -> np.ndarray:
    """Distance of two runs by cycle whose starts differ by little, in sizes of the states."""
    moved = [{n: v * (1 + s * 1e-4) + s * 1e-6 for n, v in problem.start.items()} for s in (1, -1)]
    one, other = (
        fp.simulate(replace(problem, start=start), controller, seed=0, compiled=False)["state"] for start in moved
    )
    return np.asarray(np.linalg.norm((one - other) / np.abs(one).max(axis=0), axis=1))


def test_a_deviation_decays_as_the_slowest_mode_of_a_whole_period():
    """The delayed tanks: .993 per cycle, where a plan in every cycle would have .9902."""
    task = fp.load_problem("delayed_tanks")
    grid = review_grid(task.problem, 0.0, 0)
    radius = loops_along(grid, resolved(grid.problem, task.controllers["RHC+FPI"])).radii.max()
    sizes = deviation(task.problem, task.controllers["RHC+FPI"])
    assert 1 - (sizes[300] / sizes[100]) ** (1 / 200) == pytest.approx(1 - radius, rel=0.15)


def test_a_gain_that_a_plan_in_every_cycle_would_bear_is_too_small_for_the_plans():
    """The leaking tanks with the gain divided by 2.2: a plan in every cycle would bear 2.36, and a run does not come to rest."""
    task = fp.load_problem("leaking_tanks")
    adaptive = task.controllers["RHC+FPI"]
    answers = fp.review(task.problem, {"it": adaptive}, mismatch=0.0, seed=0).controllers["it"]
    [ratio] = [a.numbers["ratio"] for a in answers if a.question == "Does the iteration keep up with its tracking law?"]
    assert 1 < ratio < 2.2
    smaller = adaptive.with_deformation(
        adaptive.deformation.with_effective_gain(adaptive.deformation.effective_gain() / 2.2)
    )
    rest = replace(task.problem, duration=500.0)
    assert movement(rest, smaller) > 10 * movement(rest, adaptive)
