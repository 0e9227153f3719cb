"""The two masses with two costs that make adaptation harmful.

Plant, parameters and motion are those of `two_mass`. With a cost of absolute effort the optimum of a wrong model trades tracking
against a wrong effort, and FPI realises that plan faithfully. With a stiff cost plans jump, and a map whose scale S is small
changes its request by too little in a cycle to follow them. Errors count from 3 s on:

    rms error, seed 0          q1 [m]    q2 [m]
    RHC                         0.056     0.044
    RHC+FPI                     0.083     0.063
    RHC, stiff                   0.02     0.014
    RHC+FPI, stiff, small S       5.8       2.7
"""

from dataclasses import replace

import fpirhc as fp

task = fp.load_problem("two_mass")
weights = {"q1'": 1.0, "q2'": 1.0}
absolute = fp.Quadratic(states={"q1": 1e2, "q2": 1e2, **weights}, effort={"Q1": 1e-3, "Q2": 1e-3})
stiff = fp.Quadratic(states={"q1": 1e4, "q2": 1e4, **weights}, deviation={"Q1": 1e-3, "Q2": 1e-3})
problem = replace(task.problem, cost=absolute)

optimiser = fp.FixedPointSolver(iterations=1, tolerance=5e-2)  # N
sigmoid = fp.Sigmoid(gain=-0.5, shift=0.3, scale=20.0)  # scale in m/s^2
controllers = {
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),
    "RHC, stiff": fp.RecedingHorizon(optimiser, cost=stiff),
    "RHC+FPI, stiff, small S": fp.RecedingHorizon(optimiser, replace(sigmoid, scale=1.0), cost=stiff),
}
headline = ("RHC", "RHC+FPI")
why = "The plan of a wrong model is realised faithfully, and it is the wrong plan: weigh `deviation` in place of `effort`."
