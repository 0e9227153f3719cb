"""
Doses all day, or one a day
===========================

A tumour is shrunk along a nominal decay by an inhibitor of its vessels. The model's
growth, effect and clearance are wrong by a quarter, and from day 40 on the dose acts as
if it were 1 mg/kg a day larger. The unit of time is the day.
"""

import matplotlib.pyplot as plt

import fpirhc as fp


def results(name, chosen):
    """Runs by controller; prints the rms error of ln(volume) from 60 days on."""
    task = fp.load_problem(name)
    runs = {c: fp.simulate(task.problem, task.controllers[c], seed=0) for c in chosen}
    for controller, run in runs.items():
        error = fp.measure(task.problem, run).rms_error["size"]
        print(f"{name:12s} {controller:16s} {error:.2g}")
    return task, runs


# %%
# Twenty corrections a day: adaptation and an offset-free plan draw, and both are far
# better than the exact model, which knows nothing of the step.

task, runs = results("tumour", ("RHC", "RHC+FPI", "RHC offset-free", "RHC exact model"))
[picture] = task.pictures
picture.draw(plt.figure(figsize=(8, 5), layout="constrained"), runs)

# %%
# One reading and one dose a day: the offset-free plan wins, as its estimate now acts as
# often as the deformation does. And a small gain is no safe choice. A correction that
# takes days to arrive misleads the plan, which answers with all or nothing.

task, runs = results(
    "tumour_daily", ("RHC", "RHC+FPI, gentle", "RHC+FPI", "RHC offset-free")
)
picture.draw(plt.figure(figsize=(8, 5), layout="constrained"), runs)

# %%
# A review says so before the run.

gentle = {"gentle": task.controllers["RHC+FPI, gentle"]}
for answer in fp.review(task.problem, gentle, mismatch=0.0, seed=0).controllers[
    "gentle"
]:
    if answer.verdict.value == "no":
        print(answer.question, answer.evidence)
