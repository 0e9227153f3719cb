"""
A jet engine flown by another engine's model
============================================

The JetCat P220 gives a third more thrust than its smaller sister P100 at the same
throttle. Both have published models; the controller has the wrong one.
"""

import matplotlib.pyplot as plt

import fpirhc as fp


def results(name, names):
    """Runs by controller; prints the rms error of the thrust from 20 s on."""
    task = fp.load_problem(name)
    runs = {c: fp.simulate(task.problem, task.controllers[c], seed=0) for c in names}
    for controller, run in runs.items():
        error = fp.measure(task.problem, run).rms_error["T"]
        print(f"{name:14s} {controller:33s} {error:.2g} N")
    return task, runs


# %%
# The deformation and the estimate of the offset-free plan correct every 10 ms, the plan
# is renewed every 100 ms. The plain form of the deformation, "RHC+FPI", has an eighth of
# the offset-free plan's error, the model-referenced form a hundredth: a plan foresees a
# constant disturbance, and the model's error follows the thrust.

names = ("RHC", "RHC+FPI, model-referenced", "RHC+FPI", "RHC offset-free")
task, runs = results("turbojet", (*names, "RHC exact model"))
thrust, loop = task.pictures
thrust.draw(plt.figure(figsize=(8, 5), layout="constrained"), runs)

# %%
# Thrust over throttle: the wrong model reaches other values on the way up and down.

loop.draw(
    plt.figure(figsize=(8, 3), layout="constrained"),
    {name: runs[name] for name in loop.controllers},
)

# %%
# With a cycle as long as a stage of the plan, 100 ms, the offset-free plan leaves two
# thirds of the plain form's error, and the model-referenced form less than a tenth of
# either. In the plain form a gain that is slower than the
# plan is worse than none; in the model-referenced form it is not.

gentle = ("RHC+FPI, gentle, model-referenced", "RHC+FPI, gentle")
task, runs = results("turbojet_slow", (*names, *gentle))
