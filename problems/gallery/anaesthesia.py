"""Depth of anaesthesia by propofol: the controlled quantity is an output, and the curve from the drug to it is wrong in the model.

Three compartments and an effect site (Schnider et al., Anesthesiology 88, 1998, and 90, 1999), concentrations in mg/l,
infusion in mg/min, time in min,

    C1' = -(k10 + k12 + k13) C1 + k12 C2 + k13 C3 + u / V1,    C2' = k21 (C1 - C2),    C3' = k31 (C1 - C3),
    Ce' = ke0 (C1 - Ce),                                       bis = E0 (1 - Ce^g / (C50^g + Ce^g)).

Nobody gives references of concentrations. The plant is therefore written by its states, and `bis` is an output; its
relative order, two, is found from the symbols. The kinetics follow from age, weight, height and sex, as in an infusion
pump. The curve is the patient's own: the exact values are those of a man of 61 years, 175 cm and 77 kg, and the model has
the medians of 44 patients (Hosseinirad et al. 2023; the numbers are those of the table pd_data_schnider.csv of
ManuMerlo/AReS-Anesthesia-Response-Simulator, commit 0f0d1f9, MIT licence). This patient answers without dead time. The bis
is measured without noise, with its derivatives.

Task: from a light sedation to 50 within some minutes, to 40 for the incision, and to 45; a dose every 5 s, at most 400
mg/min. Errors count from 5 min on:

    rms error, seed 0          bis [1]
    CTC                           0.14
    CTC+FPI                      0.013
    CTC+FPI, fractional         0.0076
    CTC+FPI, model-referenced     0.02
    RHC                           0.36
    RHC consistent               0.085
    RHC+FPI, model-referenced   0.0078
    RHC+FPI                     0.0087
    RHC exact model              0.001

The outputs and their derivatives are measured, and the model's curve only says which dose they need. A deformation of an
output that the wrong model computes would chase the wrong number.

Rows without a word have the plain form, as published, the others the same map in the model-referenced form. With a plan
model-referenced is as good. With computed torque the plain form is right: the gain is large, the plant answers with
half to two thirds of what its model expects, and a model-referenced form passes every change of the desired bis'' with
this wrong gain.

The law of fractional order lets the error decay as a Mittag-Leffler function of order .7, at first faster than an exponential.

Where a plan starts decides here. At the measured concentrations the wrong curve gives another bis and another bis'. A plan
that only holds the distance of the bis misses its motion within the horizon (RHC). "RHC consistent" starts at the
concentrations at which the model has the measured bis and bis', as plans behind a deformation always do.
"""

from pathlib import Path

import casadi as ca
import pandas as pd

import fpirhc as fp

AGE, WEIGHT, HEIGHT = 61.0, 77.0, 175.0  # years, kg, cm; a man
LEAN = 1.1 * WEIGHT - 128.0 * (WEIGHT / HEIGHT) ** 2  # kg
V1, V2, V3 = 4.27, 18.9 - 0.391 * (AGE - 53.0), 238.0  # l
CLEARANCE = 1.89 + 0.0456 * (WEIGHT - 77.0) - 0.0681 * (LEAN - 59.0) + 0.0264 * (HEIGHT - 177.0)  # l/min
FAST, SLOW = 1.29 - 0.024 * (AGE - 53.0), 0.836  # l/min, to the two tissues


def rates(x, u, p):
    return {
        "C1": (-(CLEARANCE + FAST + SLOW) * x.C1 + FAST * x.C2 + SLOW * x.C3 + u.infusion) / V1,
        "C2": FAST / V2 * (x.C1 - x.C2),
        "C3": SLOW / V3 * (x.C1 - x.C3),
        "Ce": p.ke0 * (x.C1 - x.Ce),
    }


def bis(x, p):
    effect = (x.Ce / p.C50) ** p.steepness
    return p.E0 / (1 + effect)


plant = fp.Plant.of_states(
    states={"C1": "mg/l", "C2": "mg/l", "C3": "mg/l", "Ce": "mg/l"},
    inputs={"infusion": "mg/min"},
    rates=rates,
    outputs={"bis": fp.Output("1", bis)},
    time_unit="min",
    parameters={
        "ke0": fp.Parameter(approximate=0.309, exact=0.1898, unit="1/min", bounds=(0.01, 10.0)),
        "E0": fp.Parameter(approximate=92.0, exact=92.96, unit="1", bounds=(50.0, 100.0)),
        "C50": fp.Parameter(approximate=4.53, exact=4.138, unit="mg/l", bounds=(0.5, 20.0)),
        "steepness": fp.Parameter(approximate=1.57, exact=1.358, unit="1", bounds=(0.5, 10.0)),
    },
)


def step(t, at, size, width):
    """A smooth step; `width` is its duration in min."""
    return size / (1 + ca.exp(-(t - at) / (width / 8)))


start = {"C1": 2.0, "C2": 0.6, "C3": 0.1, "Ce": 1.5}  # light sedation
FIRST = 92.96 / (1 + (1.5 / 4.138) ** 1.358)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(
        lambda t: {
            "bis": 50 + (FIRST - 50) * (1 + t / 1.5) * ca.exp(-t / 1.5) + step(t, 25, -10, 4) + step(t, 42, 5, 16)
        }
    ),
    start=start,
    period=1 / 12,  # min
    duration=60.0,  # min
    limits=fp.Limits(inputs={"infusion": (0.0, 400.0)}),  # mg/min
    horizon=fp.Horizon(stages=20, step=0.25),  # min
    cost=fp.Quadratic(outputs={"bis": 1.0, "bis'": 0.1}, rate={"infusion": 1e-5}),
    measure_from=5.0,  # min
)

tracking = fp.Exponential(rate=1.5)  # 1/min
optimiser = fp.FixedPointSolver()
sigmoid = fp.Sigmoid(gain=-4.0, shift=0.3, scale=20.0)  # scale in 1/min^2

controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, sigmoid),
    "CTC+FPI, fractional": fp.ComputedTorque(fp.Fractional(rate=1.5, order=0.7), sigmoid),
    "CTC+FPI, model-referenced": fp.ComputedTorque(tracking, fp.ModelReferenced(sigmoid)),
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC consistent": fp.RecedingHorizon(optimiser, consistent=True),
    "RHC+FPI, model-referenced": fp.RecedingHorizon(optimiser, fp.ModelReferenced(sigmoid)),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),
    "RHC exact model": fp.ExactModel(fp.RecedingHorizon(optimiser)),
}
headline = ("CTC", "CTC+FPI")
why = (
    "Only the curve from drug to bis is wrong, and the iteration corrects the measured "
    "bis'' at whatever slope; ADRC believes in one slope."
)
tuning = {
    "CTC": {"tracking.rate": fp.LogSpan(0.5, 5.0)},  # 1/min
    "CTC+FPI": {"tracking.rate": fp.LogSpan(0.5, 5.0), "deformation.gain": fp.LogSpan(-6.0, -0.5)},
}
# The curves of 44 patients, with this man's kinetics.
patients = pd.read_csv(Path(__file__).with_name("anaesthesia_patients.csv"), comment="#", index_col="case")
cases = fp.Cases(patients.to_dict("index"))
