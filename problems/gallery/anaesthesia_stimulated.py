"""Depth of anaesthesia under surgical stimulation: a disturbance of the output, which is a part of what is measured and judged.

The patient and the model are those of `anaesthesia`. A stimulation adds to the bis: 8 from 15 min on, 5 from 34 min on, and
0 from 52 min on, over some minutes each. Nobody knows it ahead, and a controller is to hold the bis with it,

    bis = h(Ce, p) + d(t),        bis'' = L^2 h + d''.

Errors count from 5 min on:

    rms error, seed 0          bis [1]
    RHC                           0.65
    RHC+FPI, model-referenced   0.0092
    RHC+FPI                     0.0094
    RHC offset-free              0.011
    RHC exact model               0.31

The exact model does not know the stimulation, so it is no bound here: its plan holds the distance of the bis over the
horizon, and the distance moves. The offset-free horizon has the information and the rate of the deformation: a filter of
all that is measured estimates a disturbance of bis'', which the inverse has in every cycle. Both plans then start where the
model has the measured bis and bis'.
"""

from dataclasses import replace
from pathlib import Path

import casadi as ca

import fpirhc as fp

calm = fp.load_problem(str(Path(__file__).with_name("anaesthesia.py")))


def stimulation(t):
    """Smooth steps of some minutes; t in min."""
    return 8 / (1 + ca.exp(15 - t)) - 3 / (1 + ca.exp(34 - t)) - 5 / (1 + ca.exp(52 - t))


problem = replace(calm.problem, disturbances={"bis": fp.Formula(stimulation)})

states = ("C1", "C2", "C3", "Ce")
estimator = fp.DisturbanceKalman(
    drift={"bis''": 100.0},  # 1/min^2.5
    measured={**dict.fromkeys(states, 1e-3), "bis''": 0.1},  # mg/l, 1/min^2
    noise=dict.fromkeys(states, 1.0),  # mg/l/min: the measured concentrations are trusted, and not the model's
)
controllers = {
    "RHC": calm.controllers["RHC"],
    "RHC+FPI, model-referenced": calm.controllers["RHC+FPI, model-referenced"],
    "RHC+FPI": calm.controllers["RHC+FPI"],
    "RHC offset-free": fp.Estimating(calm.controllers["RHC"], estimator),
    "RHC exact model": calm.controllers["RHC exact model"],
}
headline = ("RHC", "RHC+FPI, model-referenced")
why = "The stimulation is in the measured bis'' at once; the iteration takes it as it is, a filter as far as noise lets it believe."
