"""What a step takes as raw measurements, and where its estimates begin; that it gives the commands of a run: test_one_step.py."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc import simulator
from fpirhc.conformance.loops import two_masses
from fpirhc.contracts import Controller
from fpirhc.errors import InvalidShape

TRACK = fp.Exponential(rate=6.0)
GENTLE = fp.Affine(gain=-0.05)
PLAN = fp.FixedPoint(iterations=1, tolerance=1e-3)
CONTROLLERS: dict[str, Controller] = {
    "computed torque": fp.ComputedTorque(TRACK, GENTLE),
    "referenced": fp.ComputedTorque(TRACK, fp.ModelReferenced(GENTLE)),
    "plan": fp.RecedingHorizon(PLAN, GENTLE),
    "predicted plan": fp.Predicted(fp.RecedingHorizon(PLAN, GENTLE), inputs=0.0, measurement=0.0125),
}
PROBLEM = replace(two_masses(), duration=0.2, sensing=fp.Sensing(estimator=fp.PositionDifference()))
by_name = pytest.mark.parametrize("name", CONTROLLERS)


def test_estimates_are_refused_where_raw_measurements_are_expected():
    stepper = fp.Stepper(PROBLEM, CONTROLLERS["computed torque"], compiled=False)
    assert stepper.measures == ("a", "b")
    with pytest.raises(InvalidShape, match=r"from a, b: use step_measured\(time, measured, memory\)"):
        stepper.step(0.0, np.zeros(4), np.zeros(2), stepper.start())
    with pytest.raises(InvalidShape, match="'measured' has 2 entries"):
        stepper.step_measured(0.0, np.zeros(3), stepper.start())


@by_name
def test_another_reality_begins_with_its_own_estimates(name):
    """A simulator that is given other exact parameters starts its estimator where a simulator built for them does.

    The position is measured through a slow sensor, which at the start rests at gain times position; the gain is varied.
    """
    task, controller = sensed_slowly(gain=1.0), CONTROLLERS[name]
    other = sensed_slowly(gain=1.3)
    shared = simulator(task, controller, compiled=False).run(seed=0, variant=other)
    own = fp.simulate(other, controller, seed=0, compiled=False)
    assert np.array_equal(shared["state"], own["state"])
    assert np.array_equal(shared["command"], own["command"])
    assert abs(shared["state.y"][0] - 1.3 * 0.1) < 1e-12


def sensed_slowly(gain: float) -> fp.Problem:
    """Y'' = u / m, whose position is seen through s' = (g y - s) / 20 ms; the sensor rests at the start."""
    mass = {"m": fp.Parameter(1.0, 1.0, "kg")}
    plant = fp.Plant({"y": "m"}, {"u": "N"}, mass, lambda q, v, u, p: {"y": u.u / p.m})
    real = fp.Plant(
        coordinates={"y": "m", "s": "m"},
        inputs={"u": "N"},
        order={"y": 2, "s": 1},
        parameters={**mass, "g": fp.Parameter(1.0, gain, "1")},
        response=lambda q, v, u, p: {"y": u.u / p.m, "s": (p.g * q.y - q.s) / 0.02},
        controlled=("y",),
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"y": 0.1 + 0.05 * ca.sin(t)}),
        start={"y": 0.1},
        period=5e-3,
        duration=0.1,
        limits=fp.Limits(inputs={"u": (-50.0, 50.0)}),
        horizon=fp.Horizon(stages=5, step=0.01),
        cost=fp.Quadratic(states={"y": 1e2}, deviation={"u": 0.1}),
        sensing=fp.Sensing(estimator=fp.PositionDifference()),
        reality=fp.Reality(real, start={"s": 0.1 * gain}, seen={"y": "s"}),
    )
