"""
A house heated where power is cheap
===================================

A heat pump, a price that changes by the hour, and people who are at home in the morning
and in the evening. A plan of a day knows price and weather; it does not know the house.
"""

import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp

task = fp.load_problem("building")
problem = task.problem
runs = {n: fp.simulate(problem, c, seed=0) for n, c in task.controllers.items()}
names = ("total", "bill", "outside", "hours_outside")
for name, run in runs.items():
    found = fp.measure(problem, run, task.metrics)
    print(f"{name:16s}", *(f"{found[one]['']:7.3g}" for one in names))

# %%
# Columns: bill and discomfort, the bill (both in EUR), K h outside the band, and hours
# outside it by 0.2 K. A thermostat is the warmest and the dearest. Every plan heats at
# noon, when power is cheap, for the evening, when it is not.

figure, (rooms, heats, prices) = plt.subplots(
    3, 1, sharex=True, figsize=(8, 6), layout="constrained"
)
for name in ("PI", "RHC", "RHC+FPI", "RHC offset-free"):
    run = runs[name]
    rooms.plot(run.time, run["plant_state.room"], lw=1, label=name)
    heats.step(run.time, run["command.heat"], lw=1, where="post")
run = runs["RHC"]
rooms.plot(run.time, run["reference.room"], "k--", lw=1, label="thermostat")
signals = {n: one.values for n, one in problem.signals.items()}
prices.plot(run.time, np.array([float(signals["price"](t)) for t in run.time]))
rooms.set(ylabel="room [degC]", xlim=(72, 96), ylim=(16, 27))
rooms.legend(ncol=3)
heats.set(ylabel="heat [kW]")
prices.set(ylabel="price [EUR/kWh]", xlabel="time [h]")

# %%
# The plan of the wrong house is too cold when people come home. The iteration holds the
# room on the way that the plan foresees, and that is nearly all that can be had. The
# offset-free plan is a little better: its filter tells a plan of a day what the house
# loses, so it begins to heat earlier.
