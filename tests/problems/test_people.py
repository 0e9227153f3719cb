"""People behind a pump of an anaesthetic and of insulin: they are the published ones, and loops keep what is said of them.

References: Eleveld et al., Br. J. Anaesth. 120, 2018, for its reference individual; scipy for the compartments; a loop of numpy's
own; the run of two days and the states at rest of jxx123/simglucose, commit a6f6777 (Magni et al. for the grid: `test_pictures`).
"""

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lsim

import fpirhc as fp

NAME = "anaesthesia_people"
KE0, APPROACH, CYCLE = 0.309, 1.5, 1 / 12


@cache
def task(name: str = NAME) -> Any:
    return fp.load_problem(name)


@cache
def written() -> Any:
    """The module of the problem file."""
    return SimpleNamespace(**run_path(str(task().path)))


def patient(name: str) -> SimpleNamespace:
    """Exact parameters of a case, with its dead time in min."""
    changes = task().cases.changes[name]
    own = {path.partition(".")[2]: value for path, value in changes.items() if path.startswith("exact.")}
    return SimpleNamespace(**own, late=changes["dead_time.inputs.target"])


def test_the_reference_individual_has_the_published_volumes_and_clearances():
    """35 years, 70 kg, 170 cm, a man; opioids divide the slow volume and the clearance by functions of the age."""
    man = SimpleNamespace(age=35.0, weight=70.0, height=170.0, sex=0.0)
    volumes, clearances = (np.array([float(v) for v in part]) for part in written().eleveld(man))
    opioids = np.exp(-0.0138 * 35)
    slow = 1.11 * opioids**0.75
    np.testing.assert_allclose(volumes, [6.28, 25.5, 273 * opioids])
    matured = 1 + 1.30 * (1 - 1 / (1 + 68.3 / (35 * 365.25 / 7 + 40)))
    np.testing.assert_allclose(clearances, [1.79 * np.exp(-0.00286 * 35), 1.75 * matured, slow])


def matrices(kinetics: Any, ke0: float) -> tuple[np.ndarray, np.ndarray]:
    """A cycle of the compartments with a held infusion, exactly."""
    (V1, V2, V3), (cleared, fast, slow) = ([float(v) for v in part] for part in kinetics)
    rates = np.array(
        [
            [-(cleared + fast + slow) / V1, fast / V1, slow / V1, 0, 1 / V1],
            [fast / V2, -fast / V2, 0, 0, 0],
            [slow / V3, 0, -slow / V3, 0, 0],
            [ke0, 0, 0, -ke0, 0],
            [0, 0, 0, 0, 0],
        ]
    )
    whole = expm(rates * CYCLE)
    return whole[:4, :4], whole[:4, 4]


def own_loop(name: str, law: Any, cycles: int) -> np.ndarray:
    """The bis of a patient by numpy alone, without noise: pump, compartments, dead time, curve, surgery."""
    own, module = patient(name), written()
    pump_kinetics = module.schnider(own)
    pump, body = matrices(pump_kinetics, KE0), matrices(module.eleveld(own) if own.eleveld else pump_kinetics, own.ke0)
    (V1, _, _), (cleared, fast, slow) = ([float(v) for v in part] for part in pump_kinetics)
    m, x, targets, depth, surgery = np.zeros(4), np.zeros(4), [0.5] * 40, [], 0.0
    late, share = divmod(own.late / CYCLE, 1)
    for k in range(cycles):
        bis = surgery + own.E0 - own.Emax / (1 + (own.C50 / max(x[3], 1e-6)) ** own.steepness)
        depth.append(bis)
        targets.insert(0, law(bis))
        target = (1 - share) * targets[int(late)] + share * targets[int(late) + 1]
        rate = KE0 * (m[0] - m[3])
        bent = APPROACH**2 * (target - m[3]) - 2 * APPROACH * rate
        wanted = V1 * (bent / KE0 + rate) + cleared * m[0] + fast * (m[0] - m[1]) + slow * (m[0] - m[2])
        infusion = np.clip(wanted, 0, 400)
        m, x = (a @ c + b * infusion for (a, b), c in ((pump, m), (body, x)))
        middle = (k + 0.5) * CYCLE  # a signal from outside is held at its value there
        surgery = 10 / (1 + np.exp(4 * (20 - middle))) - 10 / (1 + np.exp(4 * (35 - middle)))
    return np.array(depth)


class InConcentrations:
    """The plain cascade: .4 of the filtered error in mg/l is taken off the target in force, and shifts of the target are of bis."""

    def __init__(self) -> None:
        self.shifts, self.error, self.begun = [0.0] * 12, 0.0, False
        self.in_force = 92.0 - 50.0

    def converted(self, bis: float) -> float:
        return 4.53 * (92 / np.clip(bis, 2.0, 91.5) - 1) ** (1 / 1.57)

    def __call__(self, bis: float) -> float:
        if self.begun:  # the first cycle has no response to a command
            self.error = 0.85 * self.error + 0.15 * (self.converted(bis) - self.converted(50.0))
        z = np.clip(self.converted(50.0 + self.in_force) - 0.4 * self.error, 0.5, 12.0)
        self.shifts.insert(0, 92 / (1 + (z / 4.53) ** 1.57) - 50.0 if self.begun else self.in_force)
        self.begun = True
        late, share = divmod(0.65 / CYCLE, 1)
        passed = (1 - share) * self.shifts[int(late)] + share * self.shifts[int(late) + 1]
        decay = np.exp(-CYCLE / 1.2)
        self.in_force = decay * self.in_force + (1 - decay) * passed
        return z


@pytest.mark.parametrize("name", ["A05", "B11", "C06"])
@pytest.mark.parametrize(
    ("controller", "law"),
    [("pump alone", lambda: lambda _: 4.53 * 0.84 ** (1 / 1.57)), ("cascade in mg/l", InConcentrations)],
)
def test_a_loop_of_its_own_has_the_same_run(name, controller, law):
    """With exact compartments in place of Runge-Kutta steps, without noise, over the induction and the beginning of surgery."""
    problem = replace(task().cases.problem(name, task().problem), sensing=fp.Sensing(), duration=25.0)
    run = fp.simulate(problem, task().controllers[controller], seed=0, compiled=False)
    np.testing.assert_allclose(run["plant_state.bis"], own_loop(name, law(), 300), atol=2e-4)


def test_the_drawn_people_have_the_published_distribution():
    """Variances of the logarithms within four standard errors of a sample of a hundred; medians of the curve at 35 years."""
    own = {
        n: np.array([c[f"exact.{n}"] for c in task("anaesthesia_drawn").cases.changes.values()])
        for n in ("age", "weight", "C50", "ke0", "times_V1")
    }
    people = len(own["age"])
    typical = {
        "C50": 3.08 * np.exp(-0.00635 * (own["age"] - 35)),
        "ke0": 0.146 * (own["weight"] / 70) ** -0.25,
        "times_V1": np.ones(people),
    }
    for name, variance in (("C50", 0.242), ("ke0", 0.702), ("times_V1", 0.610)):
        drawn = np.log(own[name] / typical[name])
        assert drawn.var() == pytest.approx(variance, abs=4 * variance * (2 / people) ** 0.5), name
        assert drawn.mean() == pytest.approx(0.0, abs=4 * (variance / people) ** 0.5), name


def test_a_curve_may_be_steeper_beyond_its_middle():
    """Eleveld's, with 1.89 below and 1.47 above C50: the bis at half and at twice of it, as in the drawn people."""
    patient = written().patient
    values = dict(zip(patient.parameters, patient.exact, strict=True))
    values |= {"E0": 93.0, "Emax": 93.0, "C50": 3.0, "steepness": 1.89, "times_above": 1.47 / 1.89}
    drawn = task("anaesthesia_drawn").cases.changes.values()
    assert all(case[f"exact.{n}"] == values[n] for case in drawn for n in ("steepness", "times_above"))
    for reached, steepness in ((1.5, 1.89), (6.0, 1.47)):
        state = [reached if e == "own_Ce" else 0.0 for e in patient.state.elements]
        bis = patient.equations.output(state, [0.5], list(values.values()), np.zeros(len(patient.names)))
        assert float(bis) == pytest.approx(93 - 93 / (1 + (3.0 / reached) ** steepness))


def test_the_monitor_is_its_transfer_function():
    """Independent: scipy's response of the continuous system to the held input, one cycle of delay before it."""
    of = task("anaesthesia_monitor")
    problem = replace(of.problem, sensing=fp.Sensing(), duration=11.0)
    run = fp.simulate(problem, of.controllers["pump alone"], seed=0, compiled=False)
    held = np.concatenate([[92.0], run["plant_state.bis"]])[:-1]
    system = ([-0.049, 0.066, 0.976, 0.056], [1.0, 2.27, 6.353, 1.487, 0.056])
    fine = np.arange(0, 60 * 11 + 1e-9, 0.05)
    changes = np.concatenate([[0.0], held - 92.0])[np.minimum((fine / 5 + 1 - 1e-9).astype(int), len(held))]
    _, shown, _ = lsim(system, changes, fine, interp=False)
    index = run["reality_state.index"]
    np.testing.assert_allclose(index, 92.0 + shown[::100][: len(index)], atol=2e-2)


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


def body(name: str) -> tuple[fp.Problem, fp.Plant, np.ndarray, np.ndarray]:
    """Problem, map of a minute, state at the start and parameters of a person."""
    problem = task("diabetes").cases.problem(name, task("diabetes").problem)
    minute = replace(problem.reality.plant, steps=1)
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
    _, minute, x, _ = body("adolescent#001")
    for own in task("diabetes").cases.changes.values():
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
    of = task("diabetes")
    run = fp.simulate(of.cases.problem(name, of.problem), of.controllers["PID"], seed=0, compiled=False)
    assert run["signals.carbs"].sum() * of.problem.period == pytest.approx(2 * 220.0, rel=1e-12)
    assert run["plant_output.glucose"].min() >= 94.0
