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


def step_of_two_metres(bumpless=False, deformation=None, **law):
    """Run from rest at 0 m to 2 m, where 1.8 N hold the plant."""
    problem = fp.Problem(
        plant=duffing(),
        reference=fp.Trajectory(lambda t: {"q": 2 + 0 * t}),
        start={"q": 0.0},
        period=1e-3,
        duration=10.0,
        limits=fp.Limits(inputs={"u": (-LARGEST, LARGEST)}),
    )
    law, sigmoid = fp.Exponential(rate=6.0, bumpless=bumpless, **law), fp.Sigmoid(gain=-0.5, scale=20.0)
    return fp.simulate(problem, fp.ComputedTorque(law, deformation or sigmoid), seed=0)


def overshoot(run):
    return max(0.0, -float(run["error.q"].min()))


def settled(run):
    """Time after which the error stays below 2 cm, s."""
    outside = np.flatnonzero(np.abs(run["error.q"]) > 0.02)
    return run.time[outside[-1]] + run.period


@pytest.mark.parametrize("form", [lambda map: map, fp.ModelReferenced], ids=["plain", "model-referenced"])
def test_the_step_settles(form):
    """It asks for 324 N at first and has 20; it overshoots by a tenth, settles, and the request stays reachable."""
    run = step_of_two_metres(deformation=form(fp.Sigmoid(gain=-0.5, scale=20.0)))
    assert run["command_unclipped.u"][0] == pytest.approx(1.5 * 108 * 2)
    assert overshoot(run) < 0.3
    assert settled(run) < 2.0
    assert np.abs(run["deformed.q"]).max() < 1.1 * LARGEST
    assert np.abs(run["command_unclipped.u"]).max() < 330


def test_bumpless_start_does_not_reach_the_limit():
    """A bumpless start asks for less than there is, so that nothing needs to be prevented."""
    run = step_of_two_metres(bumpless=True)
    assert not run["clipped"].any()
    assert overshoot(run) < 1e-3
    assert settled(run) < 2.0
