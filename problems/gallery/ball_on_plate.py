"""A ball on a plate that a camera watches: an eight, with two servos that the model does not have.

A table-tennis ball rolls on a plate that is tilted about two axes. With h the share of gravity that moves a rolling ball (5/7 for a
solid one, 3/5 for a hollow one), the tilt a across and b along,

    x'' = h (g sin(a - lean_x) + (x a' + y b') a') - drag x',    and y'' with b;        servo a' = command - a.

The camera takes 50 pictures a second and sees the ball to 0.2 mm. Velocity and acceleration are fitted to seven of them, so the
acceleration is 2.5 cycles late.

Model: a solid ball on a level plate, x'' = h g sin(command). It has no servos (30 ms), no drag, and no lean of the plate by a
degree.

Task: an eight of 20 by 14 cm. Errors of the true place count from 4 s on:

    rms error, seed 0           x [m]    y [m]
    PID                       0.00043   0.0018
    ADRC                      0.00028  0.00085
    RHC                         0.002    0.002
    RHC+FPI                   0.00021  0.00045
    RHC offset-free           0.00017  0.00026

The iteration leaves a tenth and a fifth of the error, and the offset-free plan less. The iteration needs the acceleration, which a
camera gives late and with noise, so its gain has to be small, behind a filter; were accelerations known at once, three times the
gain would win. The filter of the offset-free plan asks for places and velocities alone.

References: the equations of the ball are Lagrange's, as in textbooks of control; the numbers are our own.
"""

import casadi as ca

import fpirhc as fp

G = 9.81  # m/s^2
SOLID, HOLLOW = 1 / (1 + 2 / 5), 1 / (1 + 2 / 3)  # by the moment of inertia of a ball of radius and mass one
LARGEST = 0.25  # rad
PLATE, RADIUS = 0.3, 0.02  # m


def response(q, v, u, p):
    return {"x": p.rolling * G * ca.sin(u.across - p.lean_x), "y": p.rolling * G * ca.sin(u.along - p.lean_y)}


def of_the_table(q, v, u, p):
    """Accelerations of the ball, and rates of the servos behind which the plate turns."""
    across, along = (u.across - q.turned) / p.servo, (u.along - q.tilted) / p.servo
    thrown = q.x * across + q.y * along
    return {
        "x": p.rolling * (G * ca.sin(q.turned - p.lean_x) + thrown * across) - p.drag * v.x,
        "y": p.rolling * (G * ca.sin(q.tilted - p.lean_y) + thrown * along) - p.drag * v.y,
        "turned": across,
        "tilted": along,
    }


def eight(t):
    return {"x": 0.1 * ca.sin(1.5 * t), "y": 0.07 * ca.sin(3.0 * t)}


inputs = {"across": "rad", "along": "rad"}
parameters = {
    "rolling": fp.Parameter(approximate=SOLID, exact=HOLLOW, unit="1"),
    "lean_x": fp.Parameter(approximate=0.0, exact=0.02, unit="rad"),
    "lean_y": fp.Parameter(approximate=0.0, exact=-0.015, unit="rad"),
}
plant = fp.Plant(coordinates={"x": "m", "y": "m"}, inputs=inputs, response=response, parameters=parameters)
table = fp.Plant(
    coordinates={"x": "m", "y": "m", "turned": "rad", "tilted": "rad"},
    inputs=inputs,
    order={"x": 2, "y": 2, "turned": 1, "tilted": 1},
    response=of_the_table,
    parameters={
        **parameters,
        "servo": fp.Parameter(approximate=0.03, exact=0.03, unit="s"),
        "drag": fp.Parameter(approximate=0.1, exact=0.1, unit="1/s"),
    },
)
camera = fp.Sensor(noise=fp.Noise(2e-4))  # m

problem = fp.Problem(
    plant=plant,
    reality=fp.Reality(table, start={"turned": 0.0, "tilted": 0.0}),
    reference=fp.Trajectory(eight),
    start={"x": 0.05, "y": -0.05},
    period=2e-2,  # s
    duration=20.0,  # s
    measure_from=4.0,  # s
    limits=fp.Limits(inputs=dict.fromkeys(inputs, (-LARGEST, LARGEST))),
    sensing=fp.Sensing({"x": camera, "y": camera}, fp.SavitzkyGolay(window=7, degree=2)),
    horizon=fp.Horizon(stages=15, step=8e-2, replan="cycle"),
    cost=fp.Quadratic(states={"x": 1e3, "y": 1e3, "x'": 10.0, "y'": 10.0}, deviation=dict.fromkeys(inputs, 1.0)),
)

plain = fp.RecedingHorizon(fp.FixedPointSolver())
iteration = fp.ModelReferenced(fp.Filtered(fp.Affine(gain=-0.15), pole=0.8))
filter = fp.DisturbanceKalman(drift={"x": 0.02, "y": 0.02}, measured={"x": 2e-4, "y": 2e-4, "x'": 5e-3, "y'": 5e-3})
both = ("x", "y")
controllers = {
    "PID": fp.rivals.PID(dict.fromkeys(both, 22.0), dict.fromkeys(both, 140.0), dict.fromkeys(both, 2.0)),
    "ADRC": fp.rivals.ADRC(bandwidth=10.0, observer=20.0),  # 1/s
    "RHC": plain,
    "RHC+FPI": plain.with_deformation(iteration),
    "RHC offset-free": fp.Estimating(plain, filter),
}
headline = ("RHC", "RHC+FPI")
why = (
    "A camera gives the acceleration late and with noise, so the iteration's gain is small; "
    "the filter asks for places and velocities alone."
)
tuning = {
    "RHC+FPI": {"deformation.map.map.gain": fp.LogSpan(-0.6, -0.02)},
    "RHC offset-free": {"estimator.drift.x": fp.LogSpan(1e-3, 1.0), "estimator.drift.y": fp.LogSpan(1e-3, 1.0)},
    "ADRC": {"bandwidth": fp.Span(2.0, 15.0), "observer": fp.Span(5.0, 40.0)},
}


def seen_from_above(q, v, p):
    """The edge of the plate and the ball."""
    edge = [(PLATE / 2 * a, PLATE / 2 * b) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
    return [fp.Shape.line(*edge), fp.Shape.disc((q.x, q.y), RADIUS)]


pictures = (fp.Planar("The plate from above", plant, seen_from_above, controllers=headline),)
