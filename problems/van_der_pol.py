"""A van der Pol-Duffing oscillator: one coordinate, a wrong model, and an actuator that is too weak for the start.

The oscillator and both sets of parameters are those of the examples of J. K. Tar's group in the public collection
krisztiankosi/Control (MIT licence),

    m q'' = u + mu (1 - q^2) q' - omega^2 q - alpha q^3 - lam q^5,        nominal motion  q^N = 2 sin(t / 2).

The cubic term is Duffing's, the velocity term van der Pol's: it feeds energy in for |q| < 1 and takes it out beyond. The
published file prints the last term without its argument; q^5 is our reading. The limits and the start are chosen here so
that the first second needs more force than the limits allow. Errors count from 3 s on:

    rms error, seed 0     q [m]
    RHC                  0.0068
    RHC+FPI             3.4e-05
    RHC exact model     2.2e-05
"""

import casadi as ca

import fpirhc as fp


def response(q, v, u, p):
    damping = p.mu * (1 - q.q**2) * v.q
    spring = p.omega**2 * q.q + p.alpha * q.q**3 + p.lam * q.q**5
    return {"q": (u.u + damping - spring) / p.m}


plant = fp.Plant(
    coordinates={"q": "m"},
    inputs={"u": "N"},
    order=2,
    response=response,
    parameters={
        "m": fp.Parameter(approximate=0.8, exact=1.0, unit="kg"),
        "mu": fp.Parameter(approximate=0.5, exact=0.4, unit="N s/m"),
        "omega": fp.Parameter(approximate=0.42, exact=0.46, unit="(N/m)^0.5"),
        "alpha": fp.Parameter(approximate=0.9, exact=1.0, unit="N/m^3"),
        "lam": fp.Parameter(approximate=0.09, exact=0.1, unit="N/m^5"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"q": 2 * ca.sin(0.5 * t)}),
    start={"q": -1.5},
    period=2e-3,  # s
    duration=20.0,  # s
    limits=fp.Limits(inputs={"u": (-15.0, 15.0)}),  # N; the motion itself needs 11 N
    horizon=fp.Horizon(stages=20, step=2e-2),
    cost=fp.Quadratic(states={"q": 1e2, "q'": 1.0}, deviation={"u": 1e-2}),
    measure_from=3.0,  # s
)

optimiser = fp.FixedPointSolver()
sigmoid = fp.Sigmoid(gain=-0.5, shift=0.3, scale=50.0)  # scale in m/s^2: the plan may jump from limit to limit

controllers = {
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),
    "RHC exact model": fp.ExactModel(fp.RecedingHorizon(optimiser)),
}
headline = ("RHC", "RHC+FPI")
why = (
    "The wrong springs act where the force does; a quick filter of an exact response is an "
    "iteration of unit gain, so both leave the same."
)
