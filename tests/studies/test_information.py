"""Every comparison says what its controllers measure and how often they act."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from plants import linear

import fpirhc as fp
from fpirhc.controllers.contract import Controller
from fpirhc.problem_files.problem_file import Task
from fpirhc.report.html import render
from fpirhc.report.terminal import show
from fpirhc.studies.comparison.comparison import Comparison
from fpirhc.studies.comparison.timing import CycleTime
from fpirhc.studies.view import to_json

PLAN = fp.FixedPoint(iterations=1, tolerance=1e-3)
TRACK = fp.Exponential(rate=4.0)
FILTER = fp.DisturbanceKalman({"y": 10.0}, {"y": 1e-3, "y'": 1e-2})
SEES_RESPONSE = replace(FILTER, measured={**FILTER.measured, "y''": 0.1})
CONTROLLERS: dict[str, Controller] = {
    "CTC": fp.ComputedTorque(TRACK),
    "CTC+FPI": fp.ComputedTorque(TRACK, fp.Affine(gain=-0.5)),
    "RHC": fp.RecedingHorizon(PLAN),
    "RHC+FPI": fp.RecedingHorizon(PLAN, fp.Affine(gain=-0.5)),
    "offset-free": fp.Estimating(fp.RecedingHorizon(PLAN), FILTER),
    "offset-free, at once": fp.Estimating(fp.RecedingHorizon(PLAN), SEES_RESPONSE, at_once=True),
}
MINUTES = replace(linear(1.0, 0.8), time_unit="min")
EXPECTED = {
    "CTC": (("y", "y'"), "in every cycle"),
    "CTC+FPI": (("y", "y'", "y''"), "in every cycle"),
    "RHC": (("y", "y'"), "with a new plan every 5 cycles"),
    "RHC+FPI": (
        ("y", "y'", "y''"),
        "with a new plan every 5 cycles, between plans its deformation acts in every cycle",
    ),
    "offset-free": (("y", "y'"), "with a new plan every 5 cycles, in which a new estimate takes effect"),
    "offset-free, at once": (
        ("y", "y'", "y''"),
        "with a new plan every 5 cycles, between plans its newest estimate acts in every cycle",
    ),
}


def compared(names: list[str], controllers: dict[str, Controller] = CONTROLLERS, **changes: Any) -> Comparison:
    settings: dict[str, Any] = {
        "plant": linear(1.0, 0.8),
        "reference": fp.Trajectory(lambda t: {"y": 0.3 * ca.sin(2 * t)}),
        "start": {"y": 0.0, "y'": 0.6},
        "period": 0.01,
        "duration": 0.3,
        "horizon": fp.Horizon(stages=5, step=0.05),
        "cost": fp.Quadratic(states={"y": 1e2, "y'": 1.0}, deviation={"u": 0.1}),
    }
    problem = fp.Problem(**(settings | changes))
    task = Task("line", Path("line.py"), "A line", "", problem, {n: controllers[n] for n in names})
    return fp.compare(task, seed=0, compiled=False)


@pytest.fixture(scope="module")
def everything() -> Comparison:
    return compared(list(CONTROLLERS))


@pytest.mark.parametrize("name", EXPECTED)
def test_what_a_controller_uses_and_when_it_acts(everything, name):
    """A measurement counts where the command depends on it; plans have their rate, and what acts between them is named."""
    known = everything[name].information
    assert known is not None
    assert (known.uses, known.rate) == EXPECTED[name]


def test_lines_stand_in_every_form_of_a_comparison(everything):
    """On the page, in JSON and in a notebook: what all are given, then groups of what differs."""
    first, *others = everything.information
    assert first == "all controllers are given y, y', y'' in every cycle of 0.01 s"
    assert "CTC, RHC, offset-free: use y, y'" in others
    assert "'CTC+FPI', 'RHC+FPI', 'offset-free, at once': use y, y', y''" in others
    assert "CTC, CTC+FPI: act in every cycle" in others
    document = json.loads(to_json(everything.view.facts))
    assert document["information"] == list(everything.information)
    assert document["controllers"]["RHC"]["measures"] == ["y", "y'"]
    page = render(everything)
    assert "in every cycle of <span class='number'>0.01 s</span>" in page
    assert "between plans its deformation acts in every cycle" in page
    assert "all controllers are given" in everything._repr_html_()


def test_every_form_says_when_a_controller_plans_and_what_share_of_a_period_that_takes(everything, capsys):
    """A plan every fifth cycle; the share is the time of a cycle with a plan over the period."""
    entry = replace(everything["RHC"], cycle=CycleTime(20.0, 70.0, 80.0, 90.0, 50.0))
    told = replace(everything, entries=(everything["CTC"], entry))
    sentence = "RHC plans every 5 cycles, every 0.05 s; a cycle that plans takes 50 us, 0.5 % of a period"
    assert told.planning == (sentence,)
    show(told.view, Path("report.html"))
    assert sentence in " ".join(capsys.readouterr().out.split())
    assert "<h3>When they plan</h3>" in render(told)
    assert sentence in re.sub("<.*?>", "", render(told))
    facts = json.loads(to_json(told.view.facts))["controllers"]
    assert facts["RHC"]["plans"] == {"cycles": 5, "share_of_period": pytest.approx(0.005)}
    assert facts["CTC"]["plans"] is None
    slow, [minutes] = replace(entry, cycle=replace(entry.cycle, planning=2e4)), compared(["RHC"], plant=MINUTES).entries
    assert replace(told, entries=(slow,)).planning[0].endswith("200 % of a period: plans are late on this machine")
    assert (
        replace(told, entries=(replace(entry, cycle=None),)).planning[0].endswith("the run is too short to time a plan")
    )
    assert replace(told, entries=(replace(minutes, cycle=entry.cycle),)).planning[0].endswith("0.00833 % of a period")


@pytest.mark.parametrize("name", ["RHC", "RHC+FPI", "Cascade"])
def test_the_rate_of_plans_is_that_of_the_run(name):
    """The planned input changes with a new plan and never between two, also behind a wrapper that hides how plans are made."""
    cascade = fp.Cascade(CONTROLLERS["RHC"], fp.Affine(gain=-0.1), fp.ThroughModel(lag=0.1))
    [entry] = compared([name], {**CONTROLLERS, "Cascade": cascade}).entries
    changes = 1 + np.flatnonzero(np.diff(entry.run["planned"].ravel()))
    assert set(np.diff(changes)) == {entry.plan_every} == {5}


def test_equal_controllers_share_one_line():
    lines = compared(["CTC"]).information
    assert lines[1:] == ("every controller uses y, y'", "every controller acts in every cycle")


def test_estimated_and_believed_states_are_said():
    """The position is measured late, the rest is estimated and believed."""
    sensing = fp.Sensing({}, fp.PositionDifference(), measured=["y"], observer=fp.ModelStates())
    lines = compared(["CTC"], sensing=sensing, dead_time=fp.DeadTime(measurement=0.02)).information
    assert lines[0] == (
        "all controllers are given y in every cycle of 0.01 s, 0.02 s late; PositionDifference estimates the response from them"
    )
    filter = fp.KalmanFilter(measured={"y": 1e-3}, noise={"y": 1.0})
    believed = compared(["CTC"], sensing=replace(sensing, observer=filter)).information
    assert believed[0].endswith("; y, y' are believed (KalmanFilter)")


def test_outputs_are_measured_beside_the_state():
    """Of a plant with outputs, these and their response are given; a controller without adaptation does not use the response."""
    task = fp.load_problem("anaesthesia")
    short = replace(task.problem, duration=20 * task.problem.period, measure_from=0.0)
    comparison = fp.compare(replace(task, problem=short), seed=0, controllers=["CTC", "CTC+FPI"], compiled=False)
    assert not comparison.skipped
    known = [comparison[name].information for name in ("CTC", "CTC+FPI")]
    assert all(known)
    uses = [one.uses for one in known if one]
    chains = short.plant.chains
    responses = {name + "'" * order for name, order in chains.items()}
    assert set(chains) <= set(uses[0])
    assert set(uses[1]) - set(uses[0]) == responses
