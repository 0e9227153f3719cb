"""A signal acts in every step of what moves with the value in its middle."""

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp

PERIOD = 5.0
INTEGRAL = fp.ComputedTorque(fp.Exponential(rate=0.01))


def pulse(t):
    """10 units in two minutes, from 7 to 9; their cycle is that from 5 to 10."""
    return 5.0 * ca.logic_and(t >= 7.0, t < 9.0)


def stored(step):
    """A map that stores what comes in."""
    return fp.Plant.discrete(
        states={"x": "g", "y": "g"},
        inputs={"u": "g/min"},
        next=lambda x, u, p: {"x": x.x + step * p.eaten, "y": x.y + step * u.u},
        step=step,
        outputs={"y": fp.Output("g", lambda x, p: x.y)},
        time_unit="min",
        parameters={"eaten": fp.outside(nominal=0.0, unit="g/min")},
    )


def flowing():
    """The same as differential equations."""
    return fp.Plant.of_states(
        states={"x": "g", "y": "g"},
        inputs={"u": "g/min"},
        rates=lambda x, u, p: {"x": p.eaten, "y": u.u},
        parameters={"eaten": fp.outside(nominal=0.0, unit="g/min")},
        outputs={"y": fp.Output("g", lambda x, p: x.y)},
        time_unit="min",
    )


def problem(plant, reality, signal=pulse, **more):
    return fp.Problem(
        plant=plant,
        reality=reality,
        reference=fp.Trajectory(lambda t: {"y": 0 * t}),
        start={"x": 0.0, "y": 0.0},
        period=PERIOD,
        duration=60.0,
        signals={"eaten": fp.Unknown(signal)},
        **more,
    )


@pytest.mark.parametrize(
    "task",
    [
        problem(stored(PERIOD), fp.Reality(stored(1.0))),
        problem(flowing(), fp.Reality(flowing(), integrator=fp.RungeKutta4(substeps=5))),
        problem(flowing(), fp.Reality(flowing(), integrator=fp.Collocation(substeps=5))),
    ],
    ids=["map", "Runge-Kutta", "collocation"],
)
def test_what_is_stated_is_what_arrives(task):
    """All 10 units, in the cycle in which they come; the signal that is shown is the mean over the cycle."""
    run = fp.simulate(task, INTEGRAL, seed=0, compiled=False)
    assert run.stop is None
    x = run["reality_state"][:, 0]
    assert x == pytest.approx(np.where(run["time"].ravel() > 7.0, 10.0, 0.0), abs=1e-12)
    assert run["signals.eaten"].sum() * PERIOD == pytest.approx(10.0, abs=1e-12)
