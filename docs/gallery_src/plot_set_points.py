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
# are data: the last two runs share one compiled loop, and the second of them is given a
# function of time, which the filter smooths and delays.

smooth = replace(problem, reference=fp.Setpoint(steps, rate=6.0, order=3))
ready = fp.simulator(smooth, task.controllers["RHC+FPI"])
swinging = {"q1": lambda t: 2.3 - 0.1 * np.cos(4 * t)}
figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
for label, run in (
    ("order 2", runs["RHC+FPI"]),
    ("order 3", ready.run(seed=0)),
    ("order 3, other set-points", ready.run(seed=0, setpoints=swinging)),
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
axes[1].set(ylabel="Q1 [N]", xlabel="time [s]", ylim=(-28, 5))
axes[1].legend(loc="lower left")

# %%
# Where the future is known, `announced=True` gives it to the horizon, node by node. Above
# it would gain nothing, because the filtered step is a motion that the actuators can
# follow without notice. With a filter of 20 1/s and inputs of at most 40 N they cannot:
# the plan that knows the step begins to move before it.

weak = fp.Limits(inputs={"Q1": (-40.0, 40.0), "Q2": (-40.0, 40.0)})  # N
figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
for label, announced in (("unannounced", False), ("announced", True)):
    fast = fp.Setpoint(steps, rate=20.0, announced=announced)
    known = replace(problem, reference=fast, limits=weak, duration=1.5)
    run = fp.simulate(known, task.controllers["RHC+FPI"], seed=0)
    axes[0].plot(run.time, 1e3 * run["error.q1"], lw=1, label=label)
    axes[1].plot(run.time, run["command.Q1"], lw=1, label=label)
axes[0].set(ylabel="error of q1 [mm]", xlim=(0.8, 1.5))
axes[1].set(ylabel="Q1 [N]", xlabel="time [s]")
axes[0].legend()
