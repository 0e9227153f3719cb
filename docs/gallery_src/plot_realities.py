"""
A rigid model and realities that are not
========================================

The model is a mass of 1.5 kg, u = m x''. What moves is a mass of 1 kg behind an actuator with a lag,
behind a spring, on bristles, or seen by a slow sensor. Where does each form of the iteration help,
and what did the review say before? Runs and reviews take some minutes, so their numbers are kept in a file,
which ``python plot_realities.py --renew`` in its folder writes anew. How a reality is written, also one with other states
than the model, is in `docs/extending/reality.md`.
"""

import json
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp

mass = {"m": fp.Parameter(approximate=1.5, exact=1.0, unit="kg")}
model = fp.Plant({"x": "m"}, {"u": "N"}, mass, lambda q, v, u, p: {"x": u.u / p.m})


def lag(tau):
    """m x'' = F, tau F' = u - F."""
    return fp.Plant(
        {"x": "m", "F": "N"},
        {"u": "N"},
        mass,
        lambda q, v, u, p: {"x": q.F / p.m, "F": (u.u - q.F) / tau},
        order={"x": 2, "F": 1},
    )


def spring(frequency, damping):
    """A motor of 0.3 kg and a load of 0.7 kg; the load is seen, the motor is driven."""
    load, motor = 0.7, 0.3
    k = frequency**2 * load * motor
    d = 2 * damping * frequency * load * motor

    def response(q, v, u, p):
        force = k * (q.motor - q.x) + d * (v.motor - v.x)
        return {"x": force / load / p.m, "motor": (u.u - force) / motor / p.m}

    return fp.Plant({"x": "m", "motor": "m"}, {"u": "N"}, mass, response)


def bristles(q, v, u, p):
    """LuGre friction of 1 to 1.5 N on bristles of 1e4 N/m."""
    slip = 1 + 0.5 * ca.exp(-((v.x / 1e-3) ** 2))
    bend = v.x - 1e4 * ca.fabs(v.x) * q.z / slip
    return {"x": (u.u - 1e4 * q.z - 100 * bend) / p.m, "z": bend}


friction = fp.Plant(
    {"x": "m", "z": "m"}, {"u": "N"}, mass, bristles, order={"x": 2, "z": 1}
)


def sensor(tau):
    """tau s' = x - s, and s is measured."""
    return fp.Plant(
        {"x": "m", "s": "m"},
        {"u": "N"},
        mass,
        lambda q, v, u, p: {"x": u.u / p.m, "s": (q.x - q.s) / tau},
        order={"x": 2, "s": 1},
    )


fine = fp.RungeKutta4(substeps=4)
realities = {
    "model's own": None,
    **{
        f"actuator {1e3 * tau:g} ms": fp.Reality(lag(tau), start={"F": 0.0}, integrator=fine)
        for tau in (1e-3, 3e-3, 1e-2, 2e-2, 3e-2)
    },
    **{
        f"spring, damping {damping:g}": fp.Reality(
            spring(300.0, damping), start={"motor": 0.0, "motor'": 0.3}, integrator=fine
        )
        for damping in (0.05, 0.2, 0.8)
    },
    "bristles": fp.Reality(friction, start={"z": 1e-4}, integrator=fine),
    "sensor 3 ms": fp.Reality(sensor(3e-3), {"s": 0.0}, fine, {"x": "s"}),
    "sensor 30 ms": fp.Reality(sensor(3e-2), {"s": 0.0}, fine, {"x": "s"}),
}

problem = fp.Problem(
    plant=model,
    reference=fp.Trajectory(lambda t: {"x": 0.1 * ca.sin(3 * t)}),
    start={"x": 0.0, "x'": 0.3},
    period=1e-3,
    duration=3.0,
    measure_from=1.5,
    limits=fp.Limits(inputs={"u": (-30.0, 30.0)}),
    horizon=fp.Horizon(stages=20, step=1e-2),
    cost=fp.Quadratic(states={"x": 1e3, "x'": 1.0}, deviation={"u": 1e-3}),
)

# %%
# Every form has the same gain. A tracking law with three poles at 6 per second stands
# beside the horizon, because its rules are known in closed form.

optimiser, map_ = (
    fp.FixedPoint(iterations=1, tolerance=1e-2),
    fp.Sigmoid(gain=-0.5, scale=50.0),
)
forms = {
    "none": fp.Identity(),
    "plain": map_,
    "increment": fp.Increment(map_, cycles=0),
    "model-referenced": fp.ModelReferenced(map_),
}
controllers = {
    **{
        f"RHC, {name}": fp.RecedingHorizon(optimiser, one)
        for name, one in forms.items()
    },
    **{
        f"CTC, {name}": fp.ComputedTorque(fp.Exponential(rate=6.0), one)
        for name, one in forms.items()
    },
}


def row(reality):
    """Rms error in mm of every controller; infinite where the run ended early."""
    real = replace(problem, reality=reality)
    runs = (
        fp.simulate(real, one, seed=0, compiled=False) for one in controllers.values()
    )
    return [
        np.inf if run.stop else 1e3 * fp.measure(real, run).rms_error["x"]
        for run in runs
    ]


QUESTIONS = "reality converge?", "lag of the reality", "resonance"


def answers(reality):
    """What the review says of the reality, by controller: verdict, question, evidence."""
    real = replace(problem, reality=reality)
    adaptive = {n: c for n, c in controllers.items() if "none" not in n}
    review = fp.review(real, adaptive, mismatch=0.0, seed=0)
    return {
        name: [
            (str(a.verdict), a.question, a.evidence)
            for a in found
            if any(words in a.question for words in QUESTIONS)
        ]
        for name, found in review.controllers.items()
    }


file = Path("kept") / "realities.json"
if "--renew" in sys.argv:
    found = {
        "errors": {name: row(reality) for name, reality in realities.items()},
        "answers": {n: answers(r) for n, r in realities.items() if r is not None},
    }
    file.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
kept = json.loads(file.read_text(encoding="utf-8"))
errors, reviews = np.array(list(kept["errors"].values())), kept["answers"]
laws, size = ("RHC", "CTC"), len(forms)
print("rms error of x, mm" + " " * 6 + "".join(f"{law:<{11 * size}s}" for law in laws))
print(
    " " * 24 + "".join(f"{form.removeprefix('model-'):<11s}" for form in [*forms] * 2)
)
for name, numbers in zip(realities, errors, strict=True):
    print(f"{name:24s}" + "".join(f"{value:<11.3g}" for value in numbers))

# %%
# What the review says, before any of these runs: its loop is that of the real pair, linear
# along the reference. A cell has the factor by which the form made the error of the run
# smaller, and the review's answer to "Does the loop with the reality converge?".

agree = []
print(" " * 24 + "".join(f"{law:<{13 * (size - 1)}s}" for law in laws))
print(
    " " * 24
    + "".join(f"{form.removeprefix('model-'):<13s}" for form in [*forms][1:] * 2)
)
for name, numbers in zip(realities, errors, strict=True):
    if name not in reviews:
        continue
    cells = []
    without = dict(zip(laws, numbers[::size], strict=True))
    for one, error in zip(controllers, numbers, strict=True):
        if one in reviews[name]:
            [verdict] = [
                v for v, question, _ in reviews[name][one] if "converge?" in question
            ]
            factor = without[one[:3]] / error
            cells.append(f"{f'{factor:.3g} {verdict}':<13s}")
            agree.append((factor > 1) == (verdict == "yes"))
    print(f"{name:24s}" + "".join(cells))
print(f"The answer was right in {sum(agree)} of {len(agree)} cases.")

# %%
# The forms help behind every lag that is short beside the law, behind bristles, and
# behind a well damped spring. Behind a spring with little damping they lose. Behind
# 30 ms the plan, which is faster than the law, loses with every form. A slow sensor shows
# a delayed motion: about 0.3 m/s times the sensor's lag, over the square root of two in the
# rms, is the delay itself, which no adaptation of the model removes.
#
# Two rules say where a law with equal poles stops, and by how much: one for the lag, one
# for the resonance; "caution" is a loop that converges with less damping than 0.3. They are
# shown for the increment form. A plan counts as one of every cycle
# in the review; here it is made in every tenth. `fpirhc review my_problem.py` asks all of this
# about a problem of your own.

for name, found in reviews.items():
    for verdict, question, evidence in found["CTC, increment"]:
        if "converge?" not in question:
            print(f"{name}: {verdict}. {question}")
            print(textwrap.indent(textwrap.fill(evidence, 80), "    "))

# %%
# The picture: how many times smaller the error becomes by adaptation.

figure, axis = plt.subplots(figsize=(9, 4), layout="constrained")
places = np.arange(len(realities))
for k, (name, column) in enumerate(list(zip(controllers, errors.T, strict=True))[1:4]):
    axis.bar(places + 0.25 * (k - 1), errors[:, 0] / column, 0.25, label=name)
axis.axhline(1, color="k", lw=0.8)
axis.set(yscale="log", ylabel="error without / with adaptation", xticks=places)
axis.set_xticklabels(list(realities), rotation=30, ha="right")
axis.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1))
