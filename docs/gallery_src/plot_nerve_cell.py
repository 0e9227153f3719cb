"""
A nerve cell, by a model without ion channels
=============================================

Hodgkin and Huxley's membrane fires when its voltage is raised. A controller that knows
the membrane's leak and nothing else is to move the voltage along a wave that would make
the cell fire, and then to keep the cell silent under a current of which it is not told.
The unit of time is the millisecond.
"""

import matplotlib.pyplot as plt

import fpirhc as fp

task = fp.load_problem("hodgkin_huxley")
runs = {
    name: fp.simulate(task.problem, task.controllers[name], seed=0)
    for name in ("CTC", "RHC", "RHC+FPI, model-referenced", "RHC offset-free")
}
for name, run in runs.items():
    print(name, f"{fp.measure(task.problem, run).rms_error['V']:.3g} mV")

# %%
# Without adaptation the channels win: the cell fires against its controller. The
# offset-free plan is better than the iteration by a fifth: its filter measures the
# response too, and has a gain of one.

signals, portrait = task.pictures
signals.draw(plt.figure(figsize=(8, 5), layout="constrained"), runs)
portrait.draw(plt.figure(figsize=(8, 3), layout="constrained"), runs)

# %%
# Under 10 uA/cm² and no control it fires 68 times a second. Any correction silences
# it; an integral is enough. The controller that knows every channel but not the current
# is the one that is furthest off.

silent = fp.load_problem("hodgkin_huxley_silent")
for name in (*runs, "RHC exact model"):
    run = fp.simulate(silent.problem, silent.controllers[name], seed=0)
    error = fp.measure(silent.problem, run).rms_error["V"]
    print(f"{name:25s} {error:.2g} mV, highest {run['state.V'].max():.1f} mV")
