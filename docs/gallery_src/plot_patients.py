"""
A hundred patients behind a pump
================================

A pump for target-controlled infusion gives the dose with which its model's brain follows a
target concentration. Who moves the target has to hold the depth of anaesthesia between
40 and 60, in patients whose curves, kinetics and dead times differ, through noise and
surgery. What counts is who fares worst.
"""

import matplotlib.pyplot as plt

import fpirhc as fp

task = fp.load_problem("anaesthesia_people")

# %%
# The worst patient's share of the time in the range in %, the lowest depth of anybody, and
# the mean share, in four groups. Settings were chosen on the first, by a rule that was
# changed once after all had been run, so the others are no blind test. At least 90, 37 and
# 97 are wanted: of those whom no setting was chosen on, the cascade in mg/l and the PID law
# have it in every group. The table takes a
# minute, so it is kept in the problem file, where a test compares it with its command,
# ``fpirhc compare anaesthesia_people --cases all``.

about = task.description
head, *rows = about[
    about.index("    worst, lowest, mean") : about.index("\n\nAt least 90")
].splitlines()
for number, group in enumerate(("A tuned", "A unseen", "B", "C")):
    print(f"{group:38s}worst  lowest    mean")
    for row in rows:
        name, *cells = [cell.strip() for cell in row.split("  ") if cell.strip()]
        worst, lowest, mean = cells[3 * number : 3 * number + 3]
        print(f"  {name:36s}{worst:>5s}{lowest:>8s}{mean:>8s}")

# %%
# A blind test: a hundred people drawn from a published distribution, on whom nothing was
# chosen but the two rows that say so. It shows what the others cannot: here all
# controllers lose somebody, those that were tuned on the first half too.

blind = fp.load_problem("anaesthesia_drawn").description
print(blind[blind.index("    D001 to D050") : blind.index("\n\nNo controller passes")])

# %%
# Three patients: one needs twice the model's concentration, one answers two and a half
# minutes late and has other kinetics than the pump believes, one is very sensitive. What the
# pump does alone is right for the second by chance.

rows = ("pump alone", "PID", "cascade in mg/l, model-referenced", "cascade in mg/l")
cases = ("A05", "B11", "C06")
figure, axes = plt.subplots(
    len(cases), 1, figsize=(8, 7), sharex=True, layout="constrained"
)
for axis, case in zip(axes, cases, strict=True):
    axis.axhspan(40, 60, color="#009e73", alpha=0.15)
    for name in rows:
        run = fp.simulate(
            task.cases.problem(case, task.problem), task.controllers[name], seed=0
        )
        axis.plot(run.time, run["plant_state.bis"], label=name, linewidth=1)
    axis.set(ylabel=f"bis of {case} [1]", ylim=(10, 100))
axes[-1].set_xlabel("time [min]")
axes[0].legend(ncols=2, fontsize=8)

# %%
# What the pump gives to the sensitive one: the sooner the bis is at 50, the larger the first
# infusion, and the deeper the induction.

patient = task.cases.problem("C06", task.problem)
shown = {n: fp.simulate(patient, task.controllers[n], seed=0) for n in rows}
_, infusion = task.pictures
infusion.draw(plt.figure(figsize=(8, 5), layout="constrained"), shown)

# %%
# The model-referenced cascade begins with its model's whole target, as the pump alone does,
# and a sensitive patient is too deep in the induction. The plain one begins at the target
# that is in force, and so does a PID law in effect.
#
# A monitor shows the depth late, and bursts of artefacts with it. A denoiser of Haar
# wavelets passes a jump at once and averages what is small; a low-pass that moves the pump's
# target as much is as good.

seen = fp.load_problem("anaesthesia_monitor")
patient = seen.cases.problem("A02", seen.problem)
figure, (shown, moved) = plt.subplots(
    2, 1, figsize=(8, 5), sharex=True, layout="constrained"
)
for name in ("cascade, no filter", "cascade, low-pass", "cascade, Haar"):
    run = fp.simulate(patient, seen.controllers[name], seed=0)
    moved.plot(run.time, run["command.target"], label=name, linewidth=1)
shown.plot(
    run.time, run["reality_state.index"], color="0.6", linewidth=1, label="monitor"
)
shown.plot(
    run.time, run["plant_state.bis"], color="black", linewidth=1, label="patient"
)
shown.set(ylabel="bis [1]")
moved.set(ylabel="target [mg/l]", xlabel="time [min]")
shown.legend(fontsize=8)
moved.legend(fontsize=8)
