"""Depth of anaesthesia in a hundred people who are drawn from a published distribution: a blind test.

Pump, task and controllers are those of `anaesthesia_people`; nothing was chosen here but in the two rows that say so. The people
were drawn with one seed, the file was kept, and only then were the controllers run.

Age, height, weight and sex are those of a row of anaesthesia_people.csv. Everything else has the distribution of Eleveld et al.
(Br. J. Anaesth. 120, 2018, tables 2 and 3, with opioids, arterial samples): volumes and clearances have log-normal factors of
variance 0.610, 0.565, 0.597, 0.265, 0.346 and 0.209, and a clearance between compartments grows with the person's own volume,

    C50 = 3.08 exp(-0.00635 (age - 35)) mg/l, variance 0.242,     ke0 = 0.146 (weight / 70)^-0.25 / min, variance 0.702,
    E0 = Emax = 93,     steepness 1.89, beyond C50 1.47,     dead time 15 s + exp(0.0517 age) s.

Their drug moves slower than the pump believes, and their curves spread twice as far as those of the measured people.

The numbers are those of transcriptions, not of the paper itself. A first version had the two steepnesses exchanged. The rows
"tuned here" are no blind test: of some dozens of PID laws and of cascades in a loop of numpy, they kept most of the first fifty in
the range, each with the model's curve as it is.

`fpirhc study anaesthesia_drawn --cases all`, with three seeds: the worst patient's share of the time from 40 to 60 in %, the lowest
bis of anybody with the induction, the mean share in %, and how many of the fifty are in the range for less than 90 % of the time.
Each is the least and the most of three seeds of the noise; of the rows in mg/l, measured anew, the last was not counted:

    D001 to D050                        worst         lowest        mean          below 90 %
    pump alone                          0.0 to 0.0    6.3 to 6.3    25.7 to 25.7  49 to 49
    PID                                 19.3 to 24.2  23.4 to 23.6  84.5 to 85.1  20 to 22
    RHC offset-free                     18.0 to 21.2  20.5 to 21.3  80.4 to 81.0  23 to 24
    cascade in mg/l, model-referenced   24.7 to 26.2  12.3 to 12.6  84.2 to 85.2  -
    cascade                             7.5 to 8.0    22.1 to 22.5  80.4 to 80.9  23 to 25
    cascade in mg/l                     27.5 to 28.0  19.7 to 20.0  84.1 to 84.9  -
    PID, tuned here                     28.8 to 29.8  19.3 to 21.0  89.3 to 89.4  12 to 14
    cascade in mg/l, tuned here         33.3 to 34.5  17.8 to 18.6  89.0 to 89.7  -

    D051 to D100                        worst         lowest        mean          below 90 %
    pump alone                          0.0 to 0.0    7.2 to 7.2    33.1 to 33.1  45 to 45
    PID                                 0.0 to 0.0    23.9 to 24.3  81.0 to 81.4  24 to 25
    RHC offset-free                     0.0 to 0.0    22.1 to 22.4  76.8 to 77.0  28 to 29
    cascade in mg/l, model-referenced   0.0 to 0.0    19.8 to 20.1  81.9 to 82.6  -
    cascade                             0.0 to 0.0    21.1 to 21.5  79.2 to 79.3  27 to 29
    cascade in mg/l                     0.0 to 0.0    24.8 to 25.1  80.4 to 80.8  -
    PID, tuned here                     0.0 to 0.0    25.8 to 26.3  86.7 to 86.8  13 to 15
    cascade in mg/l, tuned here         0.0 to 0.0    28.6 to 28.7  86.8 to 87.6  -

No controller passes, with at least 90, 37 and 97, and none that was tuned here does. Two people no controller can serve: with the
pump's largest target, 12 mg/l, from the beginning on, D066 is in the range after half an hour and D078 never, at 64. So nobody can
pass on the second half. For the others
Everybody was given one thing as the controllers believe it. Of fifty, those
in the range for less than 90 % of the time, and the lowest bis, with the PID law that was tuned here and seed 0:

    below 90 %, lowest       D001 to D050    D051 to D100
    as they are              14    21.0      13    26.3
    no noise                 12    19.9      13    26.3
    dead time as believed    13    19.6      14    27.4
    effect site as believed   1    16.9       3    26.7
    kinetics as believed      7    20.9      11    18.6
    curve as believed        16    26.2      16    24.9

Neither noise nor dead times are the reason. The effect site is: the drug's way to it takes about twice as long as the pump
believes, in twelve people more than 20 min, in D066 79. They are late, or their first doses were too large. The lowest bis is that
of sensitive people, whose curve nobody knows in the induction. A larger gain than that
of the measured people keeps more people in the range, and takes the most sensitive ones of the first half lower: a person who needs
half the concentration gives the loop twice the gain. Of the two that draw on the measured people, the PID law is the safer one in
the first half and as safe in the second, and it keeps more people in the range.

For the patient of medians, as in `anaesthesia_people`:

    rms error, seed 0                  bis [1]
    pump alone                             5.4
    PID                                    3.4
    RHC offset-free                        3.5
    cascade in mg/l, model-referenced      3.5
    cascade                                  4
    cascade in mg/l                        3.5
    PID, tuned here                        3.3
    cascade in mg/l, tuned here            3.3
"""

from dataclasses import replace
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
        **{"eleveld": 1.0, "E0": 93.0, "Emax": 93.0, "steepness": 1.89, "times_above": 1.47 / 1.89},
        **{f"times_{name}": factor for name, factor in times.items()},
    }
    late = (15 + np.exp(0.0517 * age)) / 60  # min
    return {**who, **{f"exact.{name}": float(value) for name, value in own.items()}, "dead_time.inputs.target": late}


random = np.random.default_rng(SEED)
rows = list(people.cases.changes.values())
cases = fp.Cases(
    {
        f"D{k:03}": {**drawn(random, rows), "group": "tuned" if 2 * k <= PEOPLE else "unseen"}
        for k in range(1, PEOPLE + 1)
    }
)
problem = people.problem
controllers = {
    **people.controllers,
    "PID, tuned here": fp.PID({"bis": -0.07}, {"bis": -0.0235}, bumpless=False),
    "cascade in mg/l, tuned here": replace(
        people.controllers["cascade in mg/l"],
        deformation=replace(
            people.controllers["cascade in mg/l"].deformation, map=fp.Filtered(fp.Affine(gain=-1.6), pole=0.85)
        ),
        lag=3.0,
        dead_time=0.65,
        plain=True,
    ),
}
headline, headline_metric = people.headline, people.headline_metric
why = "The drug reaches the effect site in twice the time that the pump believes, which bounds the gain of PID and cascade alike."
keeps_rule = ()
metrics, pictures = people.metrics, people.pictures
