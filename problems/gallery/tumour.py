"""A tumour shrunk by an inhibitor of its vessels: growth, effect and clearance of the drug are wrong in the model.

Drexler's minimal model of tumours under antiangiogenic therapy (Drexler, Sápi, Kovács: A minimal model of tumor growth with
angiogenic inhibition using bevacizumab, IEEE SAMI 2017), volume x in mm^3, level of the drug y in mg/kg,

    x' = a x - b x y,     y' = -c y + dose.

In the logarithm s = ln x it is linear, s'' = c (a - s') - b dose, and the dose keeps its effect when the tumour is small. The
unit of time is the day, throughout. The exact parameters are those of C38 mice and bevacizumab: a = 0.27/day, b = 0.0074
kg/(mg day), a half-life of 3.9 days; 6.48 mg/kg a day hold a tumour of any size. In the model, growth is 20 % too
fast, the effect of the drug 20 % too weak, and its clearance 25 % too fast.

Task: ln x along 50 + 1950 (1 + t/25) exp(-t/25) mm^3 with a cycle of 0.05 day and a plan every day; the error counts from
60 days on. The run begins without a drug, so that the first days need the largest dose; doses are never negative. From day
40 on the dose acts as if it were 1 mg/kg a day larger, which no controller measures.

    rms error, seed 0          size [ln(mm^3)]
    CTC                                   0.01
    CTC+FPI                             0.0052
    RHC                                   0.14
    RHC+FPI, model-referenced          1.6e-06
    RHC+FPI                            5.1e-06
    RHC offset-free                    1.7e-06
    RHC exact model                      0.025

"RHC+FPI" is the plain form, as published; the model-referenced row is the affine map with a gain of 0.9, and the
offset-free plan measures the response and acts at once: the two are equal. Both take the step of the dose away; the
exact model, which does not include it, is no bound. For computed torque the transient of the start is not over at 60
days, with or without adaptation. With one reading and one dose a day the picture changes: see `tumour_daily`.
"""

import math

import casadi as ca
import numpy as np

import fpirhc as fp

HALF_LIFE = 3.9  # days


def response(q, v, u, p):
    return {"size": p.clearance * (p.growth - v.size) - p.effect * u.dose}


plant = fp.Plant(
    coordinates={"size": "ln(mm^3)"},
    inputs={"dose": "mg/kg/day"},
    order=2,
    response=response,
    time_unit="day",
    parameters={
        "growth": fp.Parameter(approximate=1.2 * 0.27, exact=0.27, unit="1/day"),
        "effect": fp.Parameter(approximate=0.8 * 0.0074, exact=0.0074, unit="kg/mg/day"),
        "clearance": fp.Parameter(
            approximate=1.25 * math.log(2) / HALF_LIFE, exact=math.log(2) / HALF_LIFE, unit="1/day"
        ),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"size": ca.log(50 + 1950 * (1 + t / 25) * ca.exp(-t / 25))}),
    start={"size": math.log(2000), "size'": 0.27},  # no drug yet
    period=0.05,  # day
    duration=120.0,  # days
    limits=fp.Limits(inputs={"dose": (0.0, 20.0)}),  # mg/kg/day
    disturbances={"dose": fp.Step(at=40.0, size=1.0)},  # day, mg/kg/day
    horizon=fp.Horizon(stages=14, step=1.0),  # day
    cost=fp.Quadratic(states={"size": 1.0, "size'": 10.0}, deviation={"dose": 1e-5}),
    measure_from=60.0,  # days
)

tracking = fp.Exponential(rate=0.15)  # 1/day
optimiser = fp.FixedPointSolver()
plain = fp.RecedingHorizon(optimiser)
sigmoid = fp.Sigmoid(gain=-2.0, shift=0.3, scale=1.0)  # scale in 1/day^2
filter = fp.DisturbanceKalman(drift={"size": 0.1}, measured={"size": 1e-3, "size'": 1e-2, "size''": 2e-3})

controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, fp.RFPT(offset=1e3, sign=-1.0, gain=9e-4)),
    "RHC": plain,
    "RHC+FPI, model-referenced": fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=-1.8))),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),  # the plain form, as published
    "RHC offset-free": fp.Estimating(plain, filter, at_once=True),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI, model-referenced")
why = (
    "The logarithm of the volume is linear in the dose, and the wrong numbers act like a "
    "dose that hardly changes: an integral takes it away."
)
tuning = {
    "CTC+FPI": {"deformation.gain": fp.LogSpan(1e-5, 1.5e-3)},  # day^2
    "RHC+FPI, model-referenced": {"deformation.map.gain": fp.LogSpan(-4.0, -0.1)},
    "RHC+FPI": {"deformation.gain": fp.LogSpan(-4.0, -0.1)},
    "RHC offset-free": {
        "estimator.drift.size": fp.LogSpan(1e-4, 1.0),  # 1/day^2.5
        "estimator.measured.size'": fp.LogSpan(1e-4, 1e-1),  # 1/day
    },
}
pictures = (
    fp.OverTime(
        "Volume and dose",
        panels=(fp.Quantity("volume", "mm^3", lambda run: np.exp(run["state.size"])), "command.dose"),
        levels={"command.dose": (0.0, 20.0)},
    ),
)
