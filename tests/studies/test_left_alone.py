"""The error of a plant that is left alone, against the integral of its motion by hand."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.studies.comparison.causes import error_left_alone, yardstick_of
from fpirhc.studies.comparison.changes import ranges
from fpirhc.studies.scenarios.bench import held


def tank(**changes: Any) -> fp.Problem:
    """Y' = -2 y + u with u = 3 held: y = 1.5 - 0.5 exp(-2 t) from y = 1, while the reference is 1.5 + 0.1 sin t."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "m/s"},
        order=1,
        response=lambda q, u, p: {"y": -p.rate * q.y + u.u},
        parameters={"rate": fp.Parameter(5.0, 2.0, "1/s")},
    )
    usual: dict[str, Any] = {"plant": plant, "reference": fp.Trajectory(lambda t: {"y": 1.5 + 0.1 * ca.sin(t)})}
    usual |= {"start": {"y": 1.0}, "period": 1e-2, "duration": 2.0, "input_before": {"u": 3.0}}
    return fp.Problem(**(usual | changes))


def test_the_exact_plant_moves_under_the_input_before():
    """It is the exact plant, from the start of the problem, measured from `measure_from` on."""
    t = np.arange(200) * 1e-2
    error = 0.1 * np.sin(t) + 0.5 * np.exp(-2 * t)
    assert error_left_alone(tank(), seed=0)["y"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6)
    late = error_left_alone(tank(measure_from=1.0), seed=0)["y"]
    assert late == pytest.approx(np.sqrt(np.mean(error[100:] ** 2)), rel=1e-6)


def test_a_run_that_ends_early_is_no_yardstick():
    """A plant that blows up when it is left alone gives no number."""
    runaway = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "m/s"},
        order=1,
        response=lambda q, u, p: {"y": p.rate * q.y**3 + u.u},
        parameters={"rate": fp.Parameter(400.0, 400.0, "1/(m2 s)")},
    )
    assert error_left_alone(tank(plant=runaway), seed=0) == {}


def test_ranges_are_those_of_references_that_move():
    """The start counts, and any size; a set-point that is held where it starts, or nearly at 0, has none."""
    assert ranges(tank(duration=10.0))["y"] == pytest.approx(0.6, rel=1e-3)
    assert ranges(tank(reference=fp.Trajectory(lambda t: {"y": 1.0 + 0 * t}))) == {}
    small = fp.Trajectory(lambda t: {"y": 1e-10 * ca.sin(t)})
    assert ranges(tank(reference=small, start={"y": 0.0}, duration=10.0))["y"] == pytest.approx(2e-10, rel=1e-3)
    assert ranges(tank(reference=fp.Trajectory(lambda t: {"y": 1.0 + 0 * t}), start={"y": 1 + 1e-13})) == {}


def held_tank(size: float) -> fp.Problem:
    """The set-point 1 from 0.99, and a disturbance that leaves the tank alone with an error of about its size."""
    disturbed = {"y": fp.Sine(amplitude=size, frequency=0.5)}
    return tank(
        reference=fp.Trajectory(lambda t: {"y": 1.0 + 0 * t}),
        start={"y": 0.99},
        input_before={"u": 2.0},
        duration=10.0,
        disturbances=disturbed,
    )


def test_a_reference_that_moves_from_the_start_alone_is_measured_against_the_plant_left_alone():
    """A disturbance of 8 makes errors of 1 there, beside which 0.01 from the start says nothing; without one the start counts."""
    calm, rough = (yardstick_of(held_tank(size), seed=0) for size in (0.0, 8.0))
    assert calm.ranges["y"] == pytest.approx(0.01)
    assert rough.ranges["y"] == rough.alone["y"] > 1.0
    alone = yardstick_of(tank(duration=10.0), seed=0)
    assert alone.ranges["y"] == pytest.approx(0.6, rel=1e-3)


def test_a_case_with_a_held_reference_diverges_where_the_plant_left_alone_does_better(tmp_path):
    """More than what is off at the start is no divergence beside a disturbance that moves the plant by more."""
    path = tmp_path / "tank.py"
    path.write_text(TANK)
    task = fp.load_problem(str(path))
    study = fp.compare_scenarios(task, cases=["all"], seed=0, folder=tmp_path / "out", compiled=False)
    outcomes = {name: [record["outcome"] for record in some] for name, some in study.records.items()}
    assert outcomes == {"good": ["finished"], "bad": ["diverged"]}
    [good] = study.records["good"]
    assert good["error"] > 1
    assert held(held_tank(8.0)) == {"y"}
    assert held(tank(duration=10.0)) == frozenset()


TANK = '''"""A tank."""
import fpirhc as fp
from test_left_alone import held_tank
problem = held_tank(8.0)
controllers = {
    "good": fp.ComputedTorque(fp.Exponential(rate=20.0)),
    "bad": fp.ComputedTorque(fp.Exponential(rate=2.9)),  # the model's decay is 3 1/s too fast
}
cases = fp.Cases({"usual": {}})
'''
