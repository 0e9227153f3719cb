"""Scalar code that calls a Function, such as a table, needs memory for its work: run, plan and exported C have it."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from test_c import SANITIZED, built, needs_compiler, output

import fpirhc as fp
from fpirhc.export.target import device_of, target_called, write

FRICTION = ca.interpolant("friction", "linear", [[-5.0, -1.0, 0.0, 1.0, 5.0]], [-3.0, -1.0, 0.0, 1.0, 3.0])
PLANT = fp.Plant(
    coordinates={"x": "m"},
    inputs={"F": "N"},
    order=2,
    response=lambda q, v, u, p: {"x": (u.F - p.k * FRICTION(v.x)) / p.m},
    parameters={"m": fp.Parameter(1.2, 1.0, "kg"), "k": fp.Parameter(0.2, 0.1, "N")},
)
PROBLEM = fp.Problem(
    plant=PLANT,
    reference=fp.Trajectory(lambda t: {"x": ca.sin(t)}),
    start={"x": 0.0},
    period=1e-2,
    duration=0.5,
    limits=fp.Limits(inputs={"F": (-30.0, 30.0)}),
    horizon=fp.Horizon(stages=4, step=1e-2),
    cost=fp.Quadratic(states={"x": 1e4}, effort={"F": 1e-4}),
)
CONTROLLERS = fp.ComputedTorque(fp.Exponential(5.0)), fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-6))


@needs_compiler
@pytest.mark.parametrize("controller", CONTROLLERS, ids=lambda one: type(one).__name__)
def test_a_plant_with_a_table_runs_as_in_the_virtual_machine_and_leaves_its_memory_alone(controller, tmp_path):
    runs = [fp.simulate(PROBLEM, controller, seed=0, compiled=compiled) for compiled in (False, True)]
    np.testing.assert_allclose(runs[1]["command"], runs[0]["command"], rtol=1e-9)
    device = device_of(PROBLEM, controller, "table", name="table", cycles=100)
    write(device, target_called("c"), tmp_path)
    assert "differ in a bit: command 0, memory 0, trace 0" in output(
        built(tmp_path, *SANITIZED), tmp_path / "samples.bin"
    )
