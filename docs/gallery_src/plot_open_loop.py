"""
One horizon, solved and certified
=================================

The fixed-point iteration also plans: the request is the plan, its response error the
gradient of the cost, preconditioned by a Riccati sweep. Every plan comes with its
projected stationarity, and `fpirhc solve` adds a contraction factor and bounds of the
error.
"""

import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe

task = fp.load_problem("cart_pole")
problem = task.problem
ocp = transcribe(
    problem.plant, problem.reference, problem.horizon, problem.cost, problem.limits
)
data = stage_data(problem.plant, problem.reference, problem.horizon, problem.cost)(
    0.0, problem.plant.approximate
).full()

plans = {}
for name, optimiser in {
    "FixedPoint": fp.FixedPoint(iterations=1, tolerance=1e-6),
    "IPOPT": fp.Ipopt(),
}.items():
    plans[name] = fp.solve(ocp, optimiser, problem.start_state, data)
    found = plans[name]
    print(name, f"cost {found.cost:.6f}, stationarity {found.stationarity:.1e} N")

# %%
# The same plan from both; at the start the force is at its limit.

figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
times = problem.horizon.step * np.arange(problem.horizon.stages)
axis.step(
    times, plans["IPOPT"].inputs[0], where="post", lw=4, color="0.8", label="IPOPT"
)
axis.step(
    times, plans["FixedPoint"].inputs[0], where="post", lw=1.2, label="FixedPoint"
)
axis.set(xlabel="time [s]", ylabel="F [N], relative to the feedforward")
axis.legend()
