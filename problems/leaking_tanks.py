"""draft"""

import casadi as ca

import fpirhc as fp

GRAVITY = 9.81  # m/s^2
_EMPTY = 1e-4  # m: levels below this flow out as this, so that an empty tank has a finite response


def jet(level):
    return ca.sqrt(2 * GRAVITY * ca.fmax(level, _EMPTY))


def response(h, u, p):
    between = p.s1 * jet(h.h1)
    return {"h1": (1e-6 * u.u - between) / p.A, "h2": (between - p.s2 * jet(h.h2) - 1e-6 * p.leak) / p.A}


plant = fp.Plant(
    coordinates={"h1": "m", "h2": "m"},
    inputs={"u": "ml/s"},
    order=1,
    controlled=("h1",),
    response=response,
    parameters={
        "A": fp.Parameter(approximate=1.54e-3, exact=1.54e-3, unit="m^2"),
        "s1": fp.Parameter(approximate=5.5e-5, exact=5.0e-5, unit="m^2"),
        "s2": fp.Parameter(approximate=4.0e-5, exact=4.0e-5, unit="m^2"),
        "leak": fp.Parameter(approximate=0.0, exact=15.0, unit="ml/s"),
    },
)


def level(t):
    """From 0.12 m to 0.20 m and back, each over about 40 s."""
    return 0.12 + 0.04 * (ca.tanh((t - 60) / 12) - ca.tanh((t - 180) / 12))


problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"h1": 0.64 * level(t), "h2": level(t)}),
    start={"h1": 0.08, "h2": 0.12},
    period=1.0,
    duration=300.0,  # s
    limits=fp.Limits(inputs={"u": (0.0, 200.0)}),  # ml/s
    disturbances={"h1": fp.Noise(2e-4), "h2": fp.Noise(2e-4)},  # m/s
    horizon=fp.Horizon(stages=15, step=2.0),
    cost=fp.Quadratic(states={"h2": 1e4}, rate={"u": 1e-4}),
    measure_from=30.0,  # s
    judged=("h2",),
)

plain = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-2))  # ml/s
sigmoid = fp.Sigmoid(gain=-2.0, shift=0.3, scale=0.1)  # m/s
filter = fp.DisturbanceKalman(drift={"h1": 1e-4, "h2": 1e-4}, measured={"h1": 1e-4, "h2": 1e-4}, noise={"h1": 2e-4, "h2": 2e-4})

controllers = {
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(plain.optimiser, sigmoid),
    "RHC offset-free": fp.Estimating(plain, filter),
    "RHC exact model": fp.Informed(plain),
}
headline = ("RHC", "RHC offset-free")
