"""The yardstick of errors: ranges of references, and the plant left alone against the integral of its motion by hand."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc import study
from fpirhc.studies.comparison.verdict import Yardstick, left_alone
from fpirhc.studies.runs import ranges
from fpirhc.studies.variants import CasesOf

REST = fp.Trajectory(lambda t: {"y": 1.0 + 0 * t})


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
    assert left_alone(tank(), 0)["y"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6)
    late = left_alone(tank(measure_from=1.0), 0)["y"]
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
    assert left_alone(tank(plant=runaway), 0) == {}


@pytest.mark.parametrize(
    ("changes", "scale", "moves"),
    [
        ({"duration": 10.0}, 0.6, True),  # from the start, 1 m, to the top of the sine, 1.6 m
        ({"reference": REST}, 1.0, False),  # nothing moves and nothing is weighed
        ({"reference": REST, "start": {"y": 0.5}}, 0.5, False),
        (
            {"reference": fp.Trajectory(lambda t: {"y": 1e-10 * ca.sin(t)}), "start": {"y": 0.0}, "duration": 10.0},
            2e-10,
            True,
        ),
        ({"reference": REST, "limits": fp.Limits(states={"y": (0.0, 4.0)})}, 4.0, False),
        (
            {
                "reference": REST,
                "cost": fp.Quadratic(states={"y": 4.0}, effort={"u": 1.0}),
                "horizon": fp.Horizon(stages=5, step=1e-2),
            },
            0.5,
            False,
        ),
    ],
)
def test_errors_are_measured_against_the_motion_that_is_wanted(changes, scale, moves):
    """Else by the cost's weight, the limits, or 1; a start that differs by rounding is no motion."""
    yard = Yardstick.of(tank(**changes), 0)
    assert yard.scales["y"] == pytest.approx(scale, rel=1e-3)
    assert ("y" in yard.moving) == moves
    assert Yardstick.of(tank(reference=REST, start={"y": 1 + 1e-13}), 0).scales["y"] == 1.0


def held_tank(size: float) -> fp.Problem:
    """The set-point 1 from 0.99, and a disturbance that leaves the tank alone with an error of about its size."""
    disturbed = {"y": fp.Sine(amplitude=size, frequency=0.5)}
    start = {"start": {"y": 0.99}, "input_before": {"u": 2.0}}
    return tank(reference=REST, duration=10.0, disturbances=disturbed, **start)


def test_a_case_with_a_held_reference_diverges_where_the_plant_left_alone_does_better(tmp_path):
    """More than what is off at the start is no divergence beside a disturbance that moves the plant by more."""
    path = tmp_path / "tank.py"
    path.write_text(TANK)
    table = study(fp.load_problem(str(path)), CasesOf(), compiled=False).table.set_index("controller")
    assert table.outcome.to_dict() == {"good": "finished", "bad": "diverged"}
    assert table.error["good"] > 1
    assert ranges(held_tank(8.0))[1] == {"y"}
    assert ranges(tank(duration=10.0))[1] == frozenset()


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
