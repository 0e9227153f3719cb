"""Crane in time slots: cart and hanging load share one force, and each is controlled alone in slots of its own.

    (M + m) x'' + m l cos angle'' = F - b x' + m l sin angle'^2,        cos x'' + l angle'' = -g sin,

the angle from hanging down. The cart is to come to rest 1 m away, with the load at rest. In a cart slot (1.4 s) the cart
follows its own decay and the load swings on undamped; in an angle slot (3.9 s) the load comes to rest and the cart rolls
on. Neither slot is asymptotically stable, and yet the schedule is: its Floquet radius is 0.0485 per period of 5.3 s.

That number is for ideal slots, which need the right model. A command that is constant for a cycle while the load swings,
and a small gain, change it a little.

Errors count from 10.6 s on:

    rms error, seed 0    cart [m]    angle [rad]
    slots                    0.49          0.023
    slots+FPI              0.0045         0.0015
    slots exact model       0.013         0.0024
    RHC                   6.1e-07        7.8e-07
    RHC+FPI               1.2e-08        1.9e-08

RHC, which carries both coordinates in one cost, is much faster, with more force at the start. Slots save the optimiser, not
time.

References: J. K. Tar, J. F. Bito, I. J. Rudas, Acta Polytechnica Hungarica 13(1), 2016, for time slots; plant and schedule
are our own.
"""

import casadi as ca

import fpirhc as fp


def response(q, v, u, p):
    sin, cos = ca.sin(q.angle), ca.cos(q.angle)
    force = u.F - p.b * v.cart + p.m * sin * (p.l * v.angle**2 + p.g * cos)
    acceleration = force / (p.M + p.m * sin**2)
    return {"cart": acceleration, "angle": -(p.g * sin + acceleration * cos) / p.l}


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
        "g": fp.Parameter(approximate=9.81, exact=9.81, unit="m/s^2"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Setpoint({"cart": 0.0, "angle": 0.0}, rate=2.0),  # 1/s
    start={"cart": -1.0, "angle": 0.0},
    period=5e-3,  # s
    duration=26.5,  # s, five periods of the schedule
    limits=fp.Limits(inputs={"F": (-10.0, 10.0)}),  # N
    horizon=fp.Horizon(stages=30, step=5e-2),
    cost=fp.Quadratic(states={"cart": 1e1, "angle": 1e1, "cart'": 1.0, "angle'": 1.0}, deviation={"F": 1e-1}),
    measure_from=10.6,  # s, after two periods
    judged=("cart", "angle"),
)

turns = {"cart": 1.4, "angle": 3.9}  # s
optimiser = fp.FixedPointSolver()
sigmoid = fp.Sigmoid(gain=-2.0, shift=0.3, scale=10.0)  # scale in m/s^2 or rad/s^2


def slotted(deformation):
    cart = fp.ComputedTorque(fp.Exponential(rate=1.0, integral=False), deformation)  # 1/s
    angle = fp.ComputedTorque(fp.Exponential(rate=3.0, integral=False), deformation)
    return fp.Slotted({"cart": cart, "angle": angle}, turns, blend=0.1)


controllers = {
    "slots": slotted(fp.Identity()),
    "slots+FPI": slotted(sigmoid),
    "slots exact model": fp.ExactModel(slotted(fp.Identity())),
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),
}
headline = ("slots", "slots+FPI")
why = (
    "Wrong masses and friction stand in the cart's equation alone; once the cart follows "
    "its plan the load does, and ADRC plans no swing."
)


def mechanism(q, v, p):
    """Rail, cart, rope and load."""
    load = (q.cart + p.l * ca.sin(q.angle), -p.l * ca.cos(q.angle))
    return [
        fp.Shape.line((-1.5, 0.07), (0.5, 0.07)),
        fp.Shape.box((q.cart, 0.0), 0.3, 0.14),
        fp.Shape.line((q.cart, 0.0), load),
        fp.Shape.disc(load, 0.08 * p.m ** (1 / 3)),
    ]


pictures = (fp.Planar("The crane", plant, mechanism, controllers=headline),)
