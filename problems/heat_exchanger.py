"""Outlet temperature of a heat exchanger behind a valve: a static map that the model does not know, a lag, and a dead time.

    model      lag T' = gain u(t - theta) - T
    reality    lag T' = 2.5 tanh(.8 u(t - theta)) + .15 u(t - theta) + .3 - T

lag = 20 s, theta = 5 s, a control cycle of 1 s: the plant has settled long after the cycle. The model has a straight line for the
valve; the slope of the real map is between .15 and 2.15 times the model's. Only what is settled matters to an iteration on
targets. Errors count from 400 s on:

    rms error, seed 0          outlet [K]
    static inverse                   0.69
    Cascade                         0.057
    Cascade, last target            0.066
    static inverse, exact map       0.037

Numbers are chosen here.
"""

import casadi as ca

import fpirhc as fp

LAG = fp.Parameter(approximate=20.0, exact=20.0, unit="s")


def straight(q, u, p):
    """Rate of the outlet temperature by the model, K/s."""
    return {"outlet": (p.gain * u.valve - q.outlet) / p.lag}


def curved(q, u, p):
    """Rate of the outlet temperature, K/s."""
    settled = p.height * ca.tanh(p.sharpness * u.valve) + p.rest * u.valve + p.offset
    return {"outlet": (settled - q.outlet) / p.lag}


def exchanger(response, parameters):
    """A heat exchanger with this rate; its temperature counts from the middle of the range."""
    return fp.Plant(
        coordinates={"outlet": "K"},
        inputs={"valve": "1"},
        order=1,
        response=response,
        parameters={"lag": LAG, **parameters},
    )


def same(value, unit):
    """A parameter of the reality, which is also that of a controller with the exact model."""
    return fp.Parameter(approximate=value, exact=value, unit=unit)


reality = exchanger(
    curved, {"height": same(2.5, "K"), "sharpness": same(0.8, "1"), "rest": same(0.15, "K"), "offset": same(0.3, "K")}
)

problem = fp.Problem(
    plant=exchanger(straight, {"gain": same(1.0, "K")}),
    reality=fp.Reality(reality),
    reference=fp.Trajectory(lambda t: {"outlet": 0.5 + 1.2 * ca.sin(2 * ca.pi * t / 800)}),
    start={"outlet": 0.3},
    period=1.0,  # s
    duration=1600.0,  # s
    limits=fp.Limits(inputs={"valve": (-5.0, 5.0)}),
    dead_time=fp.DeadTime(inputs={"valve": 5.0}),
    measure_from=400.0,  # s
)

static = fp.FeedforwardOnly()
controllers = {
    "static inverse": static,
    "Cascade": fp.Cascade(static, fp.Affine(gain=-1.0), lag=20.0),  # s
    "Cascade, last target": fp.Cascade(static, fp.Affine(gain=-0.1), lag=None),
    "static inverse, exact map": fp.ExactModel(static),
}
headline = ("static inverse", "Cascade")
why = (
    "Only the settled map is wrong, and an iteration on the target finds its inverse; its "
    "slope varies fourteenfold, for which ADRC must be slow."
)
