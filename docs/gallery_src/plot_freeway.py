"""
Emission of a freeway
=====================

METANET, six segments with a ramp, in steps of ten seconds. The emission of all cars is
to follow a reference; the metering rate of the ramp is set once a minute. The model is
a static map with wrong numbers: traffic that settles at once, without waves and without
merging. There is no derivative to prescribe, so the iteration deforms the target.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp

task = fp.load_problem("freeway")
problem, static = task.problem, task.controllers["static map"]


def exact(problem):
    """The problem with the exact numbers in the controller's static map."""
    numbers = {
        name: replace(one, approximate=one.exact)
        for name, one in problem.plant.parameters.items()
    }
    return replace(problem, plant=replace(problem.plant, parameters=numbers))


runs = {
    name: fp.simulate(problem, one, seed=0) for name, one in task.controllers.items()
}
runs["exact static map"] = fp.simulate(exact(problem), static, seed=0)
for name, run in runs.items():
    error = fp.measure(problem, run).rms_error["emission"]
    print(f"{name:18s} {error:.3g} kg/h")

figure, (upper, lower) = plt.subplots(
    2, figsize=(8, 4.5), sharex=True, layout="constrained"
)
for name, run in runs.items():
    upper.plot(run.time, run["output.emission"], lw=1, label=name)
    lower.step(run.time, run["command.r"], lw=1, where="post")
upper.plot(run.time, run["reference.emission"], "k--", lw=0.8, label="reference")
upper.set(ylabel="emission [kg/h]")
upper.legend()
lower.set(xlabel="time [h]", ylabel="metering rate")

# %%
# The wrong map asks for more than the largest rate all the time. The exact one has no
# error once traffic has settled; the mainstream, which nobody knows, makes up most of
# its error. The slope of the wrong map is near that of the exact one, and all that the
# iteration needs of it.

rates = np.linspace(0.0, 0.6, 61)
figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
plant, queue = problem.plant, [50.0]
for name, numbers in (("model", plant.approximate), ("exact", plant.exact)):
    values = [
        float(plant.controlled_response_function(queue, r, numbers)) for r in rates
    ]
    axis.plot(rates, values, label=name)
axis.set(xlabel="metering rate", ylabel="settled emission [kg/h]")
axis.legend()

# %%
# The gain decides how fast, and not whether. Behind the ramp traffic settles in about a
# minute, which is one cycle; so it matters little here whether the shift of the target
# is compared through this lag.

gains = (0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
for name, paired in (
    ("through the lag", fp.ThroughModel(lag=1 / 60)),
    ("last target", None),
):
    errors = []
    for gain in gains:
        cascade = fp.Cascade(static, fp.Affine(gain=-2 * gain), paired)
        run = fp.simulate(problem, cascade, seed=0)
        errors.append(fp.measure(problem, run).rms_error["emission"])
    print(
        f"{name:16s}",
        "  ".join(f"{g:g}: {e:.3g}" for g, e in zip(gains, errors, strict=True)),
    )

# %%
# The metered ramp itself, by its density: with a map as model the controller inverts
# six steps of METANET at once.

task = fp.load_problem("freeway_metering")
figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
for name in ("CTC", "CTC+FPI"):
    run = fp.simulate(task.problem, task.controllers[name], seed=0)
    error = fp.measure(task.problem, run).rms_error["density"]
    print(f"{name:8s} {error:.3g} veh/km per lane")
    axis.step(run.time, run["error.density"], lw=1, where="post", label=name)
axis.set(xlabel="time [h]", ylabel="error of the density [veh/km]")
axis.legend()
