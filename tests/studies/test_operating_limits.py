"""Where controllers fail: limits that theory gives exactly, and what is said of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.controllers.contract import Controller
from fpirhc.errors import InvalidName, InvalidValue
from fpirhc.problem_files.problem_file import Task
from fpirhc.review.review import review
from fpirhc.simulation.simulate import simulator

RATE, PERIOD = 2.0, 0.02  # 1/s, s


def pump(**changes) -> fp.Problem:
    """Y' = b u with a model of gain 1, led from 1 m to rest at zero."""
    plant = fp.Plant(
        {"y": "m"},
        {"u": "V"},
        {"b": fp.Parameter(1.0, 1.0, "m/(s V)", bounds=(1e-6, 1e6))},
        lambda q, u, p: {"y": p.b * u.u},
        order=1,
    )
    settings = {
        "reference": fp.Trajectory(lambda t: {"y": 0 * t}),
        "start": {"y": 1.0},
        "period": PERIOD,
        "duration": 100.0,
        "measure_from": 80.0,
    }
    return fp.Problem(plant=plant, **{**settings, **changes})


LAW = fp.ComputedTorque(fp.Exponential(rate=RATE, integral=False))
ADAPTIVE = LAW.with_deformation(fp.ModelReferenced(fp.Affine(gain=-0.8)))


def task_of(problem: fp.Problem, **controllers: Controller) -> Task:
    return Task("pump", Path(__file__), "A pump", "", problem, controllers)


def limit_of(quantity: str, name: str = "", controller: Controller = LAW, problem: fp.Problem | None = None, **more):
    found = fp.operating_limits(task_of(problem or pump(), law=controller), over=[quantity], compiled=False, **more)
    return found.of("law", name or quantity)


def near(one, value: float, share: float = 0.03) -> bool:
    """Whether a value lies between what holds and what fails, or so near that a run cannot show it; both are 5 % apart."""
    return one.holds * (1 - share) <= value <= one.fails * (1 + share) and one.fails <= 1.051 * one.holds


def test_gain_of_the_plant_is_limited_by_the_sampled_law():
    """e+ = (1 - T b rate) e: stable up to b = 2 / (T rate)."""
    assert near(limit_of("b", "b up"), 2 / (PERIOD * RATE))


def test_gain_of_the_plant_is_limited_by_the_gain_of_the_map():
    """delta+ = (1 - a b) delta - a (b - 1) d beside y+ = y + T b (d + delta), d = -rate y; by itself the map bears b < 2 / a."""
    gain = ADAPTIVE.deformation.effective_gain()

    def radius(b: float) -> float:
        a, law = gain, np.array([-RATE, 0.0, 0.0])  # of (y, last delta, last d)
        delta = np.array([0.0, 1 - a * b, -a * (b - 1)])
        rows = [np.array([1.0, 0, 0]) + PERIOD * b * (law + delta), delta, law]
        return float(np.abs(np.linalg.eigvals(np.array(rows))).max())

    factors = np.geomspace(2, 10, 4000)
    limit = next(b for b in factors if radius(b) > 1)
    assert limit == pytest.approx(2 / gain, rel=0.1)
    assert near(limit_of("b", "b up", ADAPTIVE), limit)


def test_latency_is_limited_by_the_rate():
    """z^(n+1) - z^n + T rate has all roots inside as long as T rate < 2 sin(pi / (4 n + 2)): up to n = 38 cycles."""
    most = next(n for n in range(1, 100) if 2 * math.sin(math.pi / (4 * n + 6)) <= PERIOD * RATE)
    assert most == 38
    one = limit_of("latency")
    assert abs(one.holds / PERIOD - most) <= 1.01  # one cycle more or less grows too little in this run to show
    assert one.fails == pytest.approx(one.holds + PERIOD)


def test_period_is_limited_by_the_rate():
    """e+ = (1 - T rate) e: stable up to T = 2 / rate."""
    assert near(limit_of("period"), 2 / RATE)


def test_noise_is_limited_by_its_variance():
    """e+ = e - T rate (e + w): Var e = T rate s^2 / (2 - T rate), and the error is 0.1 of the range at s = 0.3 of it."""
    slow = {"period": 0.1, "duration": 1000.0, "measure_from": 20.0}
    problem = pump(reference=fp.Trajectory(lambda t: {"y": 0.5 * ca.sin(0.1 * t)}), start={"y": 0.0}, **slow)
    assert near(limit_of("noise", problem=problem, fails=0.1), 0.1 * math.sqrt(2 / (0.1 * RATE) - 1), 0.05)


@pytest.mark.parametrize("share", [1.2, 1.5])
def test_lost_samples_are_limited_by_the_held_command(share):
    """From sample to sample, n lost ones between, e' = (1 - share (1 + n)) e: stable where the mean of log |e' / e| is negative."""
    lost = np.arange(400)
    growths = np.log(np.abs(1 - share * (1 + lost)))
    limit = next(p for p in np.linspace(0.01, 0.9, 1000) if np.sum((1 - p) * p**lost * growths) > 0)
    assert near(
        limit_of("lost", controller=fp.ComputedTorque(fp.Exponential(share / PERIOD, integral=False))), limit, 0.05
    )


def moved_by_force(response) -> fp.Problem:
    """A body of order two, led from 5 cm or 0.05 rad to rest at zero."""
    gain = fp.Parameter(1.0, 1.0, "1", bounds=(1e-6, 1e6))
    return replace(pump(), plant=fp.Plant({"y": "1"}, {"u": "1"}, {"b": gain}, response), start={"y": 0.05})


def trolley() -> fp.Problem:
    """Y'' = b u."""
    return moved_by_force(lambda q, v, u, p: {"y": p.b * u.u})


def pendulum() -> fp.Problem:
    """Y'' = b u - 9.81 sin y - 0.2 y', which hangs."""
    return moved_by_force(lambda q, v, u, p: {"y": p.b * u.u - 9.81 * ca.sin(q.y) - 0.2 * v.y})


@pytest.mark.parametrize(
    ("problem", "controller"),
    [
        pytest.param(pump, LAW, marks=pytest.mark.slow),
        (pump, ADAPTIVE),
        pytest.param(trolley, LAW, marks=pytest.mark.slow),
        (trolley, ADAPTIVE),
        (pendulum, LAW),
        pytest.param(pendulum, ADAPTIVE, marks=pytest.mark.slow),
    ],
)
def test_limits_agree_with_the_margins_of_the_review(problem, controller):
    """One input, one gain: the factor of the plant's gain and the latency at which runs fail are the margins within 10 %."""
    one = problem()
    answers = review(one, {"law": controller}, mismatch=0.0, seed=0).controllers["law"]
    [numbers] = [answer.numbers for answer in answers if "delay_margin" in answer.numbers]
    gain = limit_of("b", "b up", controller, problem=one)
    late = limit_of("latency", controller=controller, problem=one)
    assert near(gain, numbers["gain_margin"], 0.1)
    assert late.holds * 0.9 <= numbers["delay_margin"] <= late.fails * 1.1


def test_mismatch_grows_from_the_model_through_the_problem():
    """The factor of 'b' is (exact / approximate)^f, up to the bounds of the parameter, which nothing needs to reach."""
    problem = pump()
    wrong = replace(problem.plant, parameters={"b": fp.Parameter(1.0, 2.0, "m/(s V)", bounds=(1e-6, 40.0))})
    found = limit_of("mismatch", problem=replace(problem, plant=wrong))
    assert found.holds == pytest.approx(math.log2(40.0), rel=0.02)
    assert found.fails == math.inf
    assert found.text == f"> {found.holds:.4g}"


def test_what_cannot_be_tried_has_its_reason():
    found = fp.operating_limits(task_of(pump(), law=LAW), over=["mismatch", "lost"], compiled=False)
    assert "the model is right; name a parameter, such as b" in found.untried["law", "mismatch"]
    with pytest.raises(InvalidName, match="the model is right"):
        found.of("law", "mismatch")
    assert found.to_dataframe()["fails"].tolist() == [found.of("law", "lost").fails]


def test_a_controller_that_fails_as_the_problem_stands():
    """Without feedback of the error a wrong start stays: the error is that of the start, all of the range."""
    open_loop = fp.ComputedTorque(fp.Exponential(rate=1e-9, integral=False))
    one = limit_of("lost", controller=open_loop)
    assert (one.text, one.why) == ("as it stands", "error of 100 %")
    assert math.isnan(one.holds)
    assert len(one.points) == 1


def test_a_state_that_leaves_its_limits_has_failed():
    """The error is small, and y passes the limit of 0.9 m that its reference keeps. Beside a limit of 0 its own size counts."""
    problem = pump(
        reference=fp.Trajectory(lambda t: {"y": 0.8 * ca.sin(t)}),
        start={"y": 0.0},
        limits=fp.Limits(states={"y": (-0.9, 0.9)}),
        duration=40.0,
        measure_from=0.0,
    )
    one = limit_of("latency", problem=problem)
    assert one.why == "y leaves its limits"
    assert {p.value: p.error for p in one.points}[one.fails] < 0.5
    touching = fp.Trajectory(lambda t: {"y": 0.4 * (1 - ca.cos(t))})
    above = replace(problem, reference=touching, limits=fp.Limits(states={"y": (0.0, math.inf)}))
    assert limit_of("latency", problem=above).holds > 0


def test_a_refusal_far_from_the_problem_is_a_limit(monkeypatch):
    """Plans that the optimiser refuses from some period on end there; one that is refused at once is not tried."""
    for least, text in ((0.15, "0.15"), (0.03, "")):

        def strict(problem, controller, least=least, **settings):
            if problem.period > least:
                raise InvalidValue(f"a period of {problem.period:g} s is too long; choose another")
            return simulator(problem, controller, **settings)

        monkeypatch.setattr("fpirhc.studies.operating_limits.simulator", strict)
        found = fp.operating_limits(task_of(pump(), law=LAW), over=["period"], compiled=False)
        if text:
            one = found.of("law", "period")
            assert one.holds <= least < one.fails <= 1.051 * one.holds
            assert one.why == f"a period of {one.fails:g} s is too long"
        else:
            assert found.untried == {("law", "period"): "a period of 0.04 s is too long; choose another"}


@pytest.mark.parametrize(
    ("wrong", "error", "says"),
    [
        ({"over": ["latncy"]}, InvalidName, "Did you mean 'latency'"),
        ({"fails": 0.0}, InvalidValue, "fails: expected a number above 0"),
    ],
)
def test_wrong_input_is_named(wrong, error, says):
    with pytest.raises(error, match=says):
        fp.operating_limits(task_of(pump(), law=LAW), **wrong)


def test_the_command_prints_and_saves_what_was_found(tmp_path, capsys):
    """The table says the limit, the file has every run, and the page has a picture and the command that makes it again."""
    file = tmp_path / "pump.py"
    file.write_text(PUMP)
    words = ["limits", str(file), "--over", "b", "--no-compile", "--out", str(tmp_path / "found")]
    assert main(words) == 0
    printed = capsys.readouterr().out
    facts = json.loads((tmp_path / "found" / "results.json").read_text())
    up, down = facts["limits"]
    assert (up["quantity"], down["quantity"]) == ("b up", "b down")
    assert f"law fails at {up['fails']:.4g} times" in printed
    assert up["holds"] in [value for value, _, why in up["runs"] if not why]
    slow = next(
        f for f in np.linspace(1, 4, 1000) if f / 8 * (1 - math.exp(-8 / f)) > 0.25
    )  # mean of e^2 = exp(-4 t / f) over 2 s
    assert down["holds"] * 0.98 <= slow <= down["fails"] * 1.02
    page = (tmp_path / "found" / "report.html").read_text()
    assert "Error against what grows" in page
    assert f"fpirhc limits {file} --seed 0 --over b --no-compile" in page
    assert (tmp_path / "found" / "limits.png").stat().st_size > 10_000


PUMP = """
'''A pump.'''
import fpirhc as fp

plant = fp.Plant(
    {"y": "m"}, {"u": "V"}, {"b": fp.Parameter(1.0, 1.0, "m/(s V)")}, lambda q, u, p: {"y": p.b * u.u}, order=1
)
problem = fp.Problem(
    plant=plant, reference=fp.Trajectory(lambda t: {"y": 0 * t}), start={"y": 1.0}, period=0.02, duration=2.0, measure_from=0.0
)
controllers = {"law": fp.ComputedTorque(fp.Exponential(2.0, integral=False))}
"""
