"""A van der Pol-Duffing oscillator with a wrong model: adaptation against what else an engineer would use.

    m q'' = u + mu (1 - q^2) q' - k q - l q^3 + bias,        nominal motion  q^N = sin 1.5 t.

The plan is renewed every 20 ms, a control cycle is 2 ms; nothing is noisy. Rivals of RHC+FPI with the same optimiser and
cost: offset-free RHC (a disturbance of the response, estimated by a Kalman filter and used in every plan), RHC that learns
all five parameters by recursive least squares or over a moving horizon, and RHC with the exact parameters as the bound.

    rms error, seed 0      q [m]
    RHC                    0.091
    RHC+FPI              0.00029
    RHC offset-free      0.00076
    RHC+RLS              0.00032
    RHC+MHE              0.00032
    RHC exact model      0.00032

The controllers were tuned on this very task. In the filter only ratios matter. Two facts stand behind these numbers. The
disturbance acts through the plan, ten times less often than the deformation: at the same rate and with the same information
both are at parity. And the learning controllers are as good as the exact model because its structure is exact: a
disturbance, which is no parameter, spoils them. Parameters and motion are chosen here.
"""

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
    limits=fp.Limits(inputs={"u": (-40.0, 40.0)}),  # N
    horizon=fp.Horizon(stages=25, step=2e-2),
    cost=fp.Quadratic(states={"q": 1e2, "q'": 1.0}, deviation={"u": 1e-1}),
    measure_from=4.0,  # s
)

plain = fp.RecedingHorizon(fp.FixedPointSolver())
sigmoid = fp.Sigmoid(gain=-1.0, shift=0.3, scale=50.0)  # scale in m/s^2
filter = fp.DisturbanceKalman(drift={"q": 3e3}, measured={"q": 1e-3, "q'": 1e-2})
known = {
    "m": fp.Uncertain(lower=0.3, upper=5.0, deviation=1.0),
    "mu": fp.Uncertain(lower=0.0, upper=5.0, deviation=1.0),
    "k": fp.Uncertain(lower=0.0, upper=20.0, deviation=2.0),
    "l": fp.Uncertain(lower=0.0, upper=20.0, deviation=2.0),
    "bias": fp.Uncertain(lower=-10.0, upper=10.0, deviation=2.0),
}
recursive = fp.RecursiveLeastSquares(known, noise={"q": 3.0}, time=1.0)

controllers = {
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(plain.optimiser, sigmoid),
    "RHC offset-free": fp.Estimating(plain, filter),
    "RHC+RLS": fp.Estimating(plain, recursive),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI")
why = (
    "The iteration is at the bound of a plan renewed every 20 ms; PID, without noise or "
    "delay, corrects every 2 ms with poles at 150 1/s."
)
tuning = {
    "RHC+FPI": {"deformation.gain": fp.LogSpan(-3.0, -0.1)},
    "RHC offset-free": {
        "estimator.drift.q": fp.LogSpan(1.0, 3e3),  # m/s^2.5
        "estimator.measured.q'": fp.LogSpan(1e-4, 1e-1),  # m/s
    },
    "RHC+RLS": {"estimator.noise.q": fp.LogSpan(0.1, 10.0), "estimator.time": fp.LogSpan(0.5, 20.0)},
}
