"""Skogestad's process E2 behind its half-rule model: a dead time and a lag that the response does not show, and a wrong gain.

    G(s) = k exp(-0.77 s) / ((2 s + 1)(1.2 s + 1)),

which is the second-order model of (-0.3 s + 1)(0.08 s + 1) / ((2 s + 1)(s + 1)(0.4 s + 1)(0.2 s + 1)(0.05 s + 1)^3).

S. Skogestad, Simple analytic rules for model reduction and PID controller tuning, J. Process Control 13, 2003, example E2: k = 1,
theta = 0.77, tau_1 = 2, tau_2 = 1.2. The output follows the valve, v' = (u - v) / tau_2 and y' = (k v - y) / tau_1; the model
of the controllers has y and the command alone. Chosen here: the unit of time (s), a gain of the model that is
40 % too large, a slow sine, a cycle of 0.07 s. `swinging` weighs the command a hundred times less, which a loop
without prediction does not bear.
"""

from dataclasses import replace

import casadi as ca

import fpirhc as fp

LATE, VALVE = 0.77, 1.2  # s


def process(gain):
    """Y' = (k u - y) / tau_1 with this gain of the model."""
    return fp.Plant(
        coordinates={"y": "1"},
        inputs={"u": "1"},
        order=1,
        response=lambda q, u, p: {"y": (p.k * u.u - q.y) / p.tau},
        parameters={
            "k": fp.Parameter(approximate=gain, exact=1.0, unit="1"),
            "tau": fp.Parameter(approximate=2.0, exact=2.0, unit="s"),
        },
    )


behind_valve = fp.Plant(
    coordinates={"y": "1", "v": "1"},
    inputs={"u": "1"},
    order=1,
    response=lambda q, u, p: {"y": (p.k * q.v - q.y) / p.tau, "v": (u.u - q.v) / p.tau_2},
    parameters={
        "k": fp.Parameter(approximate=1.0, exact=1.0, unit="1"),
        "tau": fp.Parameter(approximate=2.0, exact=2.0, unit="s"),
        "tau_2": fp.Parameter(approximate=VALVE, exact=VALVE, unit="s"),
    },
)

problem = fp.Problem(
    plant=process(1.4),
    reality=fp.Reality(behind_valve, start={"v": 0.0}),
    reference=fp.Trajectory(lambda t: {"y": 1 - ca.cos(0.1 * t)}),
    start={"y": 0.0},
    period=0.07,  # s
    duration=140.0,  # s
    limits=fp.Limits(inputs={"u": (-1.0, 4.0)}),
    dead_time=fp.DeadTime(inputs={"u": LATE}),
    horizon=fp.Horizon(stages=20, step=0.14),
    cost=fp.Quadratic(states={"y": 1.0}, deviation={"u": 1.0}),
    measure_from=60.0,  # s
)
swinging = replace(problem, cost=fp.Quadratic(states={"y": 1.0}, deviation={"u": 1e-2}))

optimiser = fp.FixedPoint(iterations=5, tolerance=1e-3)
plain = fp.RecedingHorizon(optimiser)
paired = fp.ModelReferenced(fp.Affine(gain=-0.5), cycles=11, lag=VALVE)
controllers = {
    "RHC": fp.Predicted(plain, inputs=LATE),
    "RHC+FPI": fp.Predicted(plain.with_deformation(paired), inputs=LATE),
    "RHC, not predicted": plain,
    "RHC+FPI, not predicted": plain.with_deformation(paired),
}
headline = ("RHC", "RHC+FPI")
