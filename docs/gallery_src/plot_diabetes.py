"""
Thirty people and an insulin pump
=================================

A pump gives insulin from the signal of a glucose sensor, and nobody announces a meal. A
dose acts for hours and cannot be taken back, so what counts first is that nobody is below
70 mg/dl for more than 4 % of the time; what is won is the time from 70 to 180 mg/dl.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp

task = fp.load_problem("diabetes")

# %%
# Time in range and time below, over all thirty people and two days each. The table is that
# of the problem file, where a test compares it with its command,
# ``fpirhc compare diabetes --cases all``.

about = task.description


def table(about, first):
    """The rows of a description from the one that begins so to an empty line."""
    return about[about.index(first) :].split("\n\n")[0]


print(table(about, "    shares of the time"))

# %%
# The glucose takes a quarter of an hour to compute, so it is kept in a file in tenths of mg/dl;
# ``python plot_diabetes.py --renew`` in its folder writes it anew. Everybody has the sensor's
# noise of seed 0 here, and of a seed of their own in the table.

file = Path("kept") / "diabetes.npz"


def glucose(controller):
    """Of everybody, a row each."""
    problems = [task.cases.problem(name, task.problem) for name in task.cases.names]
    runs = (fp.simulate(one, controller, seed=0, compiled=False) for one in problems)
    return np.array([10 * run["plant_output.glucose"] for run in runs]).round()


if "--renew" in sys.argv:
    found = {n: glucose(c).astype(np.int16) for n, c in task.controllers.items()}
    np.savez_compressed(file, **found)

people = {name: 0.1 * rows for name, rows in np.load(file).items()}
for name, rows in people.items():
    inside, below = (rows >= 70) & (rows <= 180), rows < 70
    shares = 100 * np.array([inside.mean(axis=1), below.mean(axis=1)])
    print(
        f"{name:24s}{shares[0].mean():3.0f} % in the range, worst {shares[0].min():.0f}; "
        f"below 70 for at most {shares[1].max():.1f} %"
    )

# %%
# A day of these people: the median, the quartiles, 5 to 95 %, and the extremes. A plan knows
# that a dose acts for hours; the PID law has to be gentle for the most sensitive child, and
# leaves everybody high after a meal.

band, grid = task.pictures
times = task.problem.period * np.arange(task.problem.cycles)
days = {
    name: [
        {"up": "glucose [mg/dl]", "across": "t [min]", "times": times, "values": one}
        for one in rows
    ]
    for name, rows in people.items()
}
band.draw_cases(plt.figure(figsize=band.size(len(days)), layout="constrained"), days)

# %%
# The control-variability grid: a point is a person, by the lowest and the highest value.
# To the right is too low, upwards too high; zone A is what is wanted, D and E are dangerous.

extremes = {
    name: [
        {"label": "glucose [mg/dl]", "low": one.min(), "high": one.max()}
        for one in rows
    ]
    for name, rows in people.items()
}
grid.draw_cases(
    plt.figure(figsize=grid.size(len(days)), layout="constrained"), extremes
)

# %%
# What fails, first: to announce the meals. A plan that knows them gives most of the insulin
# before the meal, for the gut of the clinic's model. In ten children the stomach empties
# later, or into another gut, and nothing takes the dose back.

announced = fp.load_problem("diabetes_announced")
print(table(announced.description, "    shares of the time"))

# %%
# Second: an iteration on the derivative that a dose acts on. Five integrators lie between
# the dose and the glucose. With everything given that such a law could ask for, it stands
# at a limit of the pump all day: a meal is in the fifth derivative at once, a dose as well,
# but in the glucose hours later.

five = fp.load_problem("diabetes_order_five")
print(table(five.description, "    shares of the time"))
runs = {
    name: fp.simulate(five.problem, one, seed=0)
    for name, one in five.controllers.items()
}
figure, (upper, lower) = plt.subplots(
    2, 1, sharex=True, figsize=(8, 5), layout="constrained"
)
upper.axhspan(70, 180, color="#009e73", alpha=0.1)
for name, run in runs.items():
    upper.plot(run.time / 60, run["output.glucose"], label=name, lw=1)
    lower.plot(run.time / 60, run["command.extra"], lw=0.7)
upper.set_ylabel("glucose [mg/dl]")
upper.legend(fontsize=8)
lower.set_ylabel("extra dose [U/h]")
lower.set_xlabel("time [h]")

# %%
# Why both fail: the pump is one-sided, so that what is too much cannot be called back; the
# lag is longer than a meal; and what an iteration on a high derivative corrects at once is
# not what is wrong with the glucose of an hour ago. An iteration may move the target of a
# plan that filters, slowly, and that wins one percent of the time.
