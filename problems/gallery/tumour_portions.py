"""The same tumour with two doses a day in whole portions: an iteration in the plain form is worse than none.

The mouse, the model and the task are those of `tumour_vessels`. A dose is given every half day, and only as a multiple of 5
mg/kg/day: the reality rounds what it is asked for, and nobody tells the controllers. Errors count from 16 days on:

    rms error, seed 0          size [ln(mm^3)]
    CTC                                    0.1
    RHC                                  0.017
    RHC+FPI, model-referenced            0.003
    RHC+FPI                              0.056

Rounding is not the reason: with any dose the plain form is as bad. More than half of the drug is gone within a cycle. The plain
form needs some cycles to bring a change of the desired response through a wrong model, and the plan changes it again every time:
it triples the error. The model-referenced form passes at once what the model expects, and takes back what the wrong numbers add.
What is left of its error is the rounding's, and it is less than a fifth of that without adaptation.
"""

from dataclasses import replace
from pathlib import Path

import casadi as ca

import fpirhc as fp

often = fp.load_problem(str(Path(__file__).with_name("tumour_vessels.py")))
mouse = often.problem.plant
PORTION = 5.0  # mg/kg/day
FINE = fp.RungeKutta4(substeps=10)


def rounded(x, u, p):
    """The rates with the dose that is really given."""
    given = PORTION * ca.floor(u.dose / PORTION + 0.5)
    return {**mouse.response(x, u, p), "level": given - p.clearance * x.level}


reality = fp.Plant.of_states(
    states=mouse.coordinates,
    inputs=mouse.inputs,
    rates=rounded,
    outputs=mouse.outputs,
    parameters=mouse.parameters,
    time_unit=mouse.time_unit,
)
problem = replace(often.problem, reality=fp.Reality(reality, integrator=FINE), integrator=FINE, period=0.5)  # day
controllers = {name: often.controllers[name] for name in ("CTC", "RHC", "RHC+FPI, model-referenced", "RHC+FPI")}
headline = often.headline
why = (
    "Half of the drug is gone within a cycle: the iteration passes at once what the model "
    "expects, which PID at two doses a day does not know."
)
