"""Reviews of maps: the linear loop is that of the run, questions about time are not asked, and what is not covered says so."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along

T = 10.0  # s, one step
ITERATION = fp.ModelReferenced(fp.Affine(gain=-1.0))
OPTIMISER = fp.FixedPoint(iterations=2, tolerance=1e-6)
LAW = fp.Exponential(rate=0.04)


def grown(x: Any, u: Any, p: Any) -> dict[str, Any]:
    """Two stocks, the second fed by the first, which is caught."""
    return {"a": x.a + T * (p.growth * x.a * (1 - x.a) - p.caught * u.catch - 0.01 * x.b), "b": 0.7 * x.b + 0.2 * x.a}


def task(**changes: Any) -> fp.Problem:
    """The first stock rests at a half."""
    plant = fp.Plant.discrete(
        states={"a": "1", "b": "1"},
        inputs={"catch": "1/s"},
        parameters={"growth": fp.Parameter(0.02, 0.03, "1/s"), "caught": fp.Parameter(1.0, 0.7, "1")},
        next=grown,
        step=T,
        controlled=("a",),
    )
    arguments: dict[str, Any] = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {"a": 0.5 + 0 * t, "b": 1 / 3 + 0 * t}),
        "start": {"a": 0.5, "b": 1 / 3},
        "period": T,
        "duration": 800.0,
        "horizon": fp.Horizon(stages=2, step=T),
        "cost": fp.Quadratic(states={"a": 1.0}, rate={"catch": 1.0}),
    }
    return fp.Problem(**{**arguments, **changes})


def on_output(problem: fp.Problem) -> fp.Problem:
    """The same task with the first stock as an output."""
    outputs = {"a": fp.Output("1", lambda x, _: x.a)}
    plant = replace(problem.plant, outputs=outputs)
    reference = fp.Trajectory(lambda t: {"a": 0.5 + 0 * t})
    return replace(
        problem, plant=plant, reference=reference, cost=fp.Quadratic(outputs={"a": 1.0}, rate={"catch": 1.0})
    )


CASES = {
    "CTC": (task, fp.ComputedTorque(LAW)),
    "CTC+FPI": (task, fp.ComputedTorque(LAW, ITERATION)),
    "CTC+plain": (task, fp.ComputedTorque(LAW, fp.Affine(gain=-1.0))),
    "RHC+FPI": (task, fp.RecedingHorizon(OPTIMISER, ITERATION)),
    "output": (lambda: on_output(task()), fp.ComputedTorque(LAW, ITERATION)),
}


@pytest.mark.parametrize("name", CASES)
def test_the_linear_loop_is_that_of_the_run(name: str) -> None:
    """The difference of two runs from nearby starts satisfies the recursion of the loop's characteristic polynomial."""
    make, controller = CASES[name]
    problem = make()
    loops = loops_along(review_grid(problem, mismatch=0.0, seed=0), controller)
    poles = loops.loops[0].poles
    runs = [
        fp.simulate(replace(problem, start={**problem.start, "a": 0.5 + d}), controller, seed=0, compiled=False)
        for d in (1e-5, -1e-5)
    ]
    apart = (runs[0]["plant_state.a"] - runs[1]["plant_state.a"])[2:]  # the first cycles have no pair yet
    poles = poles[np.abs(poles) > 1e-6]
    polynomial = np.real(np.poly(poles))
    windows = np.lib.stride_tricks.sliding_window_view(apart[:60], len(poles) + 1)
    left = np.abs(windows @ polynomial[::-1]) / np.abs(windows).max(axis=1)
    assert np.median(left[:20]) < 5e-3
    assert loops.loops[0].radius < 1


def test_questions_about_time_are_not_asked() -> None:
    review = fp.review(task(), {"CTC+FPI": fp.ComputedTorque(LAW, ITERATION)}, mismatch=0.0, seed=0)
    answers = review.controllers["CTC+FPI"]
    asked = [answer.question for answer in (*review.problem, *answers)]
    assert not any("integrator" in q or "discretisation" in q or "small lag" in q for q in asked), asked
    assert [a.question for a in answers if a.verdict.name == "NO"] == []
    [null] = [a for a in answers if "right model alone" in a.question]
    assert null.evidence.startswith(
        ("predicted rms response error on a right model 0 ", "predicted rms response error on a right model 0,")
    )


def test_the_loop_of_a_map_of_the_second_order_has_the_poles_of_its_law() -> None:
    """(q - 1 + rate T)^2 of the error: 0.6 twice, a double pole, which rounding splits."""
    plant = fp.Plant.discrete(
        states={"y": "1", "v": "1"},
        inputs={"u": "1"},
        parameters={},
        next=lambda x, u, p: {"y": x.v, "v": 0.5 * x.y + u.u},
        step=T,
        outputs={"y": fp.Output("1", lambda x, _: x.y)},
    )
    problem = fp.Problem(plant, fp.Trajectory(lambda t: {"y": 0 * t}), {"y": 0.0, "v": 0.0}, T, 200.0)
    loops = loops_along(review_grid(problem, mismatch=0.0, seed=0), fp.ComputedTorque(LAW, ITERATION))
    assert loops.radii == pytest.approx(1 - 0.04 * T, rel=1e-3)
