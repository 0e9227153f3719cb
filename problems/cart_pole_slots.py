"""Cart-pole in time slots near upright: what slots cannot do."""

import casadi as ca

import fpirhc as fp


def response(q, v, u, p):
    sin, cos = ca.sin(q.angle), ca.cos(q.angle)
    joint = p.c * v.angle / p.l  # the joint's torque as a force at the tip, N
    force = u.F - p.b * v.cart - p.m * p.l * sin * v.angle**2 + p.m * p.g * sin * cos - joint * cos
    acceleration = force / (p.M + p.m - p.m * cos**2)
    return {"cart": acceleration, "angle": (p.g * sin + acceleration * cos - joint / p.m) / p.l}


plant = fp.Plant(
    coordinates={"cart": "m", "angle": "rad"},
    inputs={"F": "N"},
    order=2,
    response=response,
    controlled=("cart",),
    parameters={
        "M": fp.Parameter(approximate=1.3, exact=1.0, unit="kg"),
        "m": fp.Parameter(approximate=0.15, exact=0.1, unit="kg"),
        "l": fp.Parameter(approximate=0.8, exact=0.8, unit="m"),
        "b": fp.Parameter(approximate=0.0, exact=2.0, unit="N s/m"),
        "c": fp.Parameter(approximate=0.0, exact=0.002, unit="N m s"),
        "g": fp.Parameter(approximate=9.81, exact=9.81, unit="m/s^2"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"cart": 0 * t, "angle": 0 * t}),
    start={"cart": -0.1, "angle": 0.1},
    period=5e-3,  # s
    duration=6.0,  # s
    limits=fp.Limits(inputs={"F": (-30.0, 30.0)}),  # N
    horizon=fp.Horizon(stages=40, step=5e-2),
    cost=fp.Quadratic(states={"cart": 1e2, "angle": 1e2, "cart'": 1.0, "angle'": 1.0}, correction={"F": 1e-2}),
    measure_from=1.2,  # s, after two periods
    judged=("cart", "angle"),
)

optimiser = fp.FixedPoint(iterations=2, tolerance=1e-2)  # N
sigmoid = fp.Sigmoid(gain=-1.0, shift=0.3, scale=100.0)  # scale in m/s^2 or rad/s^2


def slotted(deformation):
    angle = fp.Slot("angle", fp.Exponential(rate=8.0, integral=False), deformation)  # 1/s
    cart = fp.Slot("cart", fp.Exponential(rate=0.5, integral=False), deformation)
    return fp.Slotted((angle, cart), fp.Periodic({"angle": 0.5, "cart": 0.1}), blend=0.02)


controllers = {
    "slots": slotted(fp.Identity()),
    "slots+FPI": slotted(sigmoid),
    "slots exact model": fp.Informed(slotted(fp.Identity())),
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),
}
headline = ("slots", "slots+FPI")
