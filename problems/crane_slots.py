"""Crane in time slots: cart and hanging load share one force, each is controlled alone in its own slots.

    (M + m) x'' + m l cos angle'' = F - b x' + m l sin angle'^2,        cos x'' + l angle'' = -g sin - c angle'
"""

import casadi as ca

import fpirhc as fp


def response(q, v, u, p):
    sin, cos = ca.sin(q.angle), ca.cos(q.angle)
    joint = p.c * v.angle
    force = u.F - p.b * v.cart + p.m * sin * (p.l * v.angle**2 + p.g * cos) + p.m * cos * joint
    acceleration = force / (p.M + p.m * sin**2)
    return {"cart": acceleration, "angle": -(p.g * sin + acceleration * cos + joint) / p.l}


plant = fp.Plant(
    coordinates={"cart": "m", "angle": "rad"},
    inputs={"F": "N"},
    order=2,
    response=response,
    controlled=("cart",),
    parameters={
        "M": fp.Parameter(approximate=1.3, exact=1.0, unit="kg"),
        "m": fp.Parameter(approximate=0.6, exact=0.8, unit="kg"),
        "l": fp.Parameter(approximate=0.9, exact=1.0, unit="m"),
        "b": fp.Parameter(approximate=0.0, exact=1.0, unit="N s/m"),
        "c": fp.Parameter(approximate=0.0, exact=0.0, unit="m/s"),
        "g": fp.Parameter(approximate=9.81, exact=9.81, unit="m/s^2"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"cart": 0 * t, "angle": 0 * t}),
    start={"cart": -1.0, "angle": 0.0},
    period=5e-3,  # s
    duration=26.5,  # s, five periods of the schedule
    limits=fp.Limits(inputs={"F": (-10.0, 10.0)}),  # N
    horizon=fp.Horizon(stages=30, step=5e-2),
    cost=fp.Quadratic(states={"cart": 1e1, "angle": 1e1, "cart'": 1.0, "angle'": 1.0}, correction={"F": 1e-1}),
    measure_from=10.6,  # s, after two periods
    judged=("cart", "angle"),
)

schedule = fp.Periodic({"cart": 1.4, "angle": 3.9})  # s
optimiser = fp.FixedPoint(iterations=2, tolerance=1e-2)  # N
sigmoid = fp.Sigmoid(gain=-0.5, shift=0.3, scale=10.0)  # scale in m/s^2 or rad/s^2


def slotted(deformation):
    cart = fp.Slot("cart", fp.Exponential(rate=1.0, integral=False), deformation)  # 1/s
    angle = fp.Slot("angle", fp.Exponential(rate=3.0, integral=False), deformation)
    return fp.Slotted((cart, angle), schedule, blend=0.1)


controllers = {
    "slots": slotted(fp.Identity()),
    "slots+FPI": slotted(sigmoid),
    "slots exact model": fp.Informed(slotted(fp.Identity())),
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),
}
headline = ("slots", "slots+FPI")
