"""A car of CommonRoad behind a model of its heading: the derivative is the package's own, and wrong uses are told."""

from importlib import import_module
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fpirhc as fp
from fpirhc.adapters.commonroad import commonroad_body
from fpirhc.errors import FpirhcError

pytest.importorskip("vehiclemodels", reason="it needs the extra fpirhc[outside]")
CAR = fp.Plant(
    {"y": "m", "heading": "rad"},
    {"steer": "rad", "acceleration": "m/s^2"},
    {},
    lambda q, v, u, p: {"y": u.steer, "heading": u.acceleration},
)


def body(kind: str = "st", **settings: Any) -> fp.ExternalPlant:
    return commonroad_body(kind, CAR, **{"period": 1e-2, "speed": 20.0, **settings})


def of(name: str) -> Any:
    """What a module of the package has under its own name."""
    return getattr(import_module(f"vehiclemodels.{name}"), name)


@pytest.mark.parametrize("kind", ["st", "std"])
def test_a_cycle_is_that_of_the_packages_derivative(kind):
    """Against a solver of SciPy that does not know the body's steps; the wheels turn at a rate below the car's own."""
    car, first, steer = of("parameters_vehicle2")(), [0.0, 0.0, 0.0, 20.0, 0.0, 0.0, 0.0], 2e-3
    rate = of(f"vehicle_dynamics_{kind}")
    start = of("init_st")(first) if kind == "st" else of("init_std")(first, car)
    end = solve_ivp(lambda _, x: rate(list(x), [steer / 1e-2, 1.0], car), (0, 1e-2), start, rtol=1e-10, atol=1e-12).y[
        :, -1
    ]
    plant = body(kind)
    plant.first(0)
    shown = plant.read(0.0, np.array([steer, 1.0]))
    measured = dict(zip(plant.measures, shown, strict=True))
    np.testing.assert_allclose(
        [measured["y"], measured["heading"], measured["heading'"]], end[[1, 4, 5]], rtol=1e-5, atol=1e-9
    )
    assert measured["heading''"] == pytest.approx(end[5] / 1e-2, rel=1e-5)  # from straight on


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"kind": "sdt"}, "kind 'sdt' is unknown. Did you mean 'st'"),
        ({"vehicle": 9}, "vehicle '9' is unknown. Valid: 1, 2, 3, 4"),
        ({"speed": -5.0}, r"commonroad_body\.speed: expected a finite number of at least 0, got -5\.0"),
        ({"period": 1.5e-3}, "no whole number of its steps of 0.001 s"),
        ({"names": {"side": "y"}}, "name of the model 'side' is unknown"),
    ],
)
def test_wrong_uses(settings, words):
    with pytest.raises(FpirhcError, match=words):
        body(**settings)
