"""
Doses all day, or one a day
===========================

A tumour is shrunk along a nominal decay by an inhibitor of its vessels. The model's
growth, effect and clearance are wrong by a quarter, and from day 40 on the dose acts as
if it were 1 mg/kg a day larger. The unit of time is the day.
"""

import textwrap

import matplotlib.pyplot as plt

import fpirhc as fp


def results(name, names):
    """Runs by controller; prints the rms error of ln(volume) from 60 days on."""
    task = fp.load_problem(name)
    runs = {c: fp.simulate(task.problem, task.controllers[c], seed=0) for c in names}
    for controller, run in runs.items():
        error = fp.measure(task.problem, run).rms_error["size"]
        print(f"{name:12s} {controller:33s} {error:.2g}")
    return task, runs


# %%
# Twenty corrections a day: adaptation in either form and an offset-free plan are far
# better than the exact model, which knows nothing of the step. "RHC+FPI" is the plain
# form, as published.

names = ("RHC", "RHC+FPI, model-referenced", "RHC+FPI", "RHC offset-free")
task, runs = results("tumour", (*names, "RHC exact model"))
[picture] = task.pictures
picture.draw(plt.figure(figsize=(8, 5), layout="constrained"), runs)

# %%
# One reading and one dose a day: the offset-free plan and the model-referenced form are
# equally good, as they are with twenty. In the
# plain form a small gain is no safe choice: a correction that takes days to arrive
# misleads the plan, which answers with all or nothing. The same gain is safe in the
# model-referenced form, which passes at once what the model expects.

gentle = ("RHC+FPI, gentle, model-referenced", "RHC+FPI, gentle")
task, runs = results("tumour_daily", (*names, *gentle))
picture.draw(plt.figure(figsize=(8, 5), layout="constrained"), runs)

# %%
# A review says so of the plain form before the run.

gentle = {"gentle": task.controllers["RHC+FPI, gentle"]}
for answer in fp.review(task.problem, gentle, mismatch=0.0, seed=0).controllers[
    "gentle"
]:
    if answer.verdict.value == "no":
        print(textwrap.fill(f"{answer.question} {answer.evidence}", 85))

# %%
# A model of third order has the vessels too, and every number of it is wrong. With twenty
# corrections a day the model-referenced form leaves next to nothing of the error.

vessels = ("CTC", "RHC", "RHC+FPI, model-referenced", "RHC+FPI", "RHC offset-free")
task, runs = results("tumour_vessels", vessels)

# %%
# With two doses a day, in whole portions of 5 mg/kg/day, the plain form triples the error:
# more than half of the drug is gone within a cycle, and the plan changes the desired
# response again before the change before has come through the wrong model.

task, runs = results("tumour_portions", vessels[:4])
figure, (size, dose) = plt.subplots(
    2, 1, sharex=True, figsize=(8, 5), layout="constrained"
)
for name, run in runs.items():
    size.plot(run.time, run["true_error.size"], lw=1, label=name)
    dose.step(run.time, run["command.dose"], lw=1, where="post")
size.set(ylabel="error of ln(volume)", ylim=(-0.2, 0.2))
size.legend(ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1))
dose.set(ylabel="dose asked for [mg/kg/day]", xlabel="time [day]")
