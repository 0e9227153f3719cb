"""A step of 2 m with a weak actuator: a clipped command is stored as the request it means, and the integral stays out."""

import numpy as np
import pytest

import fpirhc as fp

LARGEST = 20.0  # N


def duffing():
    """A soft Duffing oscillator whose model is half as heavy again and has springs and damping too weak by half."""
    return fp.Plant(
        coordinates={"q": "m"},
        inputs={"u": "N"},
        parameters={
            "m": fp.Parameter(approximate=1.5, exact=1.0, unit="kg"),
            "k": fp.Parameter(approximate=0.3, exact=0.5, unit="N/m"),
            "l": fp.Parameter(approximate=0.05, exact=0.1, unit="N/m^3"),
            "b": fp.Parameter(approximate=0.2, exact=0.5, unit="N s/m"),
        },
        response=lambda q, v, u, p: {"q": (u.u - p.k * q.q - p.l * q.q**3 - p.b * v.q) / p.m},
    )


@pytest.mark.parametrize("form", [lambda map: map, fp.ModelReferenced], ids=["plain", "model-referenced"])
def test_the_step_settles(form):
    """It asks for 324 N at first and has 20; it overshoots by a tenth, settles, and the request stays reachable."""
    problem = fp.Problem(
        plant=duffing(),
        reference=fp.Trajectory(lambda t: {"q": 2 + 0 * t}),
        start={"q": 0.0},
        period=1e-3,
        duration=10.0,
        limits=fp.Limits(inputs={"u": (-LARGEST, LARGEST)}),
    )
    law = fp.ComputedTorque(fp.Exponential(rate=6.0, bumpless=False), form(fp.Sigmoid(gain=-0.5, scale=20.0)))
    run = fp.simulate(problem, law, seed=0)
    assert run["command_unclipped.u"][0] == pytest.approx(1.5 * 108 * 2)
    assert run["error.q"].min() > -0.3
    assert np.abs(run["error.q"][2000:]).max() < 0.02
    assert np.abs(run["deformed.q"]).max() < 1.1 * LARGEST
    assert np.abs(run["command_unclipped.u"]).max() < 330
