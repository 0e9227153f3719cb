"""Inverted pendulum: model reference adaptive control by fixed-point iteration, by Lyapunov's rule, and its rivals.

A pendulum on a motor, the angle measured from upright,

    m l^2 angle'' = m g l sin(angle) - c angle' - f tanh(angle' / 0.05 rad/s) + torque,

with friction that the model lacks and a reference model that is twice as heavy as the plant (m_r = 2 kg, m = 1 kg); from 8
s to 11 s a load of 1 N m pulls. The motion swings through upright, and the pendulum starts 0.3 rad beside it. Every law
prescribes the same rate of 6 1/s, so that they differ only in their treatment of the wrong model; without noise and dead
time a higher gain would make any of them more precise.

Errors count from 3 s on:

    rms error, seed 0        angle [rad]
    PID                             0.04
    CTC                            0.033
    CTC+FPI                      0.00027
    INDI                         1.7e-05
    INDI, filtered                0.0011
    ADRC                           0.012
    L1 adaptive                  0.00021
    sliding mode                  0.0018
    acceleration feedback         0.0057
    acceleration rate              0.034
    force MRAC, no FPI             0.033
    force MRAC                   0.00027
    Lyapunov MRAC                 0.0022

INDI without a filter is an iteration of unit gain and CTC+FPI one of a quarter: here more gain is better, because nothing is
noisy or late. ADRC measures the angle alone. Lyapunov's rule has the best of several adaptations; its
leakage has little effect here.
"""

import casadi as ca

import fpirhc as fp


def response(q, v, u, p):
    friction = p.c * v.angle + p.f * ca.tanh(v.angle / 0.05)
    return {"angle": (p.m * p.g * p.l * ca.sin(q.angle) - friction + u.torque) / (p.m * p.l**2)}


plant = fp.Plant(
    coordinates={"angle": "rad"},
    inputs={"torque": "N m"},
    order=2,
    response=response,
    parameters={
        "m": fp.Parameter(approximate=2.0, exact=1.0, unit="kg"),
        "l": fp.Parameter(approximate=0.5, exact=0.55, unit="m"),
        "c": fp.Parameter(approximate=0.0, exact=0.2, unit="N m s"),
        "f": fp.Parameter(approximate=0.0, exact=0.3, unit="N m"),
        "g": fp.Parameter(approximate=9.81, exact=9.81, unit="m/s^2"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(1.5 * t)}),
    start={"angle": 0.3},
    period=1e-3,  # s
    duration=15.0,  # s
    limits=fp.Limits(inputs={"torque": (-20.0, 20.0)}),  # N m
    disturbances={"torque": fp.Step(at=8.0, duration=3.0, size=-1.0)},
    measure_from=3.0,  # s
)

RATE = 6.0  # 1/s, of every law
track = fp.Exponential(RATE)
sigmoid = fp.Sigmoid(gain=-0.5, shift=0.3, scale=50.0)  # scale in rad/s^2
inertia = 0.5  # kg m^2, of the model: the PID has the gains that computed torque has there

controllers = {
    "PID": fp.PID({"angle": 108 * inertia}, {"angle": 216 * inertia}, {"angle": 18 * inertia}),
    "CTC": fp.ComputedTorque(track),
    "CTC+FPI": fp.ComputedTorque(track, sigmoid),
    "INDI": fp.rivals.INDI(track),
    "INDI, filtered": fp.rivals.INDI(track, frequency=50.0),  # rad/s, as published for quadrotors
    "ADRC": fp.rivals.ADRC(RATE, observer=10 * RATE),
    "L1 adaptive": fp.rivals.L1Adaptive(track, bandwidth=300.0),  # rad/s
    "sliding mode": fp.rivals.SlidingMode(rate=RATE, gain=500.0, width=1.0),  # rad/s^2, rad/s: chatters from 4 ms on
    "acceleration feedback": fp.rivals.AccelerationFeedback(track, gain=5.0, time_constant=0.02),
    "acceleration rate": fp.rivals.ResolvedAccelerationRate(RATE),
    "force MRAC, no FPI": fp.rivals.ForceMRAC(track, fp.Identity()),
    "force MRAC": fp.rivals.ForceMRAC(track, fp.Sigmoid(gain=-0.5, shift=0.3, scale=25.0)),  # scale in N m
    "Lyapunov MRAC": fp.rivals.LyapunovMRAC(RATE, adaptation=300.0, leakage=0.02),
}
headline = ("CTC", "CTC+FPI")
why = (
    "All is exact and nothing is late, so the largest gain wins: PID with poles at 300 "
    "1/s, where every law of the file keeps to 6 1/s."
)
