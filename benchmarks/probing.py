"""What a probe proposes beside a grid of settings by hand: errors over those of the controller alone, on a run of another seed.

.venv/bin/python benchmarks/probing.py                        # all plants, late links, unseen bodies: six minutes
.venv/bin/python benchmarks/probing.py two_mass quadrotor
.venv/bin/python benchmarks/probing.py stage pendulum vessel  # the blind test: known answers beside the estimates
Option: --late CYCLES, a link before the plant that nobody told; for plants of other packages.

The grid: model-referenced and plain forms with gains from .05 to 1.25, no dead time, and lags of 0, 1 and 3 times the probe's.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import numpy as np
from known_bodies import KNOWN, TRUTH
from unseen_bodies import BODIES, CONTROLLER

import fpirhc as fp
from fpirhc.deformation.base import Deformation
from fpirhc.probing.probe import OnPlant, Probe, Trial
from fpirhc.problem_files.shipped import missing, shipped_groups

# The rule was changed where its choices on the first, on the last, on the late link and on the ship were poor.
SHIPPED = ("two_mass", "two_link_arm", "van_der_pol")
LATE = ("quadrotor", (1, 3, 5))  # cycles of its link
SEEDS = (7, 8, 9)  # of the runs in which bodies with noise are compared; the first one for the others
GAINS = (0.05, 0.15, 0.3, 0.6, 1.0, 1.25)
OUTSIDE = {**BODIES, **KNOWN}


class Late:
    """A body behind a link of some cycles, which holds its first command until then."""

    def __init__(self, body: Any, cycles: int, first: np.ndarray) -> None:
        self.body, self.cycles, self.first = body, cycles, first

    def reset(self, seed: int) -> object:
        """Begin anew."""
        self.way = [self.first] * self.cycles
        return self.body.reset(seed)

    def step(self, moment: float, command: np.ndarray) -> object:
        """Pass the command of some cycles before on."""
        self.way.append(np.array(command))
        return self.body.step(moment, self.way.pop(0))


def late(problem: fp.Problem, cycles: int) -> fp.Problem:
    """Return the problem with the link before its reality."""
    outside = problem.reality
    if not cycles:
        return problem
    assert isinstance(outside, fp.ExternalPlant)
    plant = problem.plant
    # The commands that keep the plant where it starts, as the link holds them.
    rest = plant.equations.inverse(problem.start_state, np.zeros(len(plant.controlled_names)), plant.approximate)
    first = np.asarray(rest).ravel()
    if outside.make is None:
        return replace(problem, reality=replace(outside, body=Late(outside.body, cycles, first)))
    made = outside.make
    return replace(problem, reality=replace(outside, make=lambda told, seed: Late(made(told, seed), cycles, first)))


def by_hand(lags: tuple[float, ...]) -> dict[str, Deformation]:
    """Return the grid."""
    forms: dict[str, Deformation] = {f"plain {g}": fp.Affine(gain=-2 * g) for g in GAINS}
    for factor in (0.0, 1.0, 3.0):
        lag = tuple(factor * tau for tau in lags)
        forms |= {f"lag {factor:g}x, {g}": fp.ModelReferenced(fp.Affine(gain=-2 * g), lag=lag) for g in GAINS}
    return forms


def rms(trials: list[Trial | str]) -> Trial:
    """Return the rms of the errors of trials with several seeds, and the largest of any coordinate; a refusal is infinite."""
    every = [one if isinstance(one, Trial) else Trial(np.inf, np.inf) for one in trials]
    return Trial(float(np.sqrt(np.mean([one.error**2 for one in every]))), max(one.worst for one in every))


def beside_truth(name: str, found: Probe) -> str:
    """Return each estimate of a body with known answers beside its truth, such as "1.34 [1.27, 1.41] of 1.3"."""
    truth, inputs = TRUTH[name], list(found.dead_time)
    pairs = [(g, truth.gains[i, j]) for i, row in enumerate(found.gain.values()) for j, g in enumerate(row.values())]
    pairs += [(found.dead_time[u], truth.dead[j]) for j, u in enumerate(inputs)]
    pairs += [(found.lag[u], truth.lag[j]) for j, u in enumerate(inputs)]
    missed = sum(not one.low <= value <= one.high for one, value in pairs)
    told = ", ".join(f"{one.value:.3g} [{one.low:.3g}, {one.high:.3g}] of {value:.3g}" for one, value in pairs)
    return f"gains, dead times in cycles, lags in s: {told}; {missed} of {len(pairs)} outside"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*")
    parser.add_argument("--late", type=int, default=0)
    parser.add_argument("--cycles", type=int, default=400)
    asked = parser.parse_args()
    outside = {name: path for name, path in shipped_groups()["plants of other packages"].items() if not missing(path)}
    everything = [(name, 0) for name in (*outside, *SHIPPED, *OUTSIDE)]
    everything += [(LATE[0], k) for k in LATE[1] if LATE[0] in outside]
    for name, cycles in [(name, asked.late) for name in asked.problems] or everything:
        title = f"{name}, {cycles} late" if cycles else name
        if name in OUTSIDE:
            problem, alone = OUTSIDE[name](), CONTROLLER
        else:
            task = fp.load_problem(name)
            problem = late(task.problem, cycles)
            alone = next(c for n, c in task.controllers.items() if n.startswith("RHC"))
        begun = time.process_time()
        found = fp.probe(problem, alone, cycles=asked.cycles, seed=3)
        took = time.process_time() - begun
        proposed = {} if found.deformation is None else {"probe": found.deformation}
        lags = tuple(one.value for one in found.lag.values())
        seeds = SEEDS if name in OUTSIDE else SEEDS[:1]
        plant, every = OnPlant(problem, alone), {**by_hand(lags), **proposed}
        runs = [{n: plant.trial(one, seed) for n, one in every.items()} for seed in seeds]
        trials = {n: rms([run[n] for run in runs]) for n, one in runs[0].items() if isinstance(one, Trial)}
        probe = trials.pop("probe", Trial(1.0, 1.0))
        hand = min(trials, key=lambda n: trials[n].error)
        print(
            f"{title:17s} probe {probe.error:.4f} (worst coordinate {probe.worst:.3f}), by hand {trials[hand].error:.4f} ({hand}), "
            f"ratio {probe.error / trials[hand].error:.2f}; {took:.0f} s\n                  {found.lines} {found.why}",
            flush=True,
        )
        if name in TRUTH:
            print(f"                  {beside_truth(name, found)}", flush=True)


if __name__ == "__main__":
    main()
