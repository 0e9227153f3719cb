"""
When FPI fails, and how to see it before
========================================

Seven ways to lose, each with what the tools say about it. All start from the same mass
on a spring, whose model is too heavy by half. That is far enough for the plain,
published form with a large gain; the first way shows where it is not.
"""

import textwrap
import warnings
from dataclasses import replace

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp

plant = fp.Plant(
    coordinates={"q": "m"},
    inputs={"u": "N"},
    order=2,
    response=lambda q, v, u, p: {"q": (u.u - p.stiffness * q.q) / p.mass},
    parameters={
        "mass": fp.Parameter(approximate=1.5, exact=1.0, unit="kg"),
        "stiffness": fp.Parameter(approximate=5.0, exact=20.0, unit="N/m"),
    },
)
problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(3 * t)}),
    start={"q": 0.0, "q'": 1.5},
    period=2e-3,
    duration=4.0,
    limits=fp.Limits(inputs={"u": (-60.0, 60.0)}),
    measure_from=1.0,
)
tracking = fp.Exponential(rate=6.0)
good = fp.ComputedTorque(tracking, fp.Sigmoid(gain=-1.0, scale=5.0))


def error(problem, controller):
    """Rms error from 1 s on, mm."""
    run = fp.simulate(problem, controller, seed=0)
    return 1e3 * fp.measure(problem, run).rms_error["q"]


without = error(problem, fp.ComputedTorque(tracking))
print(f"without {without:.1f} mm, with FPI {error(problem, good):.3f} mm")

# %%
# 1. A cautious gain around a good model
# --------------------------------------
# The plain form passes every change of the desired response 1 / a cycles late. With a
# model that is nearly right this is worse than no adaptation, and a smaller gain is worse
# still. The model-referenced form changes nothing where the model is right.

nearly = {
    name: fp.Parameter(approximate=0.98 * p.exact, exact=p.exact, unit=p.unit)
    for name, p in plant.parameters.items()
}
right = replace(problem, plant=replace(plant, parameters=nearly))
print(f"without {error(right, fp.ComputedTorque(tracking)):.2f} mm")
for gain in (-1.0, -0.1, -0.05):
    map_ = fp.Sigmoid(gain=gain, scale=5.0)
    both = (
        fp.ComputedTorque(tracking, form) for form in (map_, fp.ModelReferenced(map_))
    )
    plain, referenced = (error(right, controller) for controller in both)
    print(f"gain {gain}: plain {plain:.2f} mm, model-referenced {referenced:.2f} mm")

# %%
# A stepper of a real plant warns of such a controller before it runs.

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    fp.Stepper(right, fp.ComputedTorque(tracking, map_))
print(textwrap.fill(str(caught[0].message).partition(". ")[0], 85))

# %%
# 2. The sign is wrong
# --------------------
# If the model has the sign of the input's effect wrong, every cycle enlarges the error.
# It is refused before the run.

try:
    fp.simulate(
        problem, fp.ComputedTorque(tracking, fp.Sigmoid(gain=1.0, scale=5.0)), seed=0
    )
except fp.FpirhcError as reason:
    print(textwrap.fill(str(reason), 85))

# %%
# 3. The gain is too large
# ------------------------
# Beyond the limit the loop chatters, bounded by the saturation of the map. It is refused
# before the run; `fpirhc review` asks the loop with half and twice the gain, too.

large = fp.ComputedTorque(tracking, fp.Sigmoid(gain=-4.0, scale=5.0))
try:
    fp.simulate(problem, large, seed=0)
except fp.FpirhcError as reason:
    print(textwrap.fill(str(reason), 85))
[answer] = [
    a
    for a in fp.review(problem, {"good": good}, mismatch=0.0, seed=0).answers["good"]
    if a.key == "gain"
]
print(textwrap.fill(f"{answer.verdict}: {answer.evidence}", 85))

# %%
# 4. The map cannot keep up
# -------------------------
# The step of eq (6) is at most a multiple of its scale S per cycle. With a small S it
# is slower than the task.

for scale in (5.0, 0.05, 0.005):
    slow = fp.ComputedTorque(tracking, fp.Sigmoid(gain=-1.0, scale=scale))
    print(f"S = {scale:g}: {error(problem, slow):.3g} mm")

# %%
# 5. The response comes late
# --------------------------
# Ten cycles of dead time that nobody told the deformation about. Told, it is stable;
# the tracking still pays for the delay.

late = replace(problem, dead_time=fp.DeadTime(inputs={"u": 20e-3}))
runs = {
    "not told": fp.simulate(late, good, seed=0),
    "Paired": fp.simulate(
        late,
        fp.ComputedTorque(tracking, fp.Paired(good.deformation, cycles=10)),
        seed=0,
    ),
    "Increment, predicted": fp.simulate(
        late,
        fp.Predicted(
            fp.ComputedTorque(tracking, fp.Increment(good.deformation, cycles=10)),
            inputs=20e-3,
        ),
        seed=0,
    ),
}
figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
for name, run in runs.items():
    axis.plot(run.time, 1e3 * run["true_error.q"], lw=1, label=name)
axis.set(xlabel="time [s]", ylabel="true error [mm]")
axis.legend()

# %%
# 6. The disturbance is out of reach
# ----------------------------------
# A deformation corrects the response that the input acts on, and nothing else. A leak
# in the second of two tanks, while the pump fills the first, needs an estimator of
# disturbances: the better choice there is offset-free control.

tanks = fp.load_problem("leaking_tanks")
for name, controller in tanks.controllers.items():
    run = fp.simulate(tanks.problem, controller, seed=0)
    level = fp.measure(tanks.problem, run).rms_error["h2"]
    print(f"{name:20s} {1e3 * level:.2f} mm")

# %%
# 7. The measurement is noise
# ---------------------------
# Noise of the response goes through: with deviation one it becomes the square root of a
# / (2 - a) in the request. Tracking hardly notices, the actuator does.

rough = fp.Sensing({"q''": fp.Sensor(noise=fp.Noise(5.0))})
for gain in (-0.25, -1.0, -2.0):
    controller = fp.ComputedTorque(tracking, fp.Sigmoid(gain=gain, scale=50.0))
    run = fp.simulate(replace(problem, sensing=rough), controller, seed=0)
    jumps = np.diff(run["command.u"][500:]).std()
    print(f"gain {gain}: jumps of the force {jumps:.2f} N per cycle")
