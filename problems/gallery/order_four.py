"""A force that acts on the fourth derivative: a model three times too heavy and twice too fast.

Four equal lags in a row; the system and both sets of parameters are those of the Óbuda group's studies of robust fixed
point transformations at relative order four (a mass pulled through another one by a spring has the same structure),

    m q'''' = F - 4 w q''' - 6 w^2 q'' - 4 w^3 q' - w^4 q,        nominal motion  q^N = sin t.

The error of q counts from 10 s on. The first second needs more force than the limits allow, and at 3 s a force of 30 N pushes
for half a second; no controller measures it. All derivatives are ideal.

    rms error, seed 0            q [m]
    CTC                          0.018
    CTC+FPI                    3.8e-05
    RHC                         0.0073
    RHC+FPI, model-referenced  1.2e-05
    RHC+FPI                    2.4e-05
    RHC offset-free             0.0012
    RHC exact model            1.6e-07

"RHC+FPI" is the plain form, as published; the model-referenced row is the affine map with a gain of 0.6.

The plant answers three times as strongly as the model expects (gain 3), so the effective gain of a deformation must stay
below 2/3: eq. (3) with K_c = 1e6 may have A_c up to 6.7e-7. Beyond that the response error grows in every cycle, until the
limits of the force bound it. An offset-free plan whose filter estimates the disturbance in one cycle is an iteration of
unit gain, beyond that limit: it diverges. Slow filters are late.

FPI is worse where only positions are measured, with noise and derivatives by a polynomial: this gain is then refused before
the run, and told of the delay, with a smaller gain, adaptation is worse than none.
"""

import casadi as ca

import fpirhc as fp


def response(q, v, a, j, u, p):
    w = p.frequency
    return {"q": (u.F - 4 * w * j.q - 6 * w**2 * a.q - 4 * w**3 * v.q - w**4 * q.q) / p.mass}


plant = fp.Plant(
    coordinates={"q": "m"},
    inputs={"F": "N"},
    order=4,
    response=response,
    parameters={
        "mass": fp.Parameter(approximate=3.0, exact=1.0, unit="kg s^2"),
        "frequency": fp.Parameter(approximate=2.0, exact=1.0, unit="1/s"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"q": ca.sin(t)}),
    start={"q": 0.0},  # at rest, while the nominal motion begins with 1 m/s
    period=1e-3,  # s
    duration=20.0,  # s
    limits=fp.Limits(inputs={"F": (-60.0, 60.0)}),  # N
    disturbances={"F": fp.Step(at=3.0, duration=0.5, size=-30.0)},  # N
    horizon=fp.Horizon(stages=40, step=5e-2),
    cost=fp.Quadratic(states={"q": 1e3, "q'": 1.0}, deviation={"F": 1e-4}),
    measure_from=10.0,  # s
)

tracking = fp.Exponential(rate=3.0)  # 1/s
optimiser = fp.FixedPointSolver()
plain = fp.RecedingHorizon(optimiser)
sigmoid = fp.Sigmoid(gain=-1.0, shift=0.3, scale=50.0)  # scale in m/s^4
filter = fp.DisturbanceKalman(drift={"q": 0.39}, measured={"q": 1e-3, "q'": 1e-3, "q''": 1e-2, "q'''": 0.28})

controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, fp.RFPT(offset=1e6, sign=-1.0, gain=5e-7)),
    "RHC": plain,
    "RHC+FPI, model-referenced": fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=-1.2))),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),  # the plain form, as published
    "RHC offset-free": fp.Estimating(plain, filter, at_once=True),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI, model-referenced")
why = (
    "The plant answers three times as strongly as the model: a gain of 0.6 converges, a filter "
    "of one cycle has unit gain, and slow filters are late."
)
tuning = {
    "CTC+FPI": {"deformation.gain": fp.LogSpan(3e-8, 6.5e-7)},  # s^4/m
    "RHC+FPI, model-referenced": {"deformation.map.gain": fp.LogSpan(-1.6, -0.1)},
    "RHC+FPI": {"deformation.gain": fp.LogSpan(-1.6, -0.1)},
    "RHC offset-free": {
        "estimator.drift.q": fp.LogSpan(1e-3, 1e3),  # m/s^4.5
        "estimator.measured.q'''": fp.LogSpan(1e-3, 1.0),  # m/s^3
    },
}
pictures = (
    fp.OverTime("The last seconds", panels=("error.q", "command.F"), since=10.0, controllers=("CTC", "CTC+FPI")),
)
