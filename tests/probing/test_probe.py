"""A probe of bodies whose gain, dead time, lag and noise are known."""

import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
import pytest

import fpirhc as fp
from fpirhc.contracts import Deformation

PERIOD = 1e-2
RHC = fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-2))


@dataclass
class Body:
    """A body with a gain matrix, a dead time in cycles, a lag in s, and a noise of the measured response.

    q'' = Lambda lag(u(t - d T)) - .5 v - 2 sin(q) + sin(1.3 t + k); the model is q'' = u.
    """

    gains: np.ndarray
    dead: int = 0
    lag: float = 0.0
    noise: float = 0.0

    def reset(self, seed: int) -> np.ndarray:
        n = len(self.gains)
        self.random, self.queue = np.random.default_rng(seed), [np.zeros(n)] * self.dead
        self.moving, self.now = cycle(tuple(map(tuple, self.gains)), self.lag), np.zeros(3 * n)
        return np.zeros(3 * n)

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        self.queue.append(command)
        moved, response = (one.full().ravel() for one in self.moving(time, self.now, self.queue.pop(0)))
        self.now = moved
        noise = self.noise * self.random.standard_normal(len(response))
        return np.concatenate([moved[: 2 * len(response)], response + noise])


@cache
def cycle(gains: tuple[tuple[float, ...], ...], lag: float) -> ca.Function:
    """Function (time, [q, v, acting command], command) -> (the same a cycle later, response), in ten steps."""
    n, h = len(gains), PERIOD / 10
    time, moving, now = ca.SX.sym("t"), ca.SX.sym("x", 3 * n), ca.SX.sym("u", n)
    q, v, acting = ca.vertsplit(moving, n)
    for i in range(10):
        acting = now + (acting - now) * (np.exp(-h / lag) if lag else 0.0)
        push = ca.sin(1.3 * (time + i * h) + np.arange(n))
        a = ca.mtimes(ca.DM(gains), acting) - 0.5 * v - 2 * ca.sin(q) + push
        q, v = q + h * v + h * h / 2 * a, v + h * a
    return ca.Function("cycle", [time, moving, now], [ca.vertcat(q, v, acting), a])


def body_problem(gains: float | list[list[float]], dead: int = 0, lag: float = 0.0, noise: float = 0.0) -> fp.Problem:
    """Return the task of such a body, with the model of one or two masses."""
    body = Body(np.atleast_2d(np.array(gains, dtype=float)), dead, lag, noise)
    names, inputs = ["q", "p"][: len(body.gains)], ["u", "w"][: len(body.gains)]
    model = fp.Plant(
        dict.fromkeys(names, "m"),
        dict.fromkeys(inputs, "m/s^2"),
        {"b": fp.Parameter(1.0, 1.0, "1")},
        lambda q, v, u, p: {name: p.b * u[i] for name, i in zip(names, inputs, strict=True)},
    )
    units = {"": "m", "'": "m/s", "''": "m/s^2"}
    return fp.Problem(
        plant=model,
        reality=fp.ExternalPlant(body, measures={name + d: unit for d, unit in units.items() for name in names}),
        reference=fp.Trajectory(lambda t: {name: 1 - ca.cos((2 + k) * t) for k, name in enumerate(names)}),
        start=dict.fromkeys(names, 0.0),
        period=PERIOD,
        duration=8.0,
        measure_from=1.0,
        limits=fp.Limits(inputs=dict.fromkeys(inputs, (-60.0, 60.0))),
        horizon=fp.Horizon(stages=20, step=5e-2),
        cost=fp.Quadratic(
            states={**dict.fromkeys(names, 100.0), **{f"{n}'": 5.0 for n in names}},
            deviation=dict.fromkeys(inputs, 1.0),
        ),
    )


KNOWN = [  # gain, dead time in cycles, lag in s, noise of the response
    (1.0, 0, 0.0, 0.05),
    (0.4, 0, 0.0, 0.05),
    (2.5, 0, 0.0, 0.05),
    (1.0, 60, 0.0, 0.1),  # beyond the first search, in which no gain shows
    (1.6, 7, 0.0, 0.3),
    (0.6, 0, 0.05, 0.05),
    (1.5, 2, 0.03, 0.3),
]
NAMES = ("q", "p"), ("u", "w")


def recorded(path: Path, gains: Any, dead: int, lag: float, noise: float, seed: int = 7) -> fp.Problem:
    """Record a body that is moved at random, without a controller, as a CSV file; return its problem."""
    problem = body_problem(gains, dead, lag, noise)
    body, random = Body(np.atleast_2d(np.array(gains, dtype=float)), dead, lag, noise), np.random.default_rng(seed)
    n = len(body.gains)
    held, seen, rows = np.zeros(n), body.reset(seed), []
    for k in range(400):
        if k % 4 == 0:
            held = random.choice([-2.0, 2.0], n)
        rows.append([k * PERIOD, *held, *seen])
        seen = body.step(k * PERIOD, held)
    heads = ["time", *NAMES[1][:n], *(f"{q}{d}" for d in ("", "'", "''") for q in NAMES[0][:n])]
    pd.DataFrame(rows, columns=heads).to_csv(path, index=False)
    return problem


QUANTITIES = {"q": "m", "q'": "m/s", "q''": "m/s^2"}


@pytest.mark.parametrize(("gain", "dead", "lag", "noise"), KNOWN)
def test_the_estimates_of_a_recording_are_those_of_the_body(gain, dead, lag, noise, tmp_path):
    """The dead time to the cycle; gain, lag and noise within 6, 10 and 20 %; all intervals contain the truth; no run is made."""
    problem = recorded(tmp_path / "run.csv", -gain, dead, lag, noise)
    problem = replace(problem, reality=fp.ExternalPlant(Body(np.array(None)), QUANTITIES))  # fails where it is run
    problem = replace(problem, limits=fp.Limits(inputs={"u": (-2.0, 9.0)}))  # half of the commands are at one
    found = fp.probe(problem, RHC, recording=tmp_path / "run.csv")
    late, own, slow = found.dead_time["u"], found.gain["q"]["q"], found.lag["u"]
    assert (late.low, late.value, late.high) == (dead, dead, dead)
    assert own.value == pytest.approx(-gain, rel=0.06)
    assert own.low <= -gain <= own.high < 0
    assert slow.value == pytest.approx(lag, rel=0.1, abs=0.3 * PERIOD)
    assert slow.low <= lag <= slow.high
    assert found.noise["q"] == pytest.approx(noise, rel=0.25)
    assert found.deformation is None
    assert [words in " ".join(found.notes) for words in ("is at a limit in", "DeadTime(")] == [True, dead > 0]
    assert found.why.startswith("the sign of the gain is wrong")
    assert found.lines == "deformation=fp.Identity(),"


def test_a_gain_that_noise_hides_has_no_certain_sign(tmp_path):
    """Its interval holds both signs: the input of the model may well be right."""
    found = fp.probe(recorded(tmp_path / "run.csv", 0.0, 0, 0.0, 0.3), RHC, recording=tmp_path / "run.csv")
    assert found.gain["q"]["q"].low < 0 < found.gain["q"]["q"].high
    assert found.why.startswith("the sign of a gain is not certain")

    def notes(amplitude: float, most: float = 60.0) -> str:  # what makes it certain is named, within the limits
        loud = replace(body_problem(1.0, noise=1.0), limits=fp.Limits(inputs={"u": (-most, most)}))
        return " ".join(fp.probe(loud, RHC, amplitude=amplitude, cycles=150, trials=False).notes)

    needed = notes(0.3).partition("20 % needs an amplitude of ")[2]
    assert "needs" not in notes(1.1 * float(needed))
    assert "20 % needs an amplitude of 0.4 and " in notes(0.3, most=0.8)


@pytest.mark.parametrize(("window", "noise"), [(7, 1e-4), (61, 1e-4), (7, 0.0)])
def test_the_window_of_an_estimator_is_in_no_estimate(window, noise, tmp_path):
    """It makes the response late and colours its noise, so the plant is estimated from the positions before it."""
    problem, path = recorded(tmp_path / "run.csv", -2.0, 3, 0.0, 0.0), tmp_path / "run.csv"
    table = pd.read_csv(path)[["time", "u", "q"]]
    table.assign(q=table.q + noise * np.random.default_rng(2).standard_normal(400)).to_csv(path, index=False)
    windowed = replace(problem, sensing=fp.Sensing(estimator=fp.SavitzkyGolay(window, degree=4)))
    found = fp.probe(windowed, RHC, recording=path)
    assert found.dead_time["u"].low == found.dead_time["u"].high == 3
    assert found.gain["q"]["q"].low <= -2.0 <= found.gain["q"]["q"].high < 0
    assert found.noise["q"] == pytest.approx(noise, rel=0.1)
    assert (dict(found.facts)["noise of q, m"] == "not resolved") == (noise == 0)
    assert f"SavitzkyGolay delays the response by {window / 2 - 1:g} cycles more" in " ".join(found.notes)


def test_coupled_bodies_have_a_gain_matrix(tmp_path):
    """Every entry within its interval, of the columns' own inputs; exchanged inputs have an eigenvalue of -1: refused."""
    gains = np.array([[0.2, 0.8], [0.7, -0.3]])
    found = fp.probe(recorded(tmp_path / "run.csv", gains, 1, 0.0, 0.05), RHC, recording=tmp_path / "run.csv")
    for row, name in zip(gains, "qp", strict=True):
        for value, interval in zip(row, found.gain[name].values(), strict=True):
            assert interval.low <= value <= interval.high
            assert interval.value == pytest.approx(value, abs=0.06)
    assert {one.value for one in found.dead_time.values()} == {1}
    assert found.deformation is None
    assert "wrong sign" in found.why


def test_an_excited_run_finds_what_suits_the_plant():
    """Lateness that is stated or not is found; the plant as estimated predicts; what is chosen helps on the plant itself."""
    gain, dead, lag = 1.6, 2, 0.03
    problem = replace(body_problem(gain, dead, lag, 0.1), duration=1.5)
    assert isinstance(problem.reality, fp.ExternalPlant)
    late, lagging = fp.DeadTime(inputs={"u": dead * PERIOD}), replace(problem.reality, lag={"u": lag})
    stated = replace(problem, reality=lagging, dead_time=late)
    adaptive, left = replace(RHC, deformation=fp.ModelReferenced(fp.Affine(gain=-0.2))), dict[str, int]()
    found = fp.probe(stated, adaptive, cycles=150, progress=lambda what, n, of: left.update({what: of - n}))
    assert (set(left.values()), "ModelReferenced, as it is" in found.trials) == ({0}, True)
    assert all(n.endswith((f"gain {c.effective_gain() / -0.5:.4g}", "as it is")) for n, c in found.candidates.items())
    assert found.dead_time["u"].value == dead
    assert found.gain["q"]["q"].low <= gain <= found.gain["q"]["q"].high
    assert found.lag["u"].low <= lag <= found.lag["u"].high
    assert found.problem is not None
    assert found.problem.dead_time.inputs == {"u": pytest.approx(dead * PERIOD)}
    real = replace(problem, duration=found.problem.duration, measure_from=found.problem.measure_from)
    predicted, true = (error(one, fp.Identity()) for one in (found.problem, real))
    assert predicted == pytest.approx(true, rel=0.1)
    assert error(problem, found.deformation) < 0.6 * error(problem, fp.Identity())
    assert all(name.startswith(type(one).__name__) for name, one in found.candidates.items())
    assert all(t.worst <= 1.03 for n, t in found.trials.items() if found.candidates[n] == found.deformation)
    unstated = fp.probe(problem, RHC, cycles=150, amplitude=2.0, trials=False)
    assert dict(unstated.facts)["amplitude of q, m/s^2"] == "2"
    assert ("cycles=0" in unstated.lines) == ("do not state dead_time" in " ".join(unstated.notes))


def test_lost_samples_are_in_no_estimate():
    """A value that is held in the place of a lost one would be taken for noise."""
    problem = replace(body_problem(1.6, 2, 0.03, 0.1), sensing=fp.Sensing({"q''": fp.Sensor(dropout=0.2)}))
    assert fp.probe(problem, RHC, cycles=150, amplitude=2.0, trials=False).noise["q"] == pytest.approx(0.1, rel=0.1)


def error(problem: fp.Problem, deformation: Deformation | None) -> float:
    assert deformation is not None
    run = fp.simulate(problem, replace(RHC, deformation=deformation), seed=1, compiled=False)
    return np.inf if run.stop else fp.measure(problem, run).rms_error["q"]


@pytest.mark.slow
def test_intervals_contain_the_truth_in_nineteen_of_twenty_records(tmp_path):
    missed, path = 0, tmp_path / "run.csv"
    for seed in range(20):
        found = fp.probe(recorded(path, -1.5, 2, 0.03, 0.3, seed), RHC, recording=path)
        pairs = (found.gain["q"]["q"], -1.5), (found.dead_time["u"], 2), (found.lag["u"], 0.03)
        missed += not all(one.low <= true <= one.high for one, true in pairs)
    assert missed <= 1


@pytest.mark.slow
def test_coupled_bodies_are_offered_a_gain_matrix():
    """Directions with gains of 1.3 and .2: the matrix is the inverse of the gains."""
    problem = replace(body_problem([[0.8, 0.6], [0.5, 0.7]], 0, 0.0, 0.02), duration=2.0)
    found = fp.probe(problem, RHC, cycles=150)
    weighted = {n: one for n, one in found.candidates.items() if one.form.weights is not None}
    assert weighted
    for one in weighted.values():
        product = np.array(one.form.weights) @ np.array([[0.8, 0.6], [0.5, 0.7]])
        assert product == pytest.approx(np.eye(2), abs=0.15)


WRONG_RECORDS = {
    "it lacks columns for q; its columns are time, u, q'": "time,u,q'\n0,0,0\n0.01,0,0\n",
    "not 0.01 s apart": "time,u,q,q',q''\n0,0,0,0,0\n0.02,0,0,0,0\n",
    "row 1 of numbers has 'x' for q'": "time,u,q,q',q''\n0,0,0,x,0\n",
    "Expected 5 fields in line 3, saw 6": "time,u,q,q',q''\n0,0,0,0,0\n0,0,0,0,0,0\n",
    "1 cycles are too few": "time,u,q,q',q''\n0,0,0,0\n",
    "expected a line of names": "",
    "the input 'u' never changes, so nothing can be known of its gain": "time,u,q,q',q''\n"
    + "".join(f"{k * PERIOD:.2f},4,{k % 3},{k % 5},{k % 7}\n" for k in range(200)),
}


@pytest.mark.parametrize("words", WRONG_RECORDS)
def test_a_wrong_recording_says_what_is_wrong(tmp_path, words):
    (tmp_path / "run.csv").write_text(WRONG_RECORDS[words])
    with pytest.raises(fp.FpirhcError, match=words):
        fp.probe(body_problem(1.0), RHC, recording=tmp_path / "run.csv")


# Wrong uses of an external plant and of a probe, as a newcomer makes them, each with its whole message

PROBLEM = body_problem(1.0)


class Silent(Body):
    """Its reset returns nothing."""

    def reset(self, seed: int) -> Any:
        del seed


def outside(**settings: Any) -> Any:
    """The task with another external plant."""
    given: dict[str, Any] = {"body": Body(np.array([[1.0]])), "measures": QUANTITIES} | settings
    return replace(PROBLEM, reality=fp.ExternalPlant(**given))


WRONG: dict[str, tuple[Any, str]] = {
    "a function for a body": (
        lambda: outside(body=lambda command: command),
        "ExternalPlant: its body is a value of the class function without reset and step; expected an object with "
        "reset(seed) and step(time, command)",
    ),
    "a body of another period": (
        lambda: outside(period=2e-2),
        "reality: one step of it takes 0.02, and the problem's period is 0.01; write both alike",
    ),
    "a start that returns nothing": (
        lambda: fp.simulate(outside(body=Silent(np.array([[1.0]]))), RHC, seed=0, compiled=False),
        "reality: reset of Silent returned None, expected 3 numbers: q, q', q''",
    ),
    "a parameter of a plant outside that has none": (
        lambda: fp.Cases({"heavy": {"exact.mass": 2.0}}).problem("heavy", PROBLEM),
        "cases: case 'heavy', 'exact.mass': no parameter of what moves is called 'mass'. No names are valid here.",
    ),
    "a negative amplitude": (
        lambda: fp.probe(PROBLEM, RHC, amplitude=-1.0),
        "probe(amplitude=-1.0): expected a number of at least 0, in the unit of the signal",
    ),
    "settings of an excitation beside a recording": (
        lambda: fp.probe(PROBLEM, RHC, recording="run.csv", cycles=300),
        "cycles is of an excitation, and a recording has been excited: leave one of them out",
    ),
    "the amplitude of an input": (
        lambda: fp.probe(PROBLEM, RHC, amplitude={"u": 1.0}),
        "probe(amplitude=...): 'u' is unknown. Valid: q.",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_use_is_told_in_one_message(name):
    """What, where, what was expected, the nearest name, and how to mend it; the place in the file comes before it."""
    use, message = WRONG[name]
    with pytest.raises(fp.FpirhcError) as caught:
        use()
    assert re.sub(r"^\S+\.py, line \d+: ", "", str(caught.value)) == message
