"""The van der Pol-Duffing oscillator, planned by four optimisers: fixed-point iteration in place of the reduced gradient.

The optimum of a horizon is a zero of the gradient of its auxiliary function. The rows find it in different ways, to the same
tolerance: by the reduced gradient with a line search; by fixed-point iteration on the scaled gradient; by `FixedPointSolver`, the
same iteration with a Riccati sweep before each step; and by IPOPT. The plans agree, so do the errors. What differs is the
number of steps and the time of a cycle. The iteration around the plan (FPI) is another one: it corrects the model, whoever
plans. Plant and parameters are those of `van_der_pol`; `--plans` certifies the first plan of each.

    rms error, seed 0            q [m]
    RHC                         0.0105
    RHC, reduced gradient       0.0105
    RHC, gradient iteration     0.0105
    RHC, IPOPT                  0.0105
    RHC+FPI                    2.7e-05
    RHC+FPI, reduced gradient  2.7e-05
"""

from dataclasses import replace

import fpirhc as fp

task = fp.load_problem("van_der_pol")
problem = replace(task.problem, duration=4.0, measure_from=2.0)
TOLERANCE = 1e-2  # N, of 15 N

fixed_point = fp.FixedPointSolver(tolerance=TOLERANCE)
reduced_gradient = fp.ReducedGradient(iterations=100, tolerance=TOLERANCE)
sigmoid = task.controllers["RHC+FPI"].deformation

controllers = {
    "RHC": fp.RecedingHorizon(fixed_point),
    "RHC, reduced gradient": fp.RecedingHorizon(reduced_gradient),
    "RHC, gradient iteration": fp.RecedingHorizon(fp.GradientFixedPoint(iterations=500, tolerance=TOLERANCE)),
    "RHC, IPOPT": fp.RecedingHorizon(fp.Ipopt(tolerance=TOLERANCE)),
    "RHC+FPI": fp.RecedingHorizon(fixed_point, sigmoid),
    "RHC+FPI, reduced gradient": fp.RecedingHorizon(reduced_gradient, sigmoid),
}
headline = ("RHC", "RHC+FPI")
why = "Every optimiser finds the same plan, so none wins by its error; `FixedPointSolver` needs fewest steps and least time."
