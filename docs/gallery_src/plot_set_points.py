"""
Set-points while it runs
========================

Nobody knew the steps before: at 1 s and at 2 s somebody moves both set-points by 0.2 m. A
filter of the plant's order makes a motion of each step, so that velocity and acceleration
belong to the position. The filter is a part of the controller, and the horizon sees its
free motion with the set-point held.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp

task = fp.load_problem("two_mass")
steps = {
    "q1": [(0.0, 2.2), (1.0, 2.4), (2.0, 2.2)],  # (s, m)
    "q2": [(0.0, 5.4), (1.0, 5.6), (2.0, 5.4)],
}
problem = replace(
    task.problem,
    reference=fp.Setpoint(steps, rate=6.0),  # 1/s
    duration=3.0,  # s
    measure_from=0.5,  # s
)
runs = {
    name: fp.simulate(problem, task.controllers[name], seed=0)
    for name in ("RHC", "RHC+FPI")
}

figure, axes = plt.subplots(3, 1, figsize=(8, 7), sharex=True, layout="constrained")
first = runs["RHC"]
axes[0].plot(first.time, first["setpoint.q1"], "k:", lw=1, label="set-point")
axes[0].plot(first.time, first["reference.q1"], "k--", lw=1, label="reference")
for name, run in runs.items():
    axes[0].plot(run.time, run["state.q1"], lw=1, label=name)
    axes[1].plot(run.time, 1e3 * run["error.q1"], lw=1, label=name)
    axes[2].plot(run.time, run["command.Q1"], lw=1, label=name)
axes[0].set(ylabel="q1 [m]")
axes[1].set(ylabel="error of q1 [mm]")
axes[2].set(ylabel="Q1 [N]", xlabel="time [s]")
axes[0].legend()

# %%
# The filter of the plant's order lets the acceleration jump by rate² times the step, and
# the command with it. One order more is slower by a moment, and smooth. Other set-points
# are data: these runs share one compiled loop, and the second one follows a function of
# time that the filter smooths and delays.

smooth = replace(problem, reference=fp.Setpoint(steps, rate=6.0, order=3))
ready = fp.simulator(smooth, task.controllers["RHC+FPI"])
wandering = {"q1": lambda t: 2.2 + 0.2 * np.sign(np.sin(7 * t * t))}
figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
for label, run in (
    ("order 2", runs["RHC+FPI"]),
    ("order 3", ready.run(seed=0)),
    ("order 3, other set-points", ready.run(seed=0, setpoints=wandering)),
):
    jump = np.abs(np.diff(run["command.Q1"][900:])).max()
    axes[0].plot(run.time, run["state.q1"], lw=1, label=label)
    axes[1].plot(
        run.time,
        run["command.Q1"],
        lw=1,
        label=f"{label}: {jump:.2g} N per cycle at most",
    )
axes[0].set(ylabel="q1 [m]")
axes[1].set(ylabel="Q1 [N]", xlabel="time [s]")
axes[1].legend(loc="lower left")

# %%
# Where the future is known, `announced=True` gives it to the horizon, node by node: the
# plan begins to move before the step, as it does along a trajectory.

known = replace(problem, reference=fp.Setpoint(steps, rate=6.0, announced=True))
run = fp.simulate(known, task.controllers["RHC+FPI"], seed=0)
figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
for label, one in (("unannounced", runs["RHC+FPI"]), ("announced", run)):
    axis.plot(one.time, 1e3 * one["error.q1"], lw=1, label=label)
axis.set(
    xlabel="time [s]", ylabel="error of q1 [mm]", xlim=(0.7, 1.6), ylim=(-0.6, 0.6)
)
axis.legend()
