"""Depth of anaesthesia in a hundred people who are drawn from a published distribution: a blind test.

Pump, task and controllers are those of `anaesthesia_people`; nothing was chosen here. The people were drawn with one seed, the file
was kept, and only then were the controllers run.

Age, height, weight and sex are those of a row of anaesthesia_people.csv. Everything else has the distribution of Eleveld et al.
(Br. J. Anaesth. 120, 2018, tables 2 and 3, with opioids, arterial samples): volumes and clearances have log-normal factors of
variance 0.610, 0.565, 0.597, 0.265, 0.346 and 0.209, and a clearance between compartments grows with the person's own volume,

    C50 = 3.08 exp(-0.00635 (age - 35)) mg/l, variance 0.242,     ke0 = 0.146 (weight / 70)^-0.25 / min, variance 0.702,
    E0 = Emax = 93,     steepness 1.47, beyond C50 1.89,     dead time 15 s + exp(0.0517 age) s.

Their drug moves slower than the pump believes, their curves spread twice as far as those of the measured people, and beyond C50
they are steeper. `python benchmarks/patients.py anaesthesia_drawn` runs all controllers on them with five seeds of the noise.

For the patient of medians, as in `anaesthesia_people`:

    rms error, seed 0                  bis [1]
    pump alone                             5.4
    PID                                    3.4
    RHC offset-free                        3.5
    cascade in mg/l, model-referenced      3.5
    cascade                                  4
    cascade in mg/l                        3.5
"""

from pathlib import Path

import numpy as np

import fpirhc as fp

SEED, PEOPLE = 2018, 100
people = fp.load_problem(str(Path(__file__).with_name("anaesthesia_people.py")))
VARIANCES = {
    "V1": 0.610,
    "V2": 0.565,
    "V3": 0.597,
    "cleared": 0.265,
    "fast": 0.346,
    "slow": 0.209,
    "C50": 0.242,
    "ke0": 0.702,
}


def drawn(random, rows):
    """What is a person's own, by path."""
    row = rows[random.integers(len(rows))]
    who = {path: row[path] for path in ("exact.age", "exact.height", "exact.weight", "exact.sex")}
    age, weight = who["exact.age"], who["exact.weight"]
    times = {name: np.exp(random.normal(scale=variance**0.5)) for name, variance in VARIANCES.items()}
    times["fast"] *= times["V2"] ** 0.75
    times["slow"] *= times["V3"] ** 0.75
    own = {
        "C50": 3.08 * np.exp(-0.00635 * (age - 35)) * times.pop("C50"),
        "ke0": 0.146 * (weight / 70) ** -0.25 * times.pop("ke0"),
        **{"eleveld": 1.0, "E0": 93.0, "Emax": 93.0, "steepness": 1.47, "times_above": 1.89 / 1.47},
        **{f"times_{name}": factor for name, factor in times.items()},
    }
    late = (15 + np.exp(0.0517 * age)) / 60  # min
    return {**who, **{f"exact.{name}": float(value) for name, value in own.items()}, "dead_time.inputs.target": late}


random = np.random.default_rng(SEED)
rows = list(people.cases.changes.values())
cases = fp.Cases({f"D{k:03}": {**drawn(random, rows), "group": "drawn"} for k in range(1, PEOPLE + 1)})
problem, controllers = people.problem, people.controllers
headline, headline_metric = people.headline, people.headline_metric
metrics, pictures = people.metrics, people.pictures
