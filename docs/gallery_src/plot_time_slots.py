"""
One input, two coordinates: time slots
======================================

A crane's cart is pushed by one force, and cart and load cannot both be prescribed at
once. Time slots take turns: for a while the cart follows its reference and the load
swings freely, then the load is damped and the cart drifts. Neither slot alone is
asymptotically stable; their alternation is. Slots
need no optimiser; where there is one, a receding horizon with both coordinates in its
cost is faster on this plant.
"""

import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp

task = fp.load_problem("crane_slots")
controller = task.controllers["slots+FPI"]

# %%
# The run. Grey: the slots of the cart.

run = fp.simulate(task.problem, controller, seed=0)
figure, axes = plt.subplots(2, 1, figsize=(8, 4), sharex=True, layout="constrained")
active = run["slot"].ravel()
for axis, name in zip(axes, ("cart [m]", "angle [rad]"), strict=True):
    axis.plot(run.time, run[f"error.{name.split()[0]}"], lw=1)
    axis.set(ylabel=f"error of {name}")
    axis.fill_between(
        run.time,
        0,
        1,
        where=active == 0,
        color="0.9",
        transform=axis.get_xaxis_transform(),
        lw=0,
    )
axes[-1].set(xlabel="time [s]")
print("largest error in the last second:", np.abs(run["error"][-100:]).max(axis=0))
