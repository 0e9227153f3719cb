"""The people of `diabetes` are the published ones, and its controllers keep the rule for low glucose in all of them.

References: the run of two days and the states at rest of jxx123/simglucose, commit a6f6777; Magni et al. for the grid are in
`test_pictures`.
"""

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fpirhc as fp

TWO_DAYS = Path(__file__).parents[1] / "data" / "diabetes" / "two_days.csv"
BASAL = 0.0139333333333  # U/min
# Meals of the recording, by its row of 3 min: the minute of the row in which it begins, g, and the dose of the next row in U/min.
MEALS = {
    172: (1, 56, 1.56949166667), 214: (2, 59, 1.948875), 291: (0, 13, 0.375041666667), 369: (2, 79, 2.208375),
    638: (1, 54, 1.51393333333), 669: (0, 7, 0.543966666667), 709: (2, 63, 1.76393333333), 784: (1, 8, 0.236158333333),
    828: (0, 73, 2.04170833333),
}  # fmt: skip
EATING = 5.0  # g/min
# Of adolescent#001, in the order of the source: Gp, Gt, Ip, X, I1, Id, Il, two depots, Gs.
PUBLISHED: tuple[float, ...] = (250.621836, 176.506559902, 4.697517762, 0.0, 97.554, 97.554, 3.19814917262)
PUBLISHED += (57.951224472, 93.2258828462, 250.621836)


@cache
def task(name: str = "diabetes") -> Any:
    return fp.load_problem(name)


def body(name: str) -> tuple[fp.Problem, fp.Plant, np.ndarray, np.ndarray]:
    """Problem, map of a minute, state at the start and parameters of a person."""
    cases = task().cases
    assert cases is not None
    problem = cases.problem(name, task().problem)
    reality = problem.reality
    assert isinstance(reality, fp.Reality)
    assert isinstance(reality.plant, fp.Plant)
    minute = replace(reality.plant, steps=1)
    return problem, minute, np.array([*problem.start_state, 0.0, 0.0]), np.array(minute.exact)


def test_two_published_days_are_met():
    """The same doses and meals give the glucose of the other simulator, which has a variable step, to 1e-4 mg/dl."""
    _, minute, x, p = body("adolescent#001")
    names, calm = list(minute.parameter.elements), np.zeros(len(minute.names))
    carbs, basal, volume = (names.index(name) for name in ("carbs", "basal", "Vg"))
    with TWO_DAYS.open() as file:
        published = {int(k): float(v) for k, v in list(csv.reader(line for line in file if line[0] != "#"))[1:]}
    left, apart, none = 0.0, [], (0, 0, BASAL)
    for k in range(max(published)):
        glucose, dose = [], MEALS.get(k - 1, none)[2]
        for m in range(3):
            left += MEALS[k][1] if k in MEALS and MEALS[k][0] == m else 0.0
            p[carbs] = min(EATING, left)
            left -= p[carbs]
            x = np.asarray(minute.equations.next(x, 60 * dose - p[basal], p, calm)).ravel()
            glucose.append(x[minute.names.index("Gs")] / p[volume])
        if k + 1 in published:
            apart.append(abs(np.mean(glucose) - published[k + 1]))
    assert len(apart) == 48
    assert max(apart) < 1e-4


def test_everybody_rests_with_the_basal_dose():
    """Nothing moves in a minute, by 1e-10, in any person of the table; the first one's rest is the published one."""
    cases = task().cases
    assert cases is not None
    _, minute, x, _ = body("adolescent#001")
    for own in cases.changes.values():
        start = np.array([own.get(f"start.{n}", 0.0) for n in minute.names])
        parameters = np.array([own.get(f"exact.{n}", 0.0) for n in minute.parameter.elements])
        after = np.asarray(minute.equations.next(start, 0.0, parameters, np.zeros(len(minute.names)))).ravel()
        assert np.abs(after - start).max() < 1e-10
    names = ("Gp", "Gt", "Ip", "X", "I1", "Id", "Il", "depot1", "depot2", "Gs")
    np.testing.assert_allclose(x[[minute.names.index(n) for n in names]], PUBLISHED, atol=1e-9)


@pytest.mark.parametrize(
    "name", [pytest.param(f"child#{k:03d}", marks=[] if k == 4 else pytest.mark.slow) for k in range(1, 11)]
)
def test_children_eat_what_is_stated_and_are_safe_with_the_pid_law(name):
    """Five meals of 220 g a day, minute by minute; the lowest glucose of every child is at least 94 mg/dl."""
    cases = task().cases
    assert cases is not None
    run = fp.simulate(cases.problem(name, task().problem), task().controllers["PID"], seed=0, compiled=False)
    assert run["signals.carbs"].sum() * task().problem.period == pytest.approx(2 * 220.0, rel=1e-12)
    assert run["plant_output.glucose"].min() >= 94.0
