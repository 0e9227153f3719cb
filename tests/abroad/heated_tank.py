"""A stirred tank with a heater behind a pipe, whose valve is slow: a process of second order with a dead time.

    10 T' = 2 w - T,   0.5 w' = u(t - 1) - w,     time in minutes, T in K above the feed, w and u in %.

After 2 e^-s / ((10 s + 1) (5 s + 1)), for which D. E. Seborg, T. F. Edgar, D. A. Mellichamp and F. J. Doyle, Process Dynamics and
Control, design controllers; the faster lag is a valve of half a minute here. The model has 1.4 and 14 min, and no valve.
"""

import casadi as ca

import fpirhc as fp

parameters = {
    "K": fp.Parameter(approximate=1.4, exact=2.0, unit="K/%"),
    "tau": fp.Parameter(approximate=14.0, exact=10.0, unit="min"),
}
plant = fp.Plant(
    coordinates={"T": "K"},
    inputs={"u": "%"},
    order=1,
    response=lambda q, u, p: {"T": (p.K * u.u - q.T) / p.tau},
    parameters=parameters,
    time_unit="min",
)
valve = fp.Plant(
    coordinates={"T": "K", "w": "%"},
    inputs={"u": "%"},
    order=1,
    response=lambda q, u, p: {"T": (p.K * q.w - q.T) / p.tau, "w": (u.u - q.w) / p.lag},
    parameters={
        "K": fp.Parameter(approximate=2.0, exact=2.0, unit="K/%"),
        "tau": fp.Parameter(approximate=10.0, exact=10.0, unit="min"),
        "lag": fp.Parameter(approximate=0.5, exact=0.5, unit="min"),
    },
    time_unit="min",
)
problem = fp.Problem(
    plant=plant,
    reality=fp.Reality(plant=valve, start={"w": 10.0}),
    reference=fp.Trajectory(lambda t: {"T": 30 + 10 * ca.sin(0.1 * t)}),
    start={"T": 20.0},
    input_before={"u": 10.0},
    period=0.1,
    duration=120.0,
    measure_from=40.0,
    limits=fp.Limits(inputs={"u": (0.0, 100.0)}),
    dead_time=fp.DeadTime(inputs={"u": 1.0}),
    horizon=fp.Horizon(stages=20, step=0.5),
    cost=fp.Quadratic(states={"T": 1.0}, rate={"u": 0.01}),
)
law = fp.Exponential(rate=0.2)
deformation = fp.ModelReferenced(fp.Affine(gain=-0.2), pole=0.95)  # the dead time is that of the problem
plan = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-2))
controllers = {
    "CTC": fp.ComputedTorque(law),
    "CTC+FPI": fp.ComputedTorque(law, deformation),
    "RHC": fp.Predicted(plan, inputs=1.0),
    "RHC+FPI": fp.Predicted(fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-2), deformation), inputs=1.0),
}
headline = ("CTC", "CTC+FPI")
