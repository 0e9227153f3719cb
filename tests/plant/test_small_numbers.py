"""The same physics in another unit has the same answer."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc import Projection
from fpirhc.learning.rules.base import Evidence

LAW = fp.ComputedTorque(fp.Exponential(rate=1.0, integral=False))


@pytest.mark.parametrize("unit", [1.0, 1e-15, 1e9])
@pytest.mark.parametrize("size", [1.0, 1e-12, 1e9])
def test_an_input_found_by_newtons_method_is_that_of_the_response_in_another_unit(size, unit):
    plant = fp.Plant(
        coordinates={"V": "m^3"},
        inputs={"u": "1"},
        order=1,
        response=lambda q, u, p: {"V": p.k * (u.u / unit + (u.u / unit) ** 3)},
        parameters={"k": fp.Parameter(size, size, "m^3/s")},
    )
    assert float(plant.equations.inverse(0.0, 2 * size, size)) == pytest.approx(unit, rel=1e-9, abs=0)


@pytest.mark.parametrize("k", [1.0, 1e-12])
def test_an_input_that_nothing_gives_is_not_a_number_in_any_unit(k):
    plant = fp.Plant(
        coordinates={"V": "m^3"},
        inputs={"u": "1"},
        order=1,
        response=lambda q, u, p: {"V": p.k * (1 + u.u**2)},
        parameters={"k": fp.Parameter(k, k, "m^3/s")},
    )
    assert np.isnan(float(plant.equations.inverse(0.0, 0.5 * k, k)))
    assert abs(float(plant.equations.inverse(0.0, k, k))) < 1e-6


def test_what_a_kalman_filter_can_determine_does_not_depend_on_a_unit():
    size = 1e-9
    plant = fp.Plant.of_states(
        states={"x": "1", "y": "mol"},
        inputs={"u": "1"},
        rates=lambda x, u, p: {"x": -x.x + u.u, "y": p.s * x.x - x.y},
        outputs={"z": fp.Output("mol", lambda x, p: x.y)},
        parameters={"s": fp.Parameter(size, size, "mol/s")},
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"z": 0.5 * size + 0 * t}),
        start={"x": 0.0, "y": 0.0},
        period=0.05,
        duration=20.0,
        disturbances={"x": fp.Step(at=0.0, size=0.3)},
    )
    learner = fp.DisturbanceKalman({"x": 1.0}, {"y": 0.01 * size}, noise={"x": 0.1, "y": 0.1 * size})
    run = fp.simulate(problem, fp.Estimating(LAW, learner), seed=0, compiled=False)
    assert run["state.y"][-1] == pytest.approx(0.5 * size, rel=1e-3)


@pytest.mark.parametrize(("unit", "seconds"), [("ms", 1e-3), ("min", 60.0), ("week", 1.0)])
def test_a_saturated_input_is_told_after_the_same_time_in_any_unit_of_time(unit, seconds):
    plant = fp.Plant(
        coordinates={"x": "m"},
        inputs={"f": "N"},
        order=1,
        response=lambda q, u, p: {"x": u.f * p.a},
        parameters={"a": fp.Parameter(1.0, 1.0, "1")},
        time_unit=unit,
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"x": 1e9 + 0 * t}),
        start={"x": 0.0},
        period=0.1 / seconds,
        duration=10.0 / seconds,
        limits=fp.Limits(inputs={"f": (-1.0, 1.0)}),
    )
    law = fp.ComputedTorque(fp.Exponential(rate=seconds, integral=False))
    stepper = fp.Stepper(problem, law, compiled=False)
    memory, cycle = stepper.start(), 0
    while stepper.trace()["status"].item() != fp.Status.SATURATED if cycle else True:
        _, memory = stepper.step(cycle * problem.period, np.zeros(1), np.zeros(1), memory)
        cycle += 1
    assert cycle == 11


@pytest.mark.parametrize("size", [1.0, 1e-9, 0.0])
def test_a_projection_learns_as_much_from_a_response_in_another_unit(size):
    evidence = Evidence(lambda: (ca.SX(0), ca.SX(0)), lambda: (ca.SX(size), ca.SX(size * 0.5)), ca.SX(0))
    learned = float(ca.evalf(Projection(gain=1.0).change(evidence, {"p": (0.0, 1.0)}, 1e-3)))
    assert learned == pytest.approx(0.5 if size else 0.0)
