"""draft"""

import casadi as ca

import fpirhc as fp


def response(q, v, u, p):
    return {"q": (u.u + p.mu * (1 - q.q**2) * v.q - p.k * q.q - p.l * q.q**3 + p.bias) / p.m}


plant = fp.Plant(
    coordinates={"q": "m"},
    inputs={"u": "N"},
    order=2,
    response=response,
    parameters={
        "m": fp.Parameter(approximate=1.6, exact=1.0, unit="kg"),
        "mu": fp.Parameter(approximate=0.6, exact=1.0, unit="N s/m"),
        "k": fp.Parameter(approximate=2.0, exact=3.0, unit="N/m"),
        "l": fp.Parameter(approximate=1.0, exact=2.0, unit="N/m^3"),
        "bias": fp.Parameter(approximate=0.0, exact=2.0, unit="N"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"q": ca.sin(1.5 * t)}),
    start={"q": 0.0, "q'": 1.5},
    period=2e-3,  # s
    duration=12.0,  # s
    limits=fp.Limits(inputs={"u": (-40.0, 40.0)}),
    horizon=fp.Horizon(stages=25, step=2e-2),
    cost=fp.Quadratic(states={"q": 1e2, "q'": 1.0}, correction={"u": 1e-1}),
    measure_from=4.0,  # s
)

optimiser = fp.FixedPoint(iterations=1, tolerance=1e-2)  # N
plain = fp.RecedingHorizon(optimiser)
sigmoid = fp.Sigmoid(gain=-1.0, shift=0.3, scale=50.0)  # m/s^2
known = {
    "m": fp.Uncertain(0.3, 5.0, 1.0),
    "mu": fp.Uncertain(0.0, 5.0, 1.0),
    "k": fp.Uncertain(0.0, 20.0, 2.0),
    "l": fp.Uncertain(0.0, 20.0, 2.0),
    "bias": fp.Uncertain(-10.0, 10.0, 2.0),
}
learners = {
    "RHC+RLS": fp.RecursiveLeastSquares(known, noise={"q": 3.0}, time=1.0),
    "RHC+MHE": fp.MovingHorizon(known, noise={"q": 0.1}, window=50, time=5.0),
}
controllers = {
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),
    "RHC exact model": fp.Informed(plain),
    "RHC offset-free": fp.Estimating(plain, fp.DisturbanceKalman(drift={"q": 3e3}, measured={"q": 1e-3, "q'": 1e-2})),
    **{name: fp.Estimating(plain, e) for name, e in learners.items()},
}
headline = ("RHC", "RHC+FPI")
