"""A tumour and its vessels under endostatin: relative order three, with every number of the model wrong.

P. Hahnfeldt, D. Panigrahy, J. Folkman, L. Hlatky, Tumor development under angiogenic signaling, Cancer Research 59, 1999, with the
numbers of mice and endostatin. Volume and capacity of the vessels (mm^3) are written as logarithms s and k; g is the level of the
drug (mg/kg):

    s' = growth (k - s),    k' = birth e^(s - k) - death e^(2 s / 3) - effect g,    g' = dose - clearance g.

In the model all five numbers are wrong by 15 to 30 %.

Task: ln of the volume along 1000 + 1000 (1 + t/10) exp(-t/10) mm^3, with a cycle of 0.05 day and a plan every half day. All states
and the third derivative are measured. Errors count from 16 days on:

    rms error, seed 0          size [ln(mm^3)]
    CTC                                   0.11
    CTC+FPI                              0.014
    RHC                                  0.017
    RHC+FPI, model-referenced          2.5e-06
    RHC+FPI                            0.00022
    RHC offset-free                    0.00015
    RHC exact model                    3.1e-07

A plan with adaptation wins here because it starts where the wrong model has the measured volume and its derivatives: the vessels
and the level of the model are not those of the mouse. `tumour_portions` has the same mouse with few doses, in whole portions.
"""

import math

import casadi as ca

import fpirhc as fp

EXACT = {"growth": 0.192, "birth": 5.85, "death": 0.00873, "effect": 0.66, "clearance": 1.7}
WRONG = {"growth": 1.3, "birth": 0.85, "death": 1.15, "effect": 0.75, "clearance": 1.3}
UNITS = {"growth": "1/day", "birth": "1/day", "death": "1/(day mm^2)", "effect": "kg/mg/day", "clearance": "1/day"}


def rates(x, u, p):
    return {
        "size": p.growth * (x.bed - x.size),
        "bed": p.birth * ca.exp(x.size - x.bed) - p.death * ca.exp(2 * x.size / 3) - p.effect * x.level,
        "level": u.dose - p.clearance * x.level,
    }


plant = fp.Plant.of_states(
    states={"size": "ln(mm^3)", "bed": "ln(mm^3)", "level": "mg/kg"},
    inputs={"dose": "mg/kg/day"},
    rates=rates,
    outputs={"size": fp.Output("ln(mm^3)", lambda x, _: x.size)},
    parameters={n: fp.Parameter(approximate=WRONG[n] * EXACT[n], exact=EXACT[n], unit=UNITS[n]) for n in EXACT},
    time_unit="day",
)


problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"size": ca.log(1000 + 1000 * (1 + t / 10) * ca.exp(-t / 10))}),
    start={"size": math.log(2000), "bed": math.log(2000), "level": 5.0},
    period=0.05,  # day
    duration=40.0,  # days
    measure_from=16.0,  # days
    limits=fp.Limits(inputs={"dose": (0.0, 75.0)}),  # mg/kg/day
    horizon=fp.Horizon(stages=15, step=0.5, discretisation=fp.RungeKutta4(substeps=5)),
    cost=fp.Quadratic(outputs={"size": 1.0, "size'": 0.1}, rate={"dose": 1e-7}),
    input_before={"dose": 10.0},
)
tracking = fp.Exponential(rate=0.5)  # 1/day
plain = fp.RecedingHorizon(fp.FixedPointSolver())
iteration = fp.ModelReferenced(fp.Affine(gain=-1.0))
filter = fp.DisturbanceKalman(drift={"size'''": 1.0}, measured={"size'''": 1e-3})  # 1/day^3.5, 1/day^3
controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, iteration),
    "RHC": plain,
    "RHC+FPI, model-referenced": plain.with_deformation(iteration),
    "RHC+FPI": plain.with_deformation(fp.Affine(gain=-1.0)),
    "RHC offset-free": fp.Estimating(plain, filter, at_once=True),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI, model-referenced")
why = (
    "The plan begins where the wrong model has the measured volume and its derivatives, "
    "and the iteration acts on the third, as PID does."
)
