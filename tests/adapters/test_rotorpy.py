"""A quadrotor of RotorPy behind a point mass: what it carries and the wind act, and wrong uses are told."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.adapters.rotorpy import rotorpy_body
from fpirhc.errors import FpirhcError

pytest.importorskip("rotorpy", reason="it needs the extra fpirhc[outside]")
AXES = ("x", "y", "z")
POINT = fp.Plant(
    dict.fromkeys(AXES, "m"),
    {f"thrust_{name}": "m/s^2" for name in AXES},
    {},
    lambda q, v, u, p: {name: getattr(u, f"thrust_{name}") - 9.81 * (name == "z") for name in AXES},
)


def body(**settings: Any) -> fp.ExternalPlant:
    return rotorpy_body(POINT, **{"period": 1e-2, **settings})


def shown(plant: fp.ExternalPlant, seconds: float = 0.1) -> dict[str, float]:
    """What it measures after it was told to hover."""
    plant.first(0)
    for k in range(round(seconds / 1e-2)):
        values = plant.read(k * 1e-2, np.array([0.0, 0.0, 9.81]))
    return dict(zip(plant.measures, values, strict=True))


def test_it_hovers_sinks_with_a_payload_and_goes_with_the_wind():
    """The thrust is that per nominal mass, so that a fifth more of it leaves the weight of the payload."""
    at = shown(body(start={"x": 1.0}))
    assert at["x"] == pytest.approx(1.0, abs=1e-6)
    assert at["z''"] == pytest.approx(0.0, abs=1e-3)
    assert shown(body(payload=0.1))["z''"] == pytest.approx(-9.81 * 0.1 / 0.6, rel=0.15)  # the Hummingbird has .5 kg
    assert shown(body(wind=(3.0, 0.0, 0.0)))["x'"] > 0.001


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"payload": -1.0}, r"rotorpy_body\.payload: expected a finite number of at least 0, got -1\.0"),
        (
            {"wind": (3.0, 0.0)},
            r"rotorpy_body\.wind: expected \(a finite number, a finite number, a finite number\), got \(3\.0, 0\.0\)",
        ),
        ({"vehicle": {"mass": 1}}, "vehicle lacks k_eta; change a set of the package"),
        ({"start": {"q": 1.0}}, "start: quantity 'q' is unknown"),
    ],
)
def test_wrong_uses(settings, words):
    with pytest.raises(FpirhcError, match=words):
        body(**settings)


def test_the_law_of_the_position_is_that_of_the_package():
    """The thrust is what SE3Control asks for in the same state, on the same circle."""
    control = pytest.importorskip("rotorpy.controllers.quadrotor_control")
    circle = pytest.importorskip("rotorpy.trajectories.circular_traj").ThreeDCircularTraj
    vehicle = pytest.importorskip("rotorpy.vehicles.hummingbird_params").quad_params
    task = fp.load_problem("quadrotor")
    run = fp.simulate(
        replace(task.problem, duration=0.5, measure_from=0.0), task.controllers["SE3 of RotorPy"], seed=0, compiled=None
    )
    x, v = np.split(run["state"][40], 2)
    state = {"x": x, "v": v, "q": np.array([0.0, 0.0, 0.0, 1.0]), "w": np.zeros(3)}
    flat = circle(radius=np.array([2, 2, 0]), freq=np.full(3, 0.2)).update(0.4)
    expected = control.SE3Control(vehicle).update(0.4, state, flat)["cmd_acc"]
    assert run["command"][40] == pytest.approx(expected, rel=1e-9)
