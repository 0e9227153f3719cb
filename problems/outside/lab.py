"""Two heaters of the Temperature Control Lab, by its own digital twin, behind one energy balance per heater.

The twin of the course's board (tclab, Apache 2.0) has lags of 20 and 140 s, heat that goes across, noise of 0.043 K and a
converter with steps of 0.32 K. The model is what a step test gives: K = 0.9 and 0.45 K/%, 175 s.

    rms error, seed 0      T1 [degC]      T2 [degC]
    RHC                         0.71           0.20
    RHC+FPI                     0.14           0.15
    RHC+FPI, plain form          9.4            6.2
    RHC offset-free             0.20           0.21
    PI of the course             1.3           0.32
"""

import casadi as ca

import fpirhc as fp
from fpirhc.adapters.tclab import tclab_body

needs = ("tclab",)
PERIOD = 2.0  # s


def constant(value, unit):
    return fp.Parameter(approximate=value, exact=value, unit=unit)


plant = fp.Plant(
    coordinates={"T1": "degC", "T2": "degC"},
    inputs={"Q1": "%", "Q2": "%"},
    parameters={"K1": constant(0.9, "K/%"), "K2": constant(0.45, "K/%"), "tau": constant(175.0, "s")},
    response=lambda q, u, p: {"T1": (p.K1 * u.Q1 - (q.T1 - 21)) / p.tau, "T2": (p.K2 * u.Q2 - (q.T2 - 21)) / p.tau},
    order=1,
)
problem = fp.Problem(
    plant=plant,
    reality=tclab_body(plant, period=PERIOD),
    sensing=fp.Sensing(estimator=fp.PositionDifference()),
    reference=fp.Trajectory(lambda t: {"T1": 21 + 29 * (1 - ca.exp(-t / 60)), "T2": 21 + 14 * (1 - ca.exp(-t / 60))}),
    start={"T1": 21.0, "T2": 21.0},
    period=PERIOD,
    duration=900.0,  # s
    measure_from=100.0,  # s
    limits=fp.Limits(inputs={"Q1": (0.0, 100.0), "Q2": (0.0, 100.0)}),
    horizon=fp.Horizon(stages=20, step=10.0),
    cost=fp.Quadratic(states={"T1": 1.0, "T2": 1.0}, deviation={"Q1": 1e-4, "Q2": 1e-4}),
)

optimiser = fp.FixedPointSolver()
plain = fp.RecedingHorizon(optimiser)
filter = fp.DisturbanceKalman(drift={"T1": 1e-5, "T2": 1e-5}, measured={"T1": 0.1, "T2": 0.1})
controllers = {
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=-0.3), lag=60.0)),
    "RHC+FPI, plain form": fp.RecedingHorizon(optimiser, fp.Affine(gain=-0.02)),
    "RHC offset-free": fp.Estimating(plain, filter, at_once=True),
    "PI of the course": fp.PID(proportional={"T1": 5.98, "T2": 11.96}, integral={"T1": 5.98 / 175, "T2": 11.96 / 175}),
}
headline = ("RHC", "RHC+FPI")
why = "The iteration is told of a lag of 60 s through which heat comes; a filter without one takes the heat under way for a loss."
