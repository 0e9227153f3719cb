"""Reviews of maps: what is left of a push is the decay of the run."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.reviewed import answers

import fpirhc as fp

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
    "CTC+FPI": (task, fp.ComputedTorque(LAW, ITERATION)),
    "RHC+FPI": (task, fp.RecedingHorizon(OPTIMISER, ITERATION)),
    "output": (lambda: on_output(task()), fp.ComputedTorque(LAW, ITERATION)),
}


@pytest.mark.parametrize("name", CASES)
def test_the_factor_is_the_decay_of_the_run(name: str) -> None:
    """Two runs from nearby starts; a map has no integrator, and a right model nothing to adapt."""
    make, controller = CASES[name]
    problem = make()
    told = answers(problem, controller)
    runs = [
        fp.simulate(replace(problem, start={**problem.start, "a": 0.5 + d}), controller, seed=0, compiled=False)
        for d in (1e-5, -1e-5)
    ]
    apart = np.abs(runs[0]["plant_state.a"] - runs[1]["plant_state.a"])
    decay = (apart[20:26].max() / apart[2:8].max()) ** (1 / 18)
    assert told["returns"].verdict == "yes"
    assert told["returns"].numbers["factor"] == pytest.approx(decay, abs=0.15)
    assert "no" not in {one.verdict for key, one in told.items() if key != "pays"}
