"""Studies whose runs are side by side say what the ordinary runs say, one after the other."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tasks

import fpirhc as fp
from fpirhc.errors import NoCode
from fpirhc.problem_files.problem_file import Task
from fpirhc.simulation.simulate import ComposedLoop, Simulator
from fpirhc.studies.scenarios import scenario_study
from fpirhc.studies.scenarios.bench import Bench, Conditions, ranges, relative_error
from fpirhc.studies.scenarios.draws import COMPARING
from fpirhc.studies.scenarios.scenario_study import LEDGER, compare_scenarios
from fpirhc.studies.sweep import Axis, sweep
from fpirhc.studies.tune import tune
from fpirhc.symbolic.native import Native, native

SMOOTH, ROUNDED = 1e-12, 1e-9  # relative; behind a quantum a last place is now and then a whole one
_RESIDUALS = ("stationarity", "feasibility")  # differences of large numbers: rounding is all that is in them
_SHORT: dict[str, Any] = {"duration": 2.0, "measure_from": 0.5}


def short(task: Task, **changes: Any) -> Task:
    return replace(task, problem=replace(task.problem, **{**_SHORT, **changes}))


noisy = cache(
    lambda: short(
        tasks.two_mass,
        disturbances={"q1": fp.Noise(0.3)},
        sensing=fp.Sensing({"q1": fp.Sensor(noise=fp.Noise(1e-4), dropout=0.05)}, fp.SavitzkyGolay(window=7, degree=4)),
    )
)
STUDIES: dict[str, Callable[[], tuple[Task, str, float]]] = {
    "computed torque": lambda: (short(tasks.two_mass), "CTC+FPI (eq 6)", SMOOTH),
    "plans": lambda: (short(tasks.two_mass), "RHC+FPI", SMOOTH),
    "noise and lost samples": lambda: (noisy(), "CTC", ROUNDED),
    "map": lambda: (tasks.fishery, "CTC+FPI", SMOOTH),
}


def numbers(record: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, value in record.items():
        if isinstance(value, Mapping):
            yield from numbers(value, (*path, name))
        else:
            yield (*path, name), value


def assert_equal(found: Mapping[str, Any], expected: Mapping[str, Any], close: float) -> None:
    """The same entries of the same types; whole numbers and texts alike, others to rounding."""
    one, other = dict(numbers(found)), dict(numbers(expected))
    assert one.keys() == other.keys()
    for path, value in other.items():
        assert type(one[path]) is type(value), path
        if not isinstance(value, float):
            assert one[path] == value, path
        elif not any(word in "".join(path) for word in _RESIDUALS):
            assert one[path] == pytest.approx(value, rel=close, abs=1e-14), path


@pytest.mark.parametrize("name", STUDIES)
def test_records_are_those_of_ordinary_runs(name: str) -> None:
    """Every metric, in every scenario with its own parameters and its own noise."""
    task, controller, close = STUDIES[name]()
    conditions = Conditions(seed=5, use=COMPARING, percent=10.0, compiled=True)
    bench, ordinary = Bench(task, replace(conditions, side_by_side=True)), Bench(task, conditions)
    records = list(bench.records(range(11), controller))
    assert not bench.apart
    for number in (0, 4, 7, 8, 10):
        assert_equal(records[number], ordinary.record(number, controller), close)


def test_a_record_does_not_depend_on_its_neighbours() -> None:
    """Bit by bit: so it is the same whoever computes it, and with whatever others."""
    bench = Bench(noisy(), Conditions(5, COMPARING, 10.0, True, side_by_side=True))
    together = list(bench.records(range(12), "RHC+FPI"))
    assert next(bench.records([9], "RHC+FPI")) == together[9]
    assert list(bench.records([11, 3], "RHC+FPI")) == [together[11], together[3]]
    assert not bench.apart


def test_a_run_that_ends_early_is_the_ordinary_one_and_its_neighbours_stay() -> None:
    """A gain far beyond its limit makes the iteration run away; the lane of the stable gain does not notice."""
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.BeyondLimit(fp.Affine(gain=-0.5)))
    task = short(tasks.two_mass, limits=fp.Limits())
    task = replace(task, controllers={"wild": controller})
    path, conditions = "deformation.map.gain", Conditions(0, COMPARING, 5.0, True)
    live = {"wild": (path,)}
    bench, ordinary = Bench(task, replace(conditions, side_by_side=True), live), Bench(task, conditions, live)
    gains = [-0.5, -9.0, -0.7]
    records = list(bench.records([0, 0, 0], "wild", [{path: gain} for gain in gains]))
    assert [one["outcome"] for one in records] == ["finished", "ended early", "finished"]
    assert records[1] == ordinary.record(0, "wild", {path: gains[1]})
    for k in (0, 2):
        assert_equal(records[k], ordinary.record(0, "wild", {path: gains[k]}), SMOOTH)


def test_a_metric_of_whole_runs_and_a_solver_are_told() -> None:
    """They run one after the other, with the same records."""
    middle = fp.Metric("middle", lambda _, run: float(np.median(run["error.q1"])))
    own = replace(short(tasks.two_mass), metrics=(*tasks.two_mass.metrics, middle))
    limited = short(tasks.two_mass, limits=fp.Limits(states={"q1": (-9.0, 9.0)}))
    conditions = Conditions(0, COMPARING, 5.0, True)
    for task, name, why in ((own, "CTC", "the metric 'middle' reads whole runs"), (limited, "RHC", "not written")):
        bench, ordinary = Bench(task, replace(conditions, side_by_side=True)), Bench(task, conditions)
        assert list(bench.records([0, 1], name)) == [ordinary.record(k, name) for k in (0, 1)]
        assert why in bench.apart[name]


def test_cases_of_one_loop_are_measured_each_by_its_own_problem() -> None:
    """Cases differ in what only metrics know: from when they measure, and the numbers of the problem that a function reads."""
    weight = fp.Metric(
        "weight", lambda problem, run: problem.plant.parameters["m1"].exact * run["time"].item(-1), reads=("time",)
    )
    changes = {f"{k}": {"exact.m1": 1.0 + 0.01 * k, "measure_from": 0.5 + k % 2} for k in range(16)}
    task = replace(short(tasks.two_mass), metrics=(*tasks.two_mass.metrics, weight), cases=fp.Cases(changes))
    conditions = Conditions(0, COMPARING, 0.0, True, named=True)
    bench, ordinary = Bench(task, replace(conditions, side_by_side=True)), Bench(task, conditions)
    records = list(bench.records(range(16), "CTC"))
    assert not bench.apart
    for number in (0, 1, 14, 15):
        assert_equal(records[number], ordinary.record(number, "CTC"), SMOOTH)


def test_one_case_that_cannot_be_summed_up_leaves_the_others_alone() -> None:
    """It runs as an ordinary run, and the records of the others are the same to the bit."""
    bench = Bench(noisy(), Conditions(5, COMPARING, 10.0, True, side_by_side=True))
    together = list(bench.records(range(4), "CTC"))
    lanes = next(iter(bench._lanes.values()))
    plain, odd = lanes._sums.start, bench._scenario(2).problem

    def start(problem: fp.Problem) -> np.ndarray:
        if problem is odd:
            raise NoCode("this problem does not say before a run what it needs")
        return plain(problem)

    object.__setattr__(lanes._sums, "start", start)
    apart = list(bench.records(range(4), "CTC"))
    assert [apart[k] for k in (0, 1, 3)] == [together[k] for k in (0, 1, 3)]
    assert_equal(apart[2], together[2], ROUNDED)


def test_a_loop_without_lanes_is_built_once_for_every_run_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that starts at its last solution needs a new loop for every run, and no second one to ask for lanes."""
    made: list[object] = []
    simulator = ComposedLoop.simulator

    def counted(*given: Any, **named: Any) -> Simulator:
        made.append(given)
        return simulator(*given, **named)

    monkeypatch.setattr(ComposedLoop, "simulator", counted)
    monkeypatch.setattr("fpirhc.simulation.simulate.Simulator.remembers", True)
    own = replace(
        short(tasks.two_mass),
        metrics=(fp.Metric("middle", lambda _, run: float(np.median(run["error.q1"]))), *tasks.two_mass.metrics),
    )
    bench = Bench(own, Conditions(0, COMPARING, 5.0, True, side_by_side=True))
    for block in bench.blocks("CTC", range(4)):
        list(bench.records(block, "CTC"))
    assert bench.apart
    assert len(made) == 5  # one of them asked for lanes


def test_what_a_figure_reads_is_kept() -> None:
    """Figures of a problem file are functions of one signal, of which every cycle is kept."""
    task = replace(short(tasks.two_mass), metrics=(*tasks.two_mass.metrics, fp.figures.InBand("state.q1", -1.0, 1.0)))
    conditions = Conditions(0, COMPARING, 5.0, True)
    bench, ordinary = Bench(task, replace(conditions, side_by_side=True)), Bench(task, conditions)
    [record] = bench.records([3], "CTC")
    assert not bench.apart
    assert_equal(record, ordinary.record(3, "CTC"), SMOOTH)


def test_scenarios_side_by_side_are_those_one_after_the_other(tmp_path: Path) -> None:
    """Statistics, and the records of two processes bit by bit; what was begun one by one goes on so, and says it."""
    settings: dict[str, Any] = {"count": 70, "percent": 10.0, "seed": 2, "controllers": ["CTC", "CTC+FPI (eq 6)"]}
    task = tasks.two_mass
    lanes = compare_scenarios(task, folder=tmp_path / "lanes", **settings)
    plain = compare_scenarios(task, folder=tmp_path / "plain", **{**settings, "count": 12})
    assert not lanes.apart
    for name, some in plain.records.items():
        for record, expected in zip(lanes.records[name], some, strict=False):
            assert_equal(record, expected, SMOOTH)
    begun = compare_scenarios(task, folder=tmp_path / "plain", **settings)
    assert set(begun.apart) == {"CTC", "CTC+FPI (eq 6)"}
    assert [one[:12] for one in begun.records.values()] == list(plain.records.values())
    assert begun.records["CTC"][69] == Bench(task, Conditions(2, COMPARING, 10.0, True)).record(69, "CTC")
    compare_scenarios(task, folder=tmp_path / "two", processes=2, **settings)
    one, two = (sorted((tmp_path / f / LEDGER).read_text().splitlines()) for f in ("lanes", "two"))
    assert one == two


def test_a_sweep_side_by_side_is_the_sweep_of_single_runs(tmp_path: Path) -> None:
    """Parameters and a live gain, of which some values are refused."""
    axes = [Axis.parsed("deformation.gain=-3:-0.2:8"), Axis.parsed("exact.m1=0.5:2:8")]
    task = short(tasks.two_mass)
    lanes = sweep(task, axes, folder=tmp_path / "lanes", controllers=["CTC+FPI (eq 6)"]).maps[0]
    plain = sweep(task, axes, folder=tmp_path / "plain", controllers=["CTC+FPI (eq 6)"], compiled=False).maps[0]
    assert not lanes.apart
    assert (lanes.outcomes == plain.outcomes).all()
    assert {"finished", "refused"} <= set(lanes.outcomes.ravel())
    np.testing.assert_allclose(lanes.values, plain.values, rtol=SMOOTH)


def test_costs_of_a_search_are_those_of_single_runs(tmp_path: Path) -> None:
    spans = {"CTC+FPI (eq 6)": {"deformation.gain": fp.LogSpan(-1.2, -0.2)}}
    task = replace(short(tasks.two_mass), tuning=spans)
    settings: dict[str, Any] = {"trials": 3, "seed": 1, "count": 32, "percent": 10.0, "controllers": list(spans)}
    lanes = tune(task, folder=tmp_path / "lanes", **settings).entries[0]
    plain = tune(task, folder=tmp_path / "plain", **settings, compiled=False).entries[0]
    assert lanes.cost == pytest.approx(plain.cost, rel=SMOOTH)
    assert lanes.settings == pytest.approx(plain.settings, rel=SMOOTH)
    first = json.loads((tmp_path / "lanes" / "trials.jsonl").read_text().splitlines()[1])
    assert first["failures"] == 0


def test_lanes_keep_to_their_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs take turns where their noise needs more room, and are the same."""
    bench = Bench(noisy(), Conditions(5, COMPARING, 10.0, True, side_by_side=True))
    together = list(bench.records(range(20), "CTC"))
    monkeypatch.setattr("fpirhc.simulation.lanes._ROOM", 1)
    assert list(bench.records(range(20), "CTC")) == together


def test_a_map_over_starts_has_one_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The basin of a law: code is compiled once, cells are runs from their starts, which are side by side."""
    compiled: list[object] = []

    def counted(*given: Any, **named: Any) -> Native:
        compiled.append(given)
        return native(*given, **named)

    monkeypatch.setattr("fpirhc.simulation.simulate.native", counted)
    axes = [Axis.parsed("start.q1=1:3.4:4"), Axis.parsed("start.q1'=-4:4:4")]
    task = short(tasks.two_mass)
    found = sweep(task, axes, folder=tmp_path, controllers=["RHC"]).maps[0]
    assert len(compiled) == 1
    assert not found.apart
    for place in ((0, 0), (1, 3), (3, 1)):
        start = {"q1": axes[0].values[place[0]], "q1'": axes[1].values[place[1]]}
        problem = replace(task.problem, start={**task.problem.start, **start})
        run = fp.simulate(problem, task.controllers["RHC"], seed=0)
        error = relative_error(fp.measure(problem, run), ranges(task.problem))
        assert found.values[place] == pytest.approx(error, rel=SMOOTH)


def test_a_population_is_judged_as_its_members_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    """Every trial has the cost of a search that runs its trials one after the other in scenarios one after the other."""
    spans = {"CTC+FPI (eq 6)": {"deformation.gain": fp.LogSpan(-1.2, -0.2)}}
    task = replace(short(tasks.two_mass), tuning=spans)
    settings: dict[str, Any] = {"trials": 24, "seed": 1, "count": 3, "percent": 10.0, "population": 8}
    whole = tune(task, folder=tmp_path / "whole", **settings)
    plain = tune(task, folder=tmp_path / "plain", **settings, compiled=False)
    one, other = (
        [json.loads(line) for line in (tmp_path / name / "trials.jsonl").read_text().splitlines()[1:]]
        for name in ("whole", "plain")
    )
    assert [r["trial"] for r in one] == list(range(-1, 24))
    for record, expected in zip(one, other, strict=True):
        assert record["settings"] == pytest.approx(expected["settings"], rel=1e-9)
        assert record["cost"] == pytest.approx(expected["cost"], rel=1e-9)
    assert whole.entries[0].cost < whole.entries[0].cost_before
    assert plain.entries[0].settings == pytest.approx(whole.entries[0].settings, rel=1e-9)
    lines = (tmp_path / "whole" / "trials.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "trials.jsonl").write_text("".join(lines[:13]))  # in the middle of the second generation
    again = tune(task, folder=tmp_path / "cut", **settings)
    assert again.entries[0].cost == whole.entries[0].cost
    assert (tmp_path / "cut" / "trials.jsonl").read_text() == "".join(lines)


def test_a_worker_has_the_scenarios_of_a_register_for_all_controllers() -> None:
    """So it draws each once; runs that are one after the other are jobs of their own, which spread better."""
    seen: list[Any] = []

    class _Listening:
        def __enter__(self) -> None: ...
        def __exit__(self, *_: object) -> None: ...
        def answers(self, groups: Iterator[Any], own: object) -> Iterator[Any]:
            del own
            seen.extend(groups)
            return iter(())

    numbers = list(range(64))
    jobs = [(numbers, "CTC"), (numbers, "RHC"), ([64], "CTC"), ([64], "RHC")]
    bench = Bench(tasks.two_mass, Conditions(5, COMPARING, 10.0, True, side_by_side=True))
    assert not list(scenario_study._answers(bench, _Listening(), jobs))  # type: ignore[arg-type]
    assert seen == [jobs[:2], jobs[2:3], jobs[3:]]
