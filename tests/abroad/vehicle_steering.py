"""A vehicle changes lanes at 10 m/s, after python-control's example of steering control.

    y' = v sin(slip + theta),    theta' = v tan(delta) / b,    slip = atan(a tan(delta) / b)

y is the lateral position of a point a in front of the rear axle, theta the heading, delta the angle of the front wheels. The point
moves sideways at once with the wheels, so y has relative degree one, and the heading behind it decays at v cos(theta) / a.

Model and numbers: python-control, examples/steering.py (BSD-3), v = 10 m/s, a = 1.5 m, b = 3 m, wheels up to 0.5 rad; K. J. Astrom,
R. M. Murray, Feedback Systems, 2008, example 2.8. The model has a wheelbase of 2.4 m.
"""

import casadi as ca

import fpirhc as fp


def rates(x, u, p):
    slip = ca.atan(p.offset * ca.tan(u.delta) / p.wheelbase)
    return {"side": p.speed * ca.sin(slip + x.theta), "theta": p.speed * ca.tan(u.delta) / p.wheelbase}


plant = fp.Plant.of_states(
    states={"side": "m", "theta": "rad"},
    inputs={"delta": "rad"},
    parameters={
        "speed": fp.Parameter(10.0, 10.0, "m/s"),
        "offset": fp.Parameter(1.5, 1.5, "m"),
        "wheelbase": fp.Parameter(approximate=2.4, exact=3.0, unit="m"),
    },
    rates=rates,
    outputs={"y": fp.Output("m", lambda x, p: x.side)},
)
problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"y": 4 / (1 + ca.exp(-2 * (t - 3)))}),
    start={"side": 0.01, "theta": 0.0},
    period=0.02,
    duration=8.0,
    measure_from=0.5,
    limits=fp.Limits(inputs={"delta": (-0.5, 0.5)}),
    horizon=fp.Horizon(stages=20, step=0.1),
    cost=fp.Quadratic(outputs={"y": 10.0}, rate={"delta": 1.0}),
)
optimiser = fp.FixedPoint(iterations=3, tolerance=1e-3)
controllers = {
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.Affine(gain=-0.8)),
    "RHC+model-referenced": fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=-0.8))),
    "CTC": fp.ComputedTorque(fp.Exponential(rate=3.0)),
    "CTC+FPI": fp.ComputedTorque(fp.Exponential(rate=3.0), fp.Affine(gain=-0.8)),
}
headline = ("RHC", "RHC+model-referenced")
