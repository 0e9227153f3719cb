"""The largest box of plants: a limit that theory gives exactly, the share of failing plants, and what is said of it."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from kinds import slow_but

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.errors import InvalidProblem, InvalidValue
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.operating_limits import Judge
from fpirhc.studies.robust import robust_boxes, wanted_draws
from fpirhc.studies.scenarios.scenario_study import compare_scenarios
from fpirhc.symbolic.native import find_compiler

RATE, PERIOD = 60.0, 0.02  # 1/s, s
EDGE = 2 / (RATE * PERIOD)  # e+ = (1 - T b rate) e is stable below this gain b of the plant, with a model of gain 1
LAW = fp.ComputedTorque(fp.Exponential(rate=RATE, integral=False))


def pump(exact: float = 1.0, **more) -> Task:
    """Y' = b u with a model of gain 1, led from 1 m to rest at zero."""
    gain = fp.Parameter(1.0, exact, "m/(s V)", **more)
    problem = fp.Problem(
        plant=fp.Plant({"y": "m"}, {"u": "V"}, {"b": gain}, lambda q, u, p: {"y": p.b * u.u}, order=1),
        reference=fp.Trajectory(lambda t: {"y": 0 * t}),
        start={"y": 1.0},
        period=PERIOD,
        duration=40.0,
        measure_from=30.0,
    )
    return Task("pump", Path(__file__), "A pump", "", problem, {"law": LAW})


@pytest.mark.slow
def test_the_search_finds_the_edge_that_theory_gives_and_drawn_plants_nearly_do():
    found = robust_boxes(pump(), compiled=False)
    (box,) = found.boxes
    edge = 100 * (EDGE - 1)  # 66.7 %
    assert edge <= box.percent + 1
    assert box.fails_at == box.percent + 1
    assert box.percent < edge + 3
    if box.percent > edge:
        assert box.counterexample is not None
        assert box.counterexample.from_percent == math.ceil(edge)
        assert EDGE < box.counterexample.parameters["b"] <= 1 + box.percent / 100
    low, high = math.log1p(-box.percent / 100), math.log1p(box.percent / 100)
    assert max(high - math.log(EDGE), 0) / (high - low) <= found.risk  # the share of the box's plants that fails


def test_a_search_of_a_box_without_draws_in_its_corner_finds_the_plant_that_fails():
    """Few draws leave the corner out, so that the box is too large, and the search must see it."""
    found = robust_boxes(pump(), risk=0.6, confidence=0.5, seed=1, compiled=False)
    (box,) = found.boxes
    assert found.draws == wanted_draws(0.6, 0.5) == 6
    assert box.percent > 100 * (EDGE - 1)
    assert box.counterexample is not None
    assert box.counterexample.from_percent == math.ceil(100 * (EDGE - 1))
    frame, b = found.to_dataframe(), box.counterexample.parameters["b"]
    named = frame[["controller", "counterexample_from", "counterexample.b"]]
    assert named.to_numpy().tolist() == [["law", 67, b]]
    assert frame.attrs["units"]["counterexample.b"] == "m/(s V)"


@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
@pytest.mark.parametrize("noisy", slow_but([False, True], True))
def test_plants_side_by_side_have_the_box_of_plants_one_after_the_other(noisy, monkeypatch):
    """What a sentence says is run by itself then: less than half the draws of one box, the search's plants among them.

    Every plant has its own noise; the plant as it stands is run with all of it.
    """
    task = pump()
    if noisy:
        shaken = replace(
            task.problem, disturbances={"y": fp.Noise(1e-3)}, sensing=fp.Sensing({"y": fp.Sensor(fp.Noise(1e-3))})
        )
        task = replace(task, problem=shaken)
    asked: list[float] = []
    point = Judge.point

    def noted(self, value, *run):
        asked.append(value)
        return point(self, value, *run)

    monkeypatch.setattr(Judge, "point", noted)
    found = robust_boxes(task, risk=0.1, confidence=0.9)
    assert len(asked) < (0.5 + noisy) * found.draws
    alone = robust_boxes(task, risk=0.1, confidence=0.9, compiled=False)
    assert len(asked) > 4 * found.draws
    for one, other in zip(found.boxes, alone.boxes, strict=True):
        assert (one.percent, one.fails_at, one.why) == (other.percent, other.fails_at, other.why)
        assert one.counterexample == other.counterexample
        assert one.worst_drawn == pytest.approx(other.worst_drawn, rel=1e-12)


@pytest.mark.parametrize(("risk", "confidence"), [(0.05, 0.999), (0.01, 0.9999), (0.3, 0.5)])
def test_the_number_of_draws_is_the_smallest_one_that_the_bound_allows(risk, confidence):
    """P(all N hold though a share above the risk fails) <= (1 - risk)^N for one box, 99 times that for all."""
    draws = wanted_draws(risk, confidence)
    assert 99 * (1 - risk) ** draws <= 1 - confidence < 99 * (1 - risk) ** (draws - 1)


def test_a_plant_that_fails_as_it_stands_has_no_box():
    (box,) = robust_boxes(pump(exact=2.0), compiled=False).boxes
    assert math.isnan(box.percent)
    assert box.why
    assert robust_boxes(pump(exact=2.0), compiled=False).view.facts["boxes"][0]["fails_at"] == 0


def test_bounds_of_parameters_end_the_boxes():
    found = robust_boxes(pump(bounds=(0.9, 1.2)), risk=0.3, confidence=0.9, compiled=False)
    (box,) = found.boxes
    assert (box.percent, box.fails_at) == (10, math.inf)
    assert "box of 10 % fails, the largest that was tried; a search found none that fails" in found.view.sentences[0][0]


def test_equal_seeds_have_equal_answers():
    some: dict[str, Any] = {"risk": 0.3, "confidence": 0.9, "compiled": False}
    assert robust_boxes(pump(), **some, seed=1).boxes == robust_boxes(pump(), **some, seed=1).boxes


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"risk": 0.0}, "robust_boxes.risk: expected a number above 0 and below 1, got 0.0"),
        ({"confidence": 1.0}, "robust_boxes.confidence: expected a number above 0 and below 1, got 1.0"),
        ({"risk": 1e-7}, "needs 1.2e+08 plants per box: expected at most 100000, so a risk of at least 0.000115, or"),
        ({"risk": 1e-320}, "needs inf plants per box"),
        ({"fails": -1.0}, "robust_boxes.fails: expected a number above 0, got -1.0"),
    ],
)
def test_wrong_shares_are_named(wrong, message):
    with pytest.raises(InvalidValue, match=re.escape(message)):
        robust_boxes(pump(), **wrong)


def test_a_plant_without_anything_to_draw_and_an_unknown_controller_are_named():
    with pytest.raises(
        InvalidValue, match=r"problem 'pump' has no parameters or dead times that can be drawn: .*outside its bounds"
    ):
        robust_boxes(pump(bounds=(1.0, 2.0)))
    with pytest.raises(InvalidProblem, match="lav"):
        robust_boxes(pump(), controllers=["lav"])


def test_a_controller_that_cannot_serve_is_left_out_with_its_reason():
    task = pump()
    other = replace(
        task, controllers={"law": LAW, "plan": fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1))}
    )
    found = robust_boxes(other, risk=0.3, confidence=0.9, compiled=False)
    assert [box.controller for box in found.boxes] == ["law"]
    assert "horizon" in found.untried["plan"]


def test_the_command_prints_and_saves_what_was_found(tmp_path, capsys):
    words = "robust two_mass --controllers CTC --risk 0.3 --confidence 0.9 --out"
    assert main([*words.split(), str(tmp_path)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "CTC: no plant drawn from the box of" in printed
    facts = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert facts["draws"] == 20
    assert "at most 30 % of all plants of the box do, with 90 % confidence" in (tmp_path / "report.html").read_text(
        encoding="utf-8"
    )
    assert main(["robust", "two_mass", "--controllers", "CTCC", "--out", str(tmp_path)]) == 2
    assert "CTCC" in capsys.readouterr().err


def late(cycles: int, rate: float = 5.0) -> Task:
    """Y' = u behind a dead time that the law does not know; nothing else is drawn."""
    task = pump()
    plant = fp.Plant({"y": "m"}, {"u": "V"}, {}, lambda q, u, p: {"y": u.u}, order=1)
    times = fp.DeadTime({"u": cycles * PERIOD})
    law = fp.ComputedTorque(fp.Exponential(rate=rate, integral=False))
    return replace(task, problem=replace(task.problem, plant=plant, dead_time=times), controllers={"law": law})


COMPILES = pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=COMPILES)])
def test_a_box_holds_the_dead_times_that_a_comparison_draws(compiled, tmp_path):
    """e+ = e - T rate e[k - d] is stable for T rate < 2 sin(pi / (2 (2 d + 1))): with T rate = 0.1 up to d = 15."""
    (box,) = robust_boxes(late(10), risk=0.3, confidence=0.9, compiled=compiled).boxes
    edge = max(d for d in range(30) if 2 * math.sin(math.pi / (2 * (2 * d + 1))) > 5.0 * PERIOD)
    assert edge == 15
    assert (box.percent, box.fails_at) == (50, 51)
    drawn = {
        percent: compare_scenarios(
            late(10), count=6, percent=percent, seed=0, folder=tmp_path / f"{percent}", compiled=compiled
        )
        for percent in (box.percent, box.fails_at)
    }
    errors = {percent: max(r["error"] or math.inf for r in one.records["law"]) for percent, one in drawn.items()}
    assert errors[50] < 0.5 < errors[51]


def test_a_plant_that_fails_is_told_with_its_dead_time():
    """Few draws have no late one among them, and the search finds it."""
    (box,) = robust_boxes(late(10), risk=0.9, confidence=0.1, seed=16, compiled=False).boxes
    assert box.percent == 99
    assert box.counterexample is not None
    assert box.counterexample.from_percent == 51
    assert box.counterexample.dead_times == {"dead_time.inputs.u": pytest.approx(20 * PERIOD)}
