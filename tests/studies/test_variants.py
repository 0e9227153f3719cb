"""Variants of a problem: the same for every controller, each always the same one, and refused where they cannot be."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers.line import EXACT, line_text
from scipy import stats

import fpirhc as fp
from fpirhc.controllers.contract import believing
from fpirhc.errors import FpirhcError, InvalidProblem, InvalidValue
from fpirhc.plant.plant import exact_ranges
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.runs import run_variants
from fpirhc.studies.variants import CasesOf, Draws, Grid

CASES = """
cases = fp.Cases({
    "usual": {},
    "weak": {"exact.b": 0.9, "group": "light"},
    "known": {"known.b": 2.0, "group": "heavy"},
    "far": {"start.y": 1.0, "seed": 7},
})
"""
LINE = line_text(
    "period=5e-3, duration=1.5, measure_from=0.5, disturbances={'u': fp.Noise(0.1)}",
    bounds="(0.5, 2.4)",
    more=EXACT + CASES,
)


@pytest.fixture
def task(tmp_path, monkeypatch) -> Task:
    """The task in a file of its own, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(LINE)
    return fp.load_problem("line.py")


def drawn(task: Task, count: int = 8, percent: float = 20.0, seed: int = 3) -> list[tuple[int, tuple[float, ...]]]:
    """Seed of the noise and exact parameters of some drawn plants."""
    plants = Draws(count, percent, seed).of(task)
    return [(one.seed, tuple(one.problem.plant.exact.tolist())) for one in plants]


def test_a_drawn_plant_is_its_number(task):
    """Whatever the number of plants; another number or seed is another one, and a wider range the same share of it."""
    some, more, other = drawn(task), drawn(task, 20), drawn(task, seed=4)
    assert more[:8] == some
    assert not {*some} & {*other}
    assert len({seed for seed, _ in more}) == len({exact for _, exact in more}) == 20
    assert [seed for seed, _ in drawn(task, percent=10.0)] == [seed for seed, _ in some]
    assert all(one.problem is task.problem for one in Draws(3).of(task))  # noise alone, as of a body without parameters


def test_factors_are_log_uniform():
    """Logarithms of the factors are uniform between those of 0.6 and 1.4; signs and zeros stay."""
    values = {"a": 3.0, "b": -2.0, "zero": 0.0}
    plant = fp.Plant(
        {"y": "m"},
        {"u": "N"},
        {n: fp.Parameter(v, v, "1") for n, v in values.items()},
        lambda q, v, u, p: {"y": u.u + p.a * q.y + p.b * v.y + p.zero},
    )
    rest = fp.Trajectory(lambda t: {"y": 0 * t})
    problem = fp.Problem(plant=plant, reference=rest, start={"y": 0.0}, period=1e-2, duration=1.0)
    exact = np.array([one.problem.plant.exact for one in Draws(1500, 40.0).of_problem(problem)])
    assert np.all(exact[:, 2] == 0)
    low, high = math.log(0.6), math.log(1.4)
    for column, value in ((0, 3.0), (1, -2.0)):
        logarithms = np.log(exact[:, column] / value)
        assert low <= logarithms.min() < low + 0.01
        assert high - 0.01 < logarithms.max() <= high
        assert stats.kstest(logarithms, stats.uniform(low, high - low).cdf).pvalue > 0.01
    assert abs(np.corrcoef(exact[:, 0], exact[:, 1])[0, 1]) < 4 / math.sqrt(1500)


def test_draws_that_could_leave_physical_bounds_are_refused(task):
    """The parameter is named, with how far it may be drawn: b = 1.6 may grow by one half to its bound of 2.4."""
    exact_ranges(task.problem.plant, 49.9)
    with pytest.raises(InvalidProblem, match=r"parameter 'b'.*at most 50 %"):
        Draws(3, 51.0).of(task)
    for percent in (100.0, -1.0, math.nan):
        with pytest.raises(InvalidValue, match="at least 0 and below 100"):
            Draws(3, percent).of(task)
    with pytest.raises(InvalidProblem, match="parameter 'b': approximate is outside"):
        replace(task.problem.plant, parameters={"b": fp.Parameter(1.0, 2.5, "1/kg", (2.0, 3.0))})


@pytest.mark.parametrize("late", [fp.DeadTime(), fp.DeadTime(measurement=0.01), fp.DeadTime(inputs={"u": 0.02})])
def test_the_row_of_a_variant_is_the_run_of_a_fresh_loop(late, task):
    """Bit by bit, for every controller; dead times are drawn in whole cycles, and controllers believe those of the problem."""
    task = replace(task, problem=replace(task.problem, dead_time=late))
    draws = Draws(10, 20.0, 5)
    table = run_variants(task, draws, compiled=False).set_index(["controller", "variant"])
    times = set()
    for one in draws.of(task):
        drawn_times = one.problem.dead_time
        times.add(round((drawn_times.measurement or drawn_times.inputs.get("u", 0.0)) / one.problem.period, 9))
        for name, controller in task.controllers.items():
            told = believing(task.problem, controller)
            run = fp.simulate(one.problem, told, seed=one.seed, compiled=False)
            row = table.loc[name, one.name]
            assert row["rms_error.y"] == fp.measure(one.problem, run).rms_error["y"]
            assert row.seed == one.seed
    cycles = round((late.measurement or late.inputs.get("u", 0.0)) / task.problem.period)
    assert times == {0: {0.0}, 2: {1.0, 2.0, 3.0}, 4: {3.0, 4.0, 5.0}}[cycles]


def test_every_controller_meets_the_same_plants(task):
    """Pairing: one seed and one plant a variant, whichever controllers take part."""
    pair, alone = (
        run_variants(task, Draws(5, 20.0, 1), controllers=names, compiled=False)
        for names in (["CTC", "CTC+FPI"], ["CTC+FPI"])
    )
    assert pair.groupby("variant").seed.nunique().eq(1).all()
    own = pair.loc[pair.controller == "CTC+FPI"].reset_index(drop=True)
    pd.testing.assert_frame_equal(own, alone)


def test_cases_are_their_problems(task):
    """The run of a case is that of its problem; a seed of its own is its own, else it follows from its place among all cases."""
    table = run_variants(task, CasesOf(("all",), 2), controllers=["CTC"], compiled=False).set_index("variant")
    assert list(table.index) == ["usual", "weak", "known", "far"]
    for name, row in table.iterrows():
        problem = task.cases.problem(name, task.problem)
        run = fp.simulate(problem, task.controllers["CTC"], seed=row.seed, compiled=False)
        assert row["rms_error.y"] == fp.measure(problem, run).rms_error["y"]
    heavy = run_variants(task, CasesOf(("heavy",), 2), controllers=["CTC"], compiled=False)
    assert heavy.variant.tolist() == ["known"]
    assert heavy.seed[0] == table.seed["known"] != table.seed["usual"]
    assert table.seed["far"] == 7
    assert table.group.tolist() == ["", "light", "heavy", ""]


def test_a_cell_of_a_grid_is_the_run_with_its_numbers(task):
    """Settings of controllers and of the problem, live or built anew; a controller without a setting is the same along it."""
    grid = Grid.parsed(["deformation.gain=-0.8:-0.2:3", "exact.b=0.8:1.6:2:log"], seed=1)
    table = run_variants(task, grid, compiled=False)
    assert table.attrs["units"]["exact.b"] == "1/kg"
    assert table.attrs["units"]["rms_error.y"] == "m"
    for row in table.itertuples():
        gain, b = table.loc[row.Index, ["deformation.gain", "exact.b"]]
        controller = task.controllers[row.controller]
        own = fp.with_settings(controller, {"deformation.gain": gain}) if row.controller == "CTC+FPI" else controller
        problem = task.problem.with_exact(np.array([b, 5.0]))
        expected = fp.measure(problem, fp.simulate(problem, own, seed=1, compiled=False)).rms_error["y"]
        assert table.loc[row.Index, "rms_error.y"] == pytest.approx(expected, rel=1e-12)
    periods = run_variants(task, Grid.parsed(["period=5e-3:1e-2:2"]), controllers=["CTC"], compiled=False)
    assert periods["cycles"].tolist() == [300, 150]


def test_a_refused_cell_is_a_row(task):
    """A gain of the wrong sign is refused there, and the others have their numbers."""
    table = run_variants(task, Grid.parsed(["deformation.gain=-0.5:0.5:3"]), controllers=["CTC+FPI"], compiled=False)
    assert table.outcome.tolist()[::2] == ["finished", "refused"]
    assert "gain" in table.why[2]


WRONG = {
    "no span": (lambda t: Grid.parsed(["deformation.gain"]), "expected PATH=LOW:HIGH:COUNT"),
    "one value": (lambda t: Grid.parsed(["deformation.gain=-1:-0.1:1"]), "at least 2 values"),
    "the larger first": (lambda t: Grid.parsed(["deformation.gain=-0.1:-1:5"]), "the smaller one first"),
    "log across zero": (lambda t: Grid.parsed(["deformation.gain=-1:1:5:log"]), "one sign"),
    "another word": (lambda t: Grid.parsed(["deformation.gain=-1:1:5:lin"]), "'log' alone"),
    "a path twice": (lambda t: Grid.parsed(["tracking.rate=1:2:3"] * 2), "twice"),
    "three axes": (lambda t: Grid.parsed([f"{n}=1:2:3" for n in "abc"]), "one or two"),
    "a misspelt setting": (lambda t: Grid.parsed(["deformation.gian=-1:-0.1:5"]).of(t), "Did you mean 'gain'"),
    "a misspelt parameter": (lambda t: Grid.parsed(["exact.c=1:2:5"]).of(t), "Valid: b, k"),
    "an unknown case": (lambda t: CasesOf(("haevy",)).of(t), "Did you mean 'heavy'"),
    "no cases": (lambda t: CasesOf().of(replace(t, cases=None)), "has no cases; add to its file"),
    "no plant": (lambda t: Draws(0, 20.0).of(t), "expected at least 1"),
    "one plant many times": (
        lambda t: Draws(3).of(replace(t, problem=replace(t.problem, disturbances={}))),
        "would be the same: .* give --mismatch P",
    ),
    "an unknown controller": (lambda t: run_variants(t, Draws(1), controllers=["CTC+FPl"]), r"Did you mean 'CTC\+FPI'"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_is_named(wrong, task):
    make, message = WRONG[wrong]
    with pytest.raises(FpirhcError, match=message):
        make(task)
