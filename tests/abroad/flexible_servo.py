"""A servomechanism with a flexible shaft: the mismatch is at the load, where the controlled motor does not feel it.

    J_L q_L'' = -k (q_L - q_M / rho) - b_L q_L',     J_M q_M'' = k / rho (q_L - q_M / rho) - (b_M + K^2 / R) q_M' + K / R V.

Model, figures and limits: A. Bemporad, E. Mosca, Fulfilling hard constraints in uncertain linear systems by reference managing,
Automatica 34(4), 1998, as in the position servomechanism example of MATLAB's Model Predictive Control Toolbox: k = 1280.2 N m/rad,
K = 10 N m/A, J_M = 0.5 kg m^2, J_L = 50 J_M, rho = 20, b_M = 0.1, b_L = 25 N m s/rad, R = 20 Ohm, |V| <= 220 V, torque of the
shaft at most 78.5 N m, a plan every 0.1 s. Chosen here: the load swings by 0.5 rad; the model's load is half as heavy and has
half the friction. The motor's response holds neither of them, so the response Jacobian is 1 and there is nothing to adapt.
"""

import casadi as ca

import fpirhc as fp


def response(q, v, u, p):
    twist = q.load - q.motor / 20.0
    return {
        "load": (-p.k * twist - p.b_L * v.load) / p.J_L,
        "motor": (p.k / 20.0 * twist - (0.1 + 10.0**2 / 20.0) * v.motor + 10.0 / 20.0 * u.V) / 0.5,
    }


plant = fp.Plant(
    coordinates={"load": "rad", "motor": "rad"},
    inputs={"V": "V"},
    controlled=("motor",),
    order=2,
    response=response,
    parameters={
        "k": fp.Parameter(approximate=1280.2, exact=1280.2, unit="N m/rad"),
        "J_L": fp.Parameter(approximate=12.5, exact=25.0, unit="kg m^2"),
        "b_L": fp.Parameter(approximate=12.5, exact=25.0, unit="N m s/rad"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"load": 0.5 * ca.sin(0.8 * t), "motor": 10.0 * ca.sin(0.8 * t)}),
    start={"load": 0.0, "load'": 0.4, "motor": 0.0, "motor'": 8.0},
    period=0.01,  # s
    duration=20.0,  # s
    limits=fp.Limits(inputs={"V": (-220.0, 220.0)}),
    horizon=fp.Horizon(stages=20, step=0.1),
    cost=fp.Quadratic(states={"load": 1e3, "load'": 1.0}, rate={"V": 1e-4}),
    judged=("load",),
    measure_from=5.0,  # s
)

optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-1)  # V
plain = fp.RecedingHorizon(optimiser)
controllers = {
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.Sigmoid(gain=-0.5)),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI")
