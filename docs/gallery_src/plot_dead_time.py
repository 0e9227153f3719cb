"""
Dead time
=========

A response that is seen d cycles late belongs to a request of d cycles ago. A
deformation that compares it with the newest request all the same has a stability limit
of 2 sin(π / (2 (2 d + 1))); one that remembers its requests keeps the limit of 2.
Tracking is another matter: the feedback is late too, and a controller that predicts the
state at which its command will act helps that.
"""

import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp
from fpirhc.contraction.delayed import largest_gain

delays = np.arange(0, 13)
map, same = fp.Affine(gain=-0.5), np.eye(1)
late = [[np.append(np.zeros(d), 1.0)] for d in delays]
unpaired = [largest_gain(map, same, seen) for seen in late]
paired = [
    largest_gain(fp.Paired(map, cycles=d), same, late[d]) for d in delays.tolist()
]

figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
axis.plot(delays, unpaired, "o", label="unpaired")
axis.plot(
    delays,
    2 * np.sin(np.pi / (2 * (2 * delays + 1))),
    lw=0.8,
    label="2 sin(π / (2 (2 d + 1)))",
)
axis.plot(delays, paired, "s", ms=4, label="paired")
axis.set(xlabel="dead time [cycles]", ylabel="largest effective gain")
axis.legend()

# %%
# The same on a mass with a late actuator, at rate × dead time = 0.36.

task = fp.load_problem("delayed_mass")
figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
for name in ("RHC", "RHC+FPI"):
    run = fp.simulate(task.problem, task.controllers[name], seed=0)
    axis.plot(run.time, run["true_error.q"], lw=1, label=name)
axis.set(xlabel="time [s]", ylabel="true error [m]")
axis.legend()
