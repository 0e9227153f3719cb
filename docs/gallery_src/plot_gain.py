"""
How large may the gain be?
==========================

The contraction factor follows from the symbols, before anything runs. With gain ratios
between 1.3 and 1.5 (the model's masses over the plant's) every small error dies out up
to the *linear limit*. Eq (6) is steeper on one side than at its fixed point, so large errors die out only up to the *sector limit*.
Between the two lies a range in which a loop that is already quiet stays quiet, and one
that is not may oscillate for ever.
"""

import textwrap

import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp
from fpirhc.contraction.spectrum import assess_gain, jacobians_along

task = fp.load_problem("two_mass")
tracking = fp.Exponential(rate=6.0)
gains = -np.array(
    [0.15, 0.25, 0.5, 1.0, 1.5, 2.0, 2.4, 2.7, 2.8, 2.85, 2.9, 3.0, 3.2, 3.3]
)
errors = []
for gain in gains:
    run = fp.simulate(
        task.problem,
        fp.ComputedTorque(tracking, fp.Sigmoid(gain=gain, shift=0.3, scale=1.0)),
        seed=0,
    )
    settled = slice(3000, None)
    errors.append(
        np.sqrt(np.mean((run["realised"][settled] - run["desired"][settled]) ** 2))
    )

# %%
# The response error falls as one over the gain, down to the sector limit.

plant, rows = task.problem.plant, slice(None, None, 50)
states, exact = run["state"][rows], np.tile(plant.exact, (len(run["state"][rows]), 1))
jacobians = jacobians_along(
    task.problem, states, states, run["deformed"][rows], plant.approximate, exact
)
spectrum = np.linalg.eigvals(jacobians)
report = assess_gain(fp.Sigmoid(gain=-0.5, shift=0.3, scale=1.0), spectrum)
print(textwrap.fill(f"{report.text}. It converges for {report.converging}.", 85))

figure, axis = plt.subplots(figsize=(8, 3.4), layout="constrained")
axis.loglog(-gains, errors, "o-", ms=4)
for limit, name in ((2.82, "sector limit"), (3.36, "linear limit")):
    axis.axvline(limit, ls="--", lw=0.8, color="grey")
    axis.text(limit, max(errors), name, rotation=90, va="top", ha="right", fontsize=8)
axis.set(xlabel="-gain", ylabel="rms response error [m/s²]")
axis.set_xticks([0.2, 0.5, 1, 2, 3], ["0.2", "0.5", "1", "2", "3"])
axis.minorticks_off()
