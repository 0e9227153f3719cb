"""Plants side by side in one register err as the ordinary loop says, one after the other."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
import tasks

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.errors import InvalidName, InvalidProblem, InvalidShape, InvalidValue, NotInstalled
from fpirhc.simulation.simulate import Simulator

adaptive = cache(lambda: tasks.two_mass.controllers["CTC+FPI (eq 6)"])


def odd(q, v, u, p):
    """A response with the functions that scalar code may have, small beside the force."""
    x, y = 0.2 * q.x, 0.1 * v.x
    terms = [
        ca.sin(x),
        ca.cos(y),
        ca.tan(x),
        ca.asin(x),
        ca.acos(x),
        ca.atan(y),
        ca.sinh(x),
        ca.cosh(y),
        ca.tanh(x),
        ca.exp(y),
    ]
    terms += [
        ca.log(2 + x),
        ca.sqrt(2 + y),
        ca.asinh(x),
        ca.acosh(2 + x),
        ca.atanh(y),
        ca.log1p(x),
        ca.expm1(y),
        ca.fabs(x),
    ]
    terms += [ca.sign(y), ca.floor(5 * x), ca.ceil(5 * y), ca.fmod(5 * x, 0.3), ca.atan2(x, 2 + y), ca.hypot(x, y)]
    terms += [
        ca.fmin(x, y),
        ca.fmax(x, y),
        ca.if_else(x < y, x, y),
        (2 + x) ** (1 + y),
        (2 + x) ** 0.3,
        ca.copysign(x, y),
    ]
    return {"x": (u.F + 0.02 * sum(terms)) / p.m}


ODD = fp.Problem(
    plant=fp.Plant(
        coordinates={"x": "m"}, inputs={"F": "N"}, order=2, response=odd, parameters={"m": fp.Parameter(1.4, 1.0, "kg")}
    ),
    reference=fp.Trajectory(lambda t: {"x": ca.sin(2 * t)}),
    start={"x": 0.0},
    period=2e-3,
    duration=4.0,
    measure_from=1.0,
)
noisy = cache(
    lambda: replace(
        tasks.two_mass.problem,
        duration=3.0,
        measure_from=1.0,
        disturbances={"q1": fp.Step(at=1.5, size=3.0)},
        sensing=fp.Sensing(
            {"q1": fp.Sensor(noise=fp.Noise(1e-4), dropout=0.05), "q2": fp.Sensor(quantum=1e-4)},
            fp.SavitzkyGolay(window=7, degree=4),
        ),
    )
)
LAW = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.ModelReferenced(fp.Affine(gain=-0.5)))
CASES: dict[str, Callable[[], tuple[fp.Problem, Controller]]] = {
    "published form": lambda: (tasks.two_mass.problem, adaptive()),
    "functions": lambda: (ODD, LAW),
    "lost samples": lambda: (noisy(), LAW),
    "dead time": lambda: (
        replace(tasks.two_mass.problem, dead_time=fp.DeadTime(inputs={"Q1": 5e-3, "Q2": 2.5e-3})),
        fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Increment(fp.Affine(gain=-0.5), cycles=(5.0, 2.5))),
    ),
    "plans": lambda: (tasks.two_mass.problem, tasks.two_mass.controllers["RHC+FPI"]),
    "plans at limits": lambda: (
        replace(
            tasks.two_mass.problem,
            duration=3.0,
            measure_from=1.0,
            limits=fp.Limits(inputs={"Q1": (-40.0, 40.0), "Q2": (-5.0, 5.0)}),
        ),
        tasks.two_mass.controllers["RHC+FPI"],
    ),
    "map": lambda: (
        tasks.fishery.problem,
        next(c for n, c in tasks.fishery.controllers.items() if n.startswith("CTC")),
    ),
}


def plants(ready: Simulator, count: int, share: float = 0.2) -> np.ndarray:
    exact = ready.problem.plant.exact
    return exact * (1 + share * np.random.default_rng(0).uniform(-1, 1, (count, exact.size)))


def some_device() -> str:
    """The name of an OpenCL device with double precision."""
    cl = pytest.importorskip("pyopencl", reason="pyopencl is not installed: pip install 'fpirhc[opencl]'")
    try:
        every = [one for platform in cl.get_platforms() for one in platform.get_devices()]
    except cl.LogicError:
        every = []
    able = [one.name for one in every if "cl_khr_fp64" in one.extensions]
    return able[0] if able else pytest.skip("there is no OpenCL device with double precision")


@pytest.mark.parametrize("name", [name for name in CASES if name != "plans"])
def test_a_device_has_the_errors_of_the_lanes(name):
    """Its functions round otherwise again; statuses are the same, and so is a plant that runs away."""
    ready, device = fp.simulator(*CASES[name]()), some_device()
    exact = plants(ready, 11, 0.05)
    lanes, many = ready.run_many(exact), ready.run_many(exact, device=device)
    assert many.lanes == 1, many.why
    for one, other in ((many.rms_error, lanes.rms_error), (many.max_error, lanes.max_error)):
        for coordinate, errors in one.items():
            np.testing.assert_allclose(errors, other[coordinate], rtol=1e-9 if name == "lost samples" else 1e-12)
    assert {s: list(v) for s, v in many.statuses.items()} == {s: list(v) for s, v in lanes.statuses.items()}
    assert not many.stops


def test_what_a_device_cannot_run_is_told():
    """A loop with plans under limits of states runs one after the other there; a name that no device has is wrong."""
    device = some_device()
    limited = replace(
        tasks.two_mass.problem, duration=0.5, measure_from=0.1, limits=fp.Limits(states={"q1": (-10.0, 10.0)})
    )
    ready = fp.simulator(limited, tasks.two_mass.controllers["RHC"])
    many = ready.run_many(plants(ready, 2), device=device)
    assert many.lanes == 0
    assert many.why.startswith("the loop has a part that is not written for devices: fpirhc_plan")
    with pytest.raises(InvalidName, match="no OpenCL device is called 'abacus'"):
        fp.simulator(*CASES["map"]()).run_many(plants(fp.simulator(*CASES["map"]()), 2), device="abacus")


def test_a_device_needs_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyopencl", None)
    ready = fp.simulator(tasks.two_mass.problem, adaptive(), compiled=False)
    with pytest.raises(NotInstalled, match=r"a device needs pyopencl, .*pip install 'fpirhc\[opencl\]'"):
        ready.run_many(plants(ready, 2), device="")


def test_wrong_parameters_are_named():
    ready = fp.simulator(tasks.two_mass.problem, adaptive(), compiled=False)
    with pytest.raises(InvalidShape, match=r"exact of shape \(1, 2\)\): expected one row per plant with m1, "):
        ready.run_many(np.ones((1, 2)))
    exact = plants(ready, 3)
    exact[1, 0] = np.nan
    with pytest.raises(InvalidValue, match=r"plant 1: .* is nan, which is not finite"):
        ready.run_many(exact)


def drifting() -> Simulator:
    """A reality with a parameter that the model lacks, at which a state of its own settles before the start."""
    model = fp.Plant({"y": "m"}, {"u": "m/s"}, {}, lambda q, u, p: {"y": u.u}, order=1)
    real = fp.Plant(
        {"y": "m", "z": "m/s"},
        {"u": "m/s"},
        {"b": fp.Parameter(1.0, 1.0, "1"), "c": fp.Parameter(1.0, 1.0, "m/s", bounds=(0.0, 4.0))},
        lambda q, u, p: {"y": p.b * u.u + q.z, "z": p.c - q.z},
        order=1,
        controlled=("y",),
    )
    still = fp.Trajectory(lambda t: {"y": 0 * t})
    problem = fp.Problem(model, still, {"y": 0.0}, period=0.01, duration=0.5, reality=fp.Reality(real))
    return fp.simulator(problem, fp.ComputedTorque(fp.Exponential(rate=2.0)))


def test_a_plant_outside_its_bounds_is_named_wherever_it_stands():
    with pytest.raises(InvalidValue, match="plant 1: 'c' is 5, which is outside 0 to 4 m/s"):
        drifting().run_many(np.array([[1.0, 1.0], [1.0, 5.0], [1.0, 1.0]]))


def test_no_plants_have_no_errors():
    many = drifting().run_many(np.empty((0, 2)))
    assert many.rms_error["y"].shape == many.max_error["y"].shape == (0,)
    assert not many.stops


def test_scenarios_that_disagree_are_named():
    ready = fp.simulator(tasks.two_mass.problem, adaptive(), compiled=False, live=["deformation.gain"])
    with pytest.raises(
        InvalidShape, match=r"run_many\(2 for 'deformation.gain', 3 for 'q1'\): expected a number for every"
    ):
        ready.run_many(settings={"deformation.gain": [-1.0, -2.0]}, starts={"q1": [0.0, 1.0, 2.0]})
    with pytest.raises(InvalidValue, match="scenario 1: 'q1' is nan, which is not finite"):
        ready.run_many(starts={"q1": [0.0, np.nan]})
    with pytest.raises(InvalidName, match=r"deformation\.gian"):
        ready.run_many(settings={"deformation.gian": -1.0})
    with pytest.raises(InvalidValue, match=r"run_many\(seed=\[0, -1\]\): expected a whole number"):
        ready.run_many(seed=[0, -1])
    with pytest.raises(InvalidProblem, match="q3"):
        ready.run_many(starts={"q3": 1.0})
