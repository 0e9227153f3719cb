"""A stirred tank reactor, as do-mpc ships it, with its exact model and with one of do-mpc's uncertain ones.

    C_a' = F (C_A0 - C_a) - k1 C_a - k3 C_a^2,     C_b' = -F C_b + k1 C_a - k2 C_b,
    T_R' = -(k1 C_a H_ab + k2 C_b H_bc + k3 C_a^2 H_ad) / (rho c_p) + F (T_in - T_R) - K_w A_R (T_R - T_K) / (rho c_p V_R),
    T_K' = (Q + K_w A_R (T_R - T_K)) / (m_k c_pk),     k1 = beta k0 exp(-E/(T_R + 273.15)), k3 with alpha E_ad.

Model and figures: do-mpc, examples/CSTR (LGPL-3; Klatt and Engell 1998). Concentrations in mol/l, temperatures in C, time in
hours; F is the inflow per volume, 1/h, Q the heat flow, kJ/h. The set-point 0.6 mol/l,
the limits, the period of 0.005 h and the 20 stages are those of the example; its weights of the inputs'
changes act there on F / 100 and Q / 2000, and here on F and Q, which makes the plans gentler. `problem` has the exact model;
`wrong` has alpha = 0.95, beta = 1.1 as its model; the spreads are do-mpc's scenarios alpha in {0.95, 1, 1.05},
beta in {0.9, 1, 1.1}.
The jacket has a pole at K_w A_R / (m_k c_pk) = 86.7 1/h: 0.43 of it passes in a cycle.
"""

import casadi as ca

import fpirhc as fp

PERIOD = 0.005  # h


def speeds(q, p):
    kelvin = q.T_R + 273.15
    return (
        p.beta * 1.287e12 * ca.exp(-9758.3 / kelvin),
        1.287e12 * ca.exp(-9758.3 / kelvin),
        9.043e9 * ca.exp(-p.alpha * 8560.0 / kelvin),
    )


def response(q, u, p):
    k1, k2, k3 = speeds(q, p)
    heat = 4.2 * k1 * q.C_a - 11.0 * k2 * q.C_b - 41.85 * k3 * q.C_a**2
    wall = 4032.0 * 0.215 * (q.T_R - q.T_K)  # kJ/h
    return {
        "C_a": u.F * (5.1 - q.C_a) - k1 * q.C_a - k3 * q.C_a**2,
        "C_b": -u.F * q.C_b + k1 * q.C_a - k2 * q.C_b,
        "T_R": -heat / (0.9342 * 3.01) + u.F * (130.0 - q.T_R) - wall / (0.9342 * 3.01 * 10.01),
        "T_K": (u.Q + wall) / (5.0 * 2.0),
    }


def reactor(alpha, beta, controlled=("C_b", "T_K")):
    """The plant with this model; the exact one has alpha = beta = 1."""
    return fp.Plant(
        coordinates={"C_a": "mol/l", "C_b": "mol/l", "T_R": "C", "T_K": "C"},
        inputs={"F": "1/h", "Q": "kJ/h"},
        controlled=controlled,
        order=1,
        time_unit="h",
        response=response,
        parameters={
            "alpha": fp.Parameter(approximate=alpha, exact=1.0, unit="1", spread=fp.Uniform(absolute=0.05)),
            "beta": fp.Parameter(approximate=beta, exact=1.0, unit="1", spread=fp.Uniform(absolute=0.1)),
        },
    )


def task(plant, period=PERIOD):
    """Keep C_b at 0.6 mol/l from do-mpc's first state; only C_b is weighed."""
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(
            lambda t: {"C_a": 0.7 + 0 * t, "C_b": 0.6 + 0 * t, "T_R": 134.0 + 0 * t, "T_K": 133.0 + 0 * t}
        ),
        start={"C_a": 0.8, "C_b": 0.5, "T_R": 134.14, "T_K": 130.0},
        period=period,  # h
        duration=1.5,  # h
        limits=fp.Limits(inputs={"F": (5.0, 100.0), "Q": (-8500.0, 0.0)}),
        horizon=fp.Horizon(stages=20, step=PERIOD),
        cost=fp.Quadratic(states={"C_b": 1.0}, rate={"F": 0.1, "Q": 1e-3}),
        measure_from=1.0,  # h
    )


problem = task(reactor(1.0, 1.0))

optimiser = fp.FixedPointSolver(iterations=3, tolerance=1e-2)
plain = fp.RecedingHorizon(optimiser)
controllers = {
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.Sigmoid(gain=-0.5)),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI")
