"""Live settings of plants whose inverse is Newton's: changed loops are rebuilt loops."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance import check_live
from fpirhc.contracts import Controller
from fpirhc.symbolic.live import nan_where

MAP = fp.Sigmoid(gain=-0.3, scale=50.0)
CONTROLLERS: dict[str, tuple[Controller, list[str]]] = {
    "computed torque": (
        fp.ComputedTorque(fp.Exponential(rate=6.0), MAP),
        ["deformation.gain", "tracking.rate", "limits.inputs.u.1"],
    ),
    "receding horizon": (
        fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3), MAP),
        ["deformation.gain", "cost.states.y"],
    ),
}


def cubic() -> fp.Plant:
    """A force that grows with the third power of the input: the inverse is Newton's."""
    return fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"b": fp.Parameter(1.0, 1.4, "1/kg")},
        response=lambda q, v, u, p: {"y": p.b * (u.u + 0.1 * u.u * u.u * u.u) - q.y},
    )


def task(plant: fp.Plant) -> fp.Problem:
    """The plant along a sine."""
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}),
        start={"y": 0.1},
        period=1e-3,
        duration=0.1,
        limits=fp.Limits(inputs={"u": (-50.0, 50.0)}),
        horizon=fp.Horizon(stages=2, step=1e-2),
        cost=fp.Quadratic(states={"y": 1e3, "y'": 1.0}, effort={"u": 1e-3}),
    )


@pytest.mark.parametrize(
    ("plant", "name"), [(cubic, "computed torque"), (cubic, "receding horizon")], ids=["newton", "plan"]
)
def test_every_setting_is_live_and_changed_equals_rebuilt(plant, name):
    """Bit by bit in the virtual machine, as for every other plant."""
    controller, paths = CONTROLLERS[name]
    tried = check_live(task(plant()), controller, paths=paths, cycles=20)
    assert [one.path for one in tried if one.refused or one.factor is None] == []


def test_an_input_that_newton_does_not_find_is_still_nan():
    """u^2 = r has no solution for r = -1, and two for r = 4 of which one is found."""
    square = replace(cubic(), response=lambda q, v, u, p: {"y": (u.u + 3) ** 2 - 9}, inverse=None)
    found, lost = (float(square.equations.inverse([0, 0], [r], [1.0])) for r in (7.0, -20.0))
    assert found == pytest.approx(1.0, abs=1e-9)
    assert np.isnan(lost)


def test_nan_is_computed_and_spoils_no_gradient():
    """Zero with a derivative of zero where the condition does not hold, NaN where it does."""
    x = ca.SX.sym("x")
    value = x * x + nan_where(x < 0)
    both = ca.Function("f", [x], [value, ca.gradient(value, x)])
    assert [float(v) for v in both(3.0)] == [9.0, 6.0]
    assert np.isnan(float(both(-1.0)[0]))
