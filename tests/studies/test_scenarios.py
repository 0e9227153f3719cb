"""Paired scenarios: the same for everyone, told as they are, and never lost, repeated or mixed."""

from __future__ import annotations

import json
import math
import os
import random
import shlex
import signal
import subprocess
import sys
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from line import EXACT, line_text
from scipy import stats

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.controllers.contract import resolved
from fpirhc.errors import InvalidProblem, InvalidValue, OutputError, WorkerDied
from fpirhc.plant.plant import exact_ranges
from fpirhc.problem_files.problem_file import Task
from fpirhc.review.grid import is_late, scaled
from fpirhc.studies.objective import Objective
from fpirhc.studies.scenarios import paired, parquet
from fpirhc.studies.scenarios.bench import Bench, Conditions, outcome, ranges, relative_error, scenario_numbers
from fpirhc.studies.scenarios.cluster import DEATHS, Workers
from fpirhc.studies.scenarios.draws import COMPARING, TUNING, draw, mismatch_of
from fpirhc.studies.scenarios.ledger import Ledger
from fpirhc.studies.scenarios.paired import Quantiles, median_interval, middle, share_interval, summarise, verdict
from fpirhc.studies.scenarios.scenario_comparison import _beside

LINE = line_text(
    "period=5e-3, duration=1.5, measure_from=0.5, disturbances={'u': fp.Noise(0.1)}", bounds="(0.5, 2.4)", more=EXACT
)
SETTINGS: dict[str, Any] = {"percent": 20.0, "seed": 5, "compiled": False}


@pytest.fixture
def task(tmp_path, monkeypatch) -> Task:
    """The task in a file of its own, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(LINE)
    return fp.load_problem("line.py")


def lines_of(folder: Path) -> list[str]:
    return (folder / "scenarios.jsonl").read_text().splitlines()


# --- Draws ------------------------------------------------------------------------------------------------------------


def test_a_scenario_is_its_number(task):
    """Drawn alone or among others it is the same; other numbers, seeds and uses are others."""
    plant = task.problem.plant

    def seventh(**changes):
        return draw(plant, **{"seed": 3, "use": COMPARING, "number": 7, "percent": 20.0, **changes})

    for number in range(20):
        draw(plant, seed=3, use=COMPARING, number=number, percent=20.0)
    first, again = seventh(), seventh()
    assert first.seed == again.seed
    np.testing.assert_array_equal(first.exact, again.exact)
    others = [seventh(number=8), seventh(seed=4), seventh(use=TUNING)]
    assert len({first.seed, *(o.seed for o in others)}) == 4
    assert all(np.all(o.exact != first.exact) for o in others)


def test_factors_are_log_uniform():
    """Logarithms of the factors are uniform between those of 0.6 and 1.4; signs and zeros stay."""
    values = {"a": 3.0, "b": -2.0, "zero": 0.0}
    plant = fp.Plant(
        {"y": "m"},
        {"u": "N"},
        {n: fp.Parameter(v, v, "1") for n, v in values.items()},
        lambda q, v, u, p: {"y": u.u + p.a * q.y + p.b * v.y + p.zero},
    )
    drawn = np.array([draw(plant, seed=0, use=0, number=k, percent=40.0).exact for k in range(1500)])
    assert np.all(drawn[:, 2] == 0)
    low, high = math.log(0.6), math.log(1.4)
    for column, value in ((0, 3.0), (1, -2.0)):
        logarithms = np.log(drawn[:, column] / value)
        assert low <= logarithms.min() < low + 0.01
        assert high - 0.01 < logarithms.max() <= high
        assert stats.kstest(logarithms, stats.uniform(low, high - low).cdf).pvalue > 0.01
    assert abs(np.corrcoef(drawn[:, 0], drawn[:, 1])[0, 1]) < 4 / math.sqrt(1500)


def test_draws_that_could_leave_physical_bounds_are_refused(task):
    """The parameter is named, with how far it may be drawn: b = 1.6 may grow by one half to its bound of 2.4."""
    exact_ranges(task.problem.plant, 49.9)
    with pytest.raises(InvalidProblem, match=r"parameter 'b'.*at most 50 %"):
        exact_ranges(task.problem.plant, 51.0)
    for percent in (100.0, -1.0, math.nan):
        with pytest.raises(InvalidValue, match="at least 0 and below 100"):
            exact_ranges(task.problem.plant, percent)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ((2.0, 3.0), "parameter 'b': approximate is outside"),
        ((3.0, 0.0), r"parameter 'b': .*\(lowest, highest\)"),
        (0.0, r"Parameter.bounds: expected \(a number, a number\)"),
    ],
)
def test_bounds_of_parameters_are_checked(bounds, message, task):
    plant = task.problem.plant
    with pytest.raises(InvalidProblem, match=message):
        replace(plant, parameters={**plant.parameters, "b": fp.Parameter(1.0, 2.5, "1/kg", bounds)})


def test_mismatch_is_a_distance():
    """Symmetric, zero for a right model, at most 1 for parameters of one sign; by hand: sqrt((0.5^2 + 0.25^2) / 2)."""
    model, plant = np.array([1.0, 4.0]), np.array([2.0, 3.0])
    assert mismatch_of(model, plant) == mismatch_of(plant, model) == pytest.approx(math.sqrt((0.25 + 0.0625) / 2))
    assert mismatch_of(model, model) == 0 == mismatch_of(np.zeros(2), np.zeros(2))
    assert mismatch_of(np.array([0.0]), plant[:1]) == 1


@pytest.mark.parametrize("dead_time", [fp.DeadTime(), fp.DeadTime(measurement=0.01)])
def test_a_prepared_loop_runs_what_a_fresh_one_runs(dead_time, task):
    """Bit by bit: exact parameters are data of the loop, also where a controller is told them or the measurement is late."""
    problem = replace(task.problem, dead_time=dead_time)
    bench = Bench(replace(task, problem=problem), Conditions(5, COMPARING, 20.0, compiled=False))
    for name, number in (("CTC+FPI", 0), ("CTC exact", 2), ("CTC+FPI", 1), ("CTC exact", 1)):
        result = bench.record(number, name)
        scenario = draw(problem.plant, seed=5, use=COMPARING, number=number, percent=20.0)
        late = scaled(problem, 20.0 * scenario.lateness) if is_late(problem) else problem
        variant = late.with_exact(scenario.exact)
        run = fp.simulate(variant, resolved(problem, task.controllers[name]), seed=scenario.seed, compiled=False)
        fresh = fp.measure(variant, run).values
        for metric, numbers in result["metrics"].items():
            assert numbers == {e: v if math.isfinite(v) else None for e, v in fresh[metric].items()}
        # Contraction needs the symbols along the run; a scenario does not compute them.
        assert set(fresh) - set(result["metrics"]) <= {
            "contraction.predicted",
            "contraction.growing",
            "contraction.measured",
        }


# --- Statistics -------------------------------------------------------------------------------------------------------


def test_interval_covers_the_median_as_often_as_it_says():
    """95 % intervals of the median of 25 log-normal numbers hold the true one in about 95 of 100 samples."""
    random = np.random.default_rng(0)
    intervals = [median_interval(Quantiles(random.lognormal(size=25)), seed=k) for k in range(200)]
    covered = np.mean([i.low <= 1.0 <= i.high for i in intervals])
    assert 0.90 <= covered <= 0.99
    assert all(i.low <= i.median <= i.high for i in intervals)


def test_medians_know_infinity():
    """An infinite number lies beyond all others, and half-way between the two infinities is zero."""
    assert middle(np.array([1.0, 2.0, math.inf])) == 2.0
    assert middle(np.array([1.0, math.inf, math.inf])) == math.inf
    assert middle(np.array([-math.inf, math.inf])) == 0.0
    assert middle(np.array([3.0, 1.0])) == 2.0


def _records(name, errors, outcome="finished"):
    return [
        {
            "scenario": k,
            "controller": name,
            "mismatch": 0.1,
            "outcome": "ended early" if e is None else outcome,
            "error": e,
            "metrics": {"rms_error": {"y": e}, "status": {"OK": 10}},
        }
        for k, e in enumerate(errors)
    ]


def test_differences_are_taken_within_scenarios():
    """Errors that vary by a factor of 100 between scenarios, and by one per cent of themselves between controllers."""
    errors = list(np.geomspace(0.001, 0.1, 41))
    plain, better = _records("A", errors), _records("B", [0.99 * e for e in errors])
    one = summarise("B", better, plain, seed=0)
    assert one.better == 41
    assert one.ratio == pytest.approx(0.99)
    assert one.difference is not None
    assert one.difference.median == pytest.approx(-0.01 * errors[20])
    assert one.difference.high < 0
    assert one.worst == pytest.approx(0.099)
    assert one.worst_scenario == 40
    sentences = verdict([summarise("A", plain, None, seed=0), one], {})
    assert sentences[0].startswith("B has a smaller error than A")


def test_failures_are_counted_and_are_worse_than_any_error():
    """A controller that fails in most scenarios has no median; where both fail there is no difference."""
    plain, failing = (
        _records("A", [0.1, 0.1, None, 0.1, 0.1, None]),
        _records("B", [0.01, None, None, None, 0.01, None]),
    )
    one = summarise("B", failing, plain, seed=0)
    assert one.median == math.inf == one.worst
    assert one.worst_scenario == 1
    assert one.failures == 4
    assert one.better == 2
    assert one.difference is not None
    assert one.difference.median == 0  # two gains, two ties, two losses
    sentences = " ".join(verdict([summarise("A", plain, None, seed=0), one], {"C": "no horizon"}))
    assert "B and A show no clear difference" in sentences
    assert (
        "B fails in 4 of 6 scenarios (4 ended early): 22.3 % to 95.7 % of what is drawn so, with 95 % confidence."
        in sentences
    )
    assert "Not run: C (no horizon)" in sentences


def test_a_figure_of_which_more_is_better_keeps_its_sign_in_files(task, tmp_path):
    """The share of a run in a band: what JSON has is that share, the lower end of an interval first."""
    inside = fp.Metric("inside", lambda problem, run: float((abs(run["error.y"]) < 0.05).mean()), better="larger")
    study = fp.compare_scenarios(
        replace(task, metrics=[*task.metrics, inside]), count=4, folder=tmp_path, headline="inside", **SETTINGS
    )
    told = study.view.facts["controllers"]["CTC+FPI"]
    shares = [r["metrics"]["inside"][""] for r in study.records["CTC+FPI"]]
    assert told["values"] == shares
    assert told["worst_error"] == min(shares) <= told["median_error"] <= max(shares)
    assert told["difference"]["low"] <= told["difference"]["median"] <= told["difference"]["high"]
    assert told["difference"]["high"] > 0


def test_a_table_in_parts_is_the_table(task, tmp_path):
    """All parts have the same columns and kinds of numbers, so that a file is written part by part and need not fit into memory."""
    study = fp.compare_scenarios(task, count=3, folder=tmp_path, **SETTINGS)
    whole, parts = study.to_dataframe(), list(study.frames(rows=2))
    assert [len(part) for part in parts] == [2] * (len(whole) // 2) + [1] * (len(whole) % 2)
    assert all((part.dtypes == whole.dtypes).all() and part.attrs == whole.attrs for part in parts)
    pd.testing.assert_frame_equal(pd.concat(parts, ignore_index=True), whole)
    assert whole["rms_error.y"].notna().all()


def test_parquet_files_are_the_ledger_whatever_became_of_them(task, tmp_path, monkeypatch):
    """Also where a file is torn, lost or of other records, and where a metric has its first number late."""
    pytest.importorskip("pyarrow")
    monkeypatch.setattr(parquet, "ROWS", 2)
    numbers = iter([None] * 4 + [1.0] * 20)
    late = fp.Metric("late", lambda problem, run: next(numbers), unit="m")
    task, files = replace(task, metrics=[*task.metrics, late]), tmp_path / "scenarios.parquet"
    for count in (1, 3, 6):
        study = fp.compare_scenarios(task, count=count, folder=tmp_path, parquet=True, **SETTINGS)
        kept, whole = (
            frame.sort_values(["controller", "scenario"], ignore_index=True).fillna({"stop": ""})
            for frame in (pd.read_parquet(files), study.to_dataframe())
        )
        pd.testing.assert_frame_equal(kept[whole.columns], whole, check_dtype=False)
        assert kept.attrs == whole.attrs
        for number, content in enumerate((b"torn", (files / "000000.parquet").read_bytes())):
            (files / f"{number + 7 * (count == 1):06}.parquet").write_bytes(content)


def test_other_flags_of_the_compiler_are_other_numbers(task, tmp_path, monkeypatch):
    """Levels of optimisation are not."""
    fp.compare_scenarios(task, count=2, folder=tmp_path, **SETTINGS)
    monkeypatch.setenv("FPIRHC_CFLAGS", "-O1")
    fp.compare_scenarios(task, count=3, folder=tmp_path, **SETTINGS)
    monkeypatch.setenv("FPIRHC_CFLAGS", "-O1 -mfma")
    with pytest.raises(OutputError, match='flags was "none", is "-mfma"'):
        fp.compare_scenarios(task, count=4, folder=tmp_path, **SETTINGS)


def test_a_run_that_failed_has_nothing_of_what_is_to_be_large():
    """Of nothing it is infinitely many times more, and of something none."""
    figure = Objective(fp.Metric("inside", lambda problem, run: 1.0, better="larger"))

    def records(share: float | None) -> list[dict[str, Any]]:
        return [{**r, "metrics": {**r["metrics"], "inside": {"": share}}} for r in _records("A", [share] * 5)]

    failed, fine = records(None), records(0.8)
    assert summarise("A", failed, fine, seed=0, figure=figure).ratio == 0.0
    assert summarise("A", fine, failed, seed=0, figure=figure).ratio == math.inf
    assert summarise("A", records(0.4), fine, seed=0, figure=figure).ratio == pytest.approx(0.5)
    negative = summarise("A", records(-0.4), records(-0.8), seed=0, figure=figure)  # its ratio would say the opposite
    assert math.isnan(negative.ratio)
    assert _beside(negative, figure)[1] == "none"


def test_failures_of_named_cases_are_no_sample():
    """Cases are what they are: a share of others cannot be said."""
    failing = summarise("B", _records("B", [0.01, None]), None, seed=0)
    sentences = verdict([failing], {}, "cases")
    assert "B fails in 1 of 2 cases (1 ended early)." in sentences


def test_that_nobody_failed_bounds_the_share():
    """1 - 0.05^(1/300) of all plants would show a failure in 95 of 100 studies: the rule of three, 3 / 300."""
    fine = summarise("A", _records("A", [0.1] * 300), None, seed=0)
    sentences = verdict([fine], {})
    assert (
        "A fails in none of 300 scenarios: in at most 0.994 % of what is drawn so, with 95 % confidence." in sentences
    )


@pytest.mark.parametrize(("count", "total"), [(1, 5), (3, 5), (2, 1000), (999, 1000)])
def test_the_share_of_failures_is_that_of_the_exact_binomial_test(count, total):
    exact = stats.binomtest(count, total).proportion_ci(0.95, "exact")
    assert share_interval(count, total) == pytest.approx((exact.low, exact.high), rel=1e-9)


def test_at_the_ends_the_whole_level_is_on_the_other_side():
    assert share_interval(0, 300) == pytest.approx((0.0, 1 - 0.05 ** (1 / 300)))
    assert share_interval(300, 300) == pytest.approx((0.05 ** (1 / 300), 1.0))


def test_an_error_as_large_as_the_motion_has_diverged(task):
    """Relative to the reference's range: 0.99 is an error, 1.01 is none; more coordinates count together."""
    run = fp.simulate(task.problem, task.controllers["CTC"], seed=0, compiled=False)
    assert [outcome(run.stop, error) for error in (0.99, 1.01, math.inf)] == ["finished", "diverged", "diverged"]
    assert outcome("signal 'x' is not finite", 0.0) == "ended early"
    sizes = ranges(task.problem)
    assert sizes == pytest.approx({"y": 1.0}, rel=1e-5)  # sin(2 t) from 0 to 1.5 s
    metrics = fp.measure(task.problem, run)
    assert relative_error(metrics, sizes) == pytest.approx(metrics.rms_error["y"] / sizes["y"])


def test_runs_that_end_early_or_stray_are_told_apart(task):
    """A model with nine tenths of the gain too little makes FPI stray; a response that leaves its range ends the run."""
    wild = fp.ComputedTorque(fp.Exponential(6.0), fp.BeyondLimit(fp.RFPT(offset=1e4, sign=-1.0, gain=1.0)))
    strays = replace(task, controllers={"wild": wild})
    record = Bench(strays, Conditions(0, COMPARING, 0.0, compiled=False)).record(0, "wild")
    assert record["outcome"] in ("diverged", "ended early")
    limited = replace(
        task.problem.plant, response=lambda q, v, u, p: {"y": p.b * u.u - p.k * q.y + 1e-9 * ca.sqrt(0.9 - q.y)}
    )
    ending = replace(task, problem=replace(task.problem, plant=limited))
    record = Bench(ending, Conditions(0, COMPARING, 0.0, compiled=False)).record(0, "CTC")
    assert record["outcome"] == "ended early"
    assert record["error"] is None
    assert 0 < record["lasted"] < 1
    json.dumps(record, allow_nan=False)


# --- Ledger -----------------------------------------------------------------------------------------------------------


def test_a_torn_line_is_cut_off_wherever_it_is_torn(tmp_path):
    """Cut after any byte, the file opens with every record whose line was whole, and takes new ones."""
    path, header = tmp_path / "l.jsonl", {"of": "this"}
    with Ledger(path, header) as ledger:
        for k in range(3):
            ledger.append({"k": k})
    whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with Ledger(path, header) as ledger:
            complete = max(0, whole[:size].count(b"\n") - 1)
            assert ledger.records == [{"k": k} for k in range(complete)]
            for k in range(complete, 3):
                ledger.append({"k": k})
        assert path.read_bytes() == whole


def test_records_reach_the_disk_in_groups(tmp_path, monkeypatch):
    """Other processes read a record at once; the disk is waited for after 100 records, after a second, and at the end."""
    forced, now = [], [0.0]
    monkeypatch.setattr(os, "fsync", lambda _: forced.append(now[0]))
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    path = tmp_path / "l.jsonl"
    with Ledger(path, {}) as ledger:
        forced.clear()
        for k in range(250):
            ledger.append({"k": k})
            assert path.read_bytes().count(b"\n") == k + 2
        assert len(forced) == 2
        now[0] = 1.5
        ledger.append({"k": 250})
        ledger.append({"k": 251})
        assert forced == [0.0, 0.0, 1.5]
    assert len(forced) == 4


@pytest.mark.parametrize("seed", range(3))
def test_records_of_a_file_are_what_they_were(seed, tmp_path):
    """Every value with its type and place, whatever forms follow each other; parts of all, and equality as of lists."""
    random_ = random.Random(seed)
    pool: list[Any] = [
        None,
        True,
        0,
        -1,
        127,
        128,
        -(2**31),
        2**40,
        2**70,
        0.1,
        -0.0,
        1e300,
        "",
        "a",
        "µ\0x",
        [1, "b"],
        {},
    ]

    def value(depth: int) -> Any:
        if depth and random_.random() < 0.3:
            return {f"k{k}": value(depth - 1) for k in range(random_.randrange(4))}
        return random_.choice([*pool, f"text {random_.random()}", random_.random()])

    wanted = [{f"n{k}": value(2) for k in range(random_.randrange(1, 6))} for _ in range(300)]
    with Ledger(tmp_path / "l.jsonl", {}) as ledger:
        for one in wanted:
            ledger.append(one)
    records = ledger.records
    assert repr(records) == repr(wanted)
    assert records == wanted
    assert records[5:50:7] == wanted[5:50:7]
    assert records.at([7, 3]) == [wanted[7], wanted[3]]
    (tmp_path / "l.jsonl").rename(tmp_path / "gone")
    with pytest.raises(OutputError, match="records stay in the folder of their study, so keep it"):
        records[0]
    (tmp_path / "gone").rename(tmp_path / "l.jsonl")
    assert (records[-1], len(records), records != wanted[1:]) == (wanted[-1], 300, True)
    with Ledger(tmp_path / "l.jsonl", {}) as again:
        assert again.records == wanted
    (tmp_path / "l.jsonl").unlink()
    with Ledger(tmp_path / "l.jsonl", {"seed": 1}) as other:
        for one in reversed(wanted):
            other.append(one)
    with pytest.raises(OutputError, match="holds the results of another study by now"):
        records[0]
    assert other.records == wanted[::-1]
    (tmp_path / "l.jsonl").unlink()
    with Ledger(tmp_path / "l.jsonl", {}) as anew:  # with the same first line
        for one in reversed(wanted):
            anew.append(one)
    with pytest.raises(OutputError, match="holds the results of another study by now"):
        records[0]


def test_a_record_takes_twelve_bytes(tmp_path):
    """Those of its place in the file and of its checksum, with the growth of arrays; nothing else of it stays."""
    with Ledger(tmp_path / "l.jsonl", {}) as ledger:
        for k in range(2000):
            ledger.append({"scenario": k, "name": f"{k}", "metrics": {"rms": {"q1": k / 7}, "status": {"OK": k}}})
    tracemalloc.start()
    try:
        with Ledger(tmp_path / "l.jsonl", {}) as ledger:
            assert len(ledger.records) == 2000
            taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert taken < 16 * 2000 + 10_000


def test_other_results_damage_and_other_users_are_refused(tmp_path):
    """Each with what differs, where, and what to do; the file stays as it was."""
    path = tmp_path / "l.jsonl"
    with Ledger(path, {"seed": 1, "version": "a"}) as ledger:
        ledger.append({"k": 0})
        ledger.append({"k": 1})
        if sys.platform != "win32":
            with pytest.raises(OutputError, match="in use by another run"):
                Ledger(path, {"seed": 1, "version": "a"})
    whole = path.read_bytes()
    with pytest.raises(OutputError, match=r"seed was 1, is 2\. Give another folder"):
        Ledger(path, {"seed": 2, "version": "a"})
    assert path.read_bytes() == whole
    path.write_bytes(whole.replace(b'{"k":0,', b'{"k":0'))
    with pytest.raises(OutputError, match="line 2 is damaged"):
        Ledger(path, {"seed": 1, "version": "a"})


# --- Processes --------------------------------------------------------------------------------------------------------

needs_kill = pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL on Windows")


@needs_kill
def test_killed_workers_are_replaced(tmp_path):
    """Every job is answered once, although workers die at four of them."""
    opening = {"folder": str(tmp_path), "deadly": [0, 3, 4, 11]}
    with Workers("mortal_worker", opening, opening, 2) as workers:
        assert sorted(workers.answers(list(range(12)))) == [2 * k for k in range(12)]
    assert len(list(tmp_path.iterdir())) == 4


@needs_kill
def test_a_job_that_kills_every_worker_is_given_up(tmp_path):
    """The job is named; nothing waits for ever."""
    opening = {"folder": str(tmp_path), "deadly": []}
    message = rf"{DEATHS} processes died one after the other at the job -1"
    with pytest.raises(WorkerDied, match=message), Workers("mortal_worker", opening, opening, 2) as workers:
        list(workers.answers([1, -1, 2]))


def test_a_worker_with_another_task_is_refused(task, tmp_path):
    """A task that is not as its file says cannot be shared with processes that read the file."""
    changed = replace(task, problem=replace(task.problem, duration=1.0))
    with pytest.raises(fp.FpirhcError, match="loaded another problem"):
        fp.compare_scenarios(changed, count=2, folder=tmp_path / "out", processes=2, **SETTINGS)


# --- The whole study --------------------------------------------------------------------------------------------------


def test_results_do_not_depend_on_processes_order_or_company(task, tmp_path):
    """Bit by bit: one process or two, all controllers or one, in one go or in two."""
    one = fp.compare_scenarios(task, count=4, folder=tmp_path / "one", **SETTINGS)
    two = fp.compare_scenarios(task, count=4, folder=tmp_path / "two", processes=2, **SETTINGS)
    assert two.records == one.records
    assert two.verdict == one.verdict
    assert sorted(lines_of(tmp_path / "one")) == sorted(lines_of(tmp_path / "two"))
    alone = fp.compare_scenarios(task, count=2, folder=tmp_path / "more", controllers=["CTC exact"], **SETTINGS)
    begun = lines_of(tmp_path / "more")
    more = fp.compare_scenarios(task, count=4, folder=tmp_path / "more", **SETTINGS)
    assert alone.records["CTC exact"] == one.records["CTC exact"][:2]
    assert more.records == one.records
    assert lines_of(tmp_path / "more")[: len(begun)] == begun
    assert len(lines_of(tmp_path / "more")) == 1 + 3 * 4


def test_adaptation_is_judged_against_the_baseline(task, tmp_path):
    """FPI is better than the wrong model in every scenario, and the informed controller is a bound."""
    study = fp.compare_scenarios(task, count=8, folder=tmp_path, baseline="CTC", **SETTINGS)
    plain, adaptive, informed = (study[n] for n in ("CTC", "CTC+FPI", "CTC exact"))
    assert plain.difference is None
    assert adaptive.better == informed.better == 8
    assert adaptive.difference is not None
    assert adaptive.difference.high < 0
    assert adaptive.statuses == {"OK": 8 * 300}
    assert len(set(plain.mismatch)) == 8
    reordered = fp.compare_scenarios(task, count=8, folder=tmp_path, baseline="CTC exact", **SETTINGS)
    assert reordered.summaries[0].name == "CTC exact"
    difference = reordered["CTC+FPI"].difference
    assert difference is not None
    assert difference.low > 0


CALM: dict[str, Any] = {"disturbances": {}}
LISTENS = {**CALM, "sensing": fp.Sensing({"y": fp.Sensor(fp.Noise(1e-3))})}
NOTHING_TO_DRAW = {**CALM, "plant": fp.Plant({"y": "m"}, {"u": "V"}, {}, lambda q, u, p: {"y": u.u}, order=1)}
LATE = {**NOTHING_TO_DRAW, "dead_time": fp.DeadTime({"u": 0.02})}


@pytest.mark.parametrize(("changes", "percent"), [(CALM, 0.0), (NOTHING_TO_DRAW, 20.0), (LATE, 0.0)])
def test_scenarios_that_cannot_differ_are_refused(changes, percent, task, tmp_path):
    """Without noise and without draws there is one scenario only, whatever the percentage is."""
    same = replace(task, problem=replace(task.problem, **changes))
    with pytest.raises(InvalidValue, match="every scenario would be the same"):
        fp.compare_scenarios(same, count=3, folder=tmp_path, percent=percent, seed=0)


@pytest.mark.parametrize(("changes", "percent"), [(LISTENS, 0.0), (CALM, 20.0), (LATE, 40.0)])
def test_scenarios_that_differ_in_one_thing_are_compared(changes, percent, task):
    """Noise of a sensor, a parameter or a dead time is enough."""
    other = replace(task, problem=replace(task.problem, **changes))
    assert list(scenario_numbers(other, 3, percent, None)) == [0, 1, 2]


def test_a_hundred_percent_is_the_whole_spread_on_the_command_line(task, capsys):
    """Where every parameter has one; a parameter without one keeps its sign, and that is said."""
    command = ["compare", "line.py", "--scenarios", "1", "--no-compile", "--controllers", "CTC", "--mismatch"]
    assert main([*command, "100"]) == 2
    assert "mismatch 100: expected percent of at least 0 and below 100, where" in capsys.readouterr().err
    spread = "spread=fp.Uniform(relative=0.2)"
    Path("line.py").write_text(LINE.replace("bounds=(0.5, 2.4)", spread).replace('"1/s^2")', f'"1/s^2", {spread})'))
    assert main([*command, "100"]) == 0


def test_a_controller_that_does_not_fit_is_skipped_with_its_reason(task, tmp_path):
    """The others are compared as ever; only its reason stands in the table."""
    planner = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3))
    wider = replace(task, controllers={**task.controllers, "RHC": planner})
    study = fp.compare_scenarios(wider, count=2, folder=tmp_path, **SETTINGS)
    assert "needs Problem(horizon=...)" in study.skipped["RHC"]
    assert [s.name for s in study.summaries] == ["CTC", "CTC+FPI", "CTC exact"]


ARGUMENTS = ["compare", "line.py", "--scenarios", "4", "--mismatch", "20", "--no-compile"]


def test_command_line_journey(task, capsys):
    """A report with the chart, a picture, a ledger and JSON; then more seeds, and a changed file that is refused."""
    assert main([*ARGUMENTS, "--json", "--out", "out"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["controllers"]["CTC+FPI"]["difference"]["high"] < 0
    assert len(document["controllers"]["CTC"]["errors"]) == 4
    page = Path("out/report.html").read_text()
    assert "Error against mismatch" in page
    assert "CTC+FPI and CTC have too few scenarios for an interval" in page
    assert Path("out/mismatch.png").stat().st_size > 10_000
    before = lines_of(Path("out"))
    assert main([*ARGUMENTS, "--scenarios", "5", "--out", "out", "--format", "csv"]) == 0
    assert "CTC+FPI" in capsys.readouterr().out
    assert lines_of(Path("out"))[: len(before)] == before
    rows = pd.read_csv("out/scenarios.csv")
    assert rows[rows.controller == "CTC"]["error"].tolist()[:4] == document["controllers"]["CTC"]["errors"]
    assert {"scenario", "mismatch", "outcome", "rms_error.y [m]", "settling.y [s]", "at_limit"} <= set(rows.columns)
    Path("line.py").write_text(LINE.replace("rate=6.0", "rate=7.0"))
    assert main([*ARGUMENTS, "--out", "out"]) == 3
    message = capsys.readouterr().err
    assert "never mixed: problem file was" in message
    assert "settings was" in message


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scenarios", "3", "--mismatch", "60"], "parameter 'b'"),
        (["--scenarios", "3", "--baseline", "CTC+FPY"], "Did you mean 'CTC+FPI'"),
        (["--scenarios", "3", "--optimisers", "all"], "cannot be combined"),
    ],
)
def test_bad_arguments(options, message, task, capsys):
    """One clear sentence and exit code 2."""
    assert main(["compare", "line.py", *options]) == 2
    assert message in capsys.readouterr().err


SCRIPT = """
import os, signal, sys
from pathlib import Path
import fpirhc as fp

def children():
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == os.getpid():
            yield int(stat.parent.name)

left = int(sys.argv[2])

def progress(name, done, total):
    global left
    left -= 1
    if left == 0:
        victims = [os.getpid()] if sys.argv[1] == "parent" else list(children())
        os.kill(victims[0], signal.SIGKILL)

task = fp.load_problem("line.py")
fp.compare_scenarios(
    task, count=6, percent=20.0, seed=5, compiled=False, folder=Path("killed"), processes=2, progress=progress
)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_kill_9_loses_and_doubles_nothing(task, tmp_path):
    """The parent dies after four results, and a worker of its successor after three: the end is that of a calm run."""
    calm = fp.compare_scenarios(task, count=6, folder=tmp_path / "calm", **SETTINGS)
    for victim, after, code in (("parent", 4, -signal.SIGKILL), ("worker", 3, 0)):
        done = subprocess.run([sys.executable, "-c", SCRIPT, victim, str(after)], check=False, capture_output=True)
        assert done.returncode == code, done.stderr.decode()
    assert sorted(lines_of(tmp_path / "killed")) == sorted(lines_of(tmp_path / "calm"))
    resumed = fp.compare_scenarios(task, count=6, folder=tmp_path / "killed", **SETTINGS)
    assert resumed.records == calm.records


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_thirty_random_kills(task, tmp_path):
    """Parents and workers, at any moment; no scenario is lost, none is doubled, and all numbers are those of a calm run."""
    moments, kills, count = random.Random(0), 0, 60
    while True:
        command = [sys.executable, "-m", "fpirhc", "compare", "line.py", "--scenarios", str(count), "--mismatch", "20"]
        command += ["--seed", "5", "--no-compile", "--processes", "2", "--out", "killed"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while kills < 30:
            try:
                process.wait(moments.uniform(0.3, 2.5))
            except subprocess.TimeoutExpired:
                victim = moments.choice([process.pid, *_children(process.pid)])
                try:
                    os.kill(victim, signal.SIGKILL)
                except ProcessLookupError:  # it ended by itself in between
                    continue
                kills += 1
            if process.poll() is not None:
                break
        if process.wait() == 0:
            if kills == 30:
                break
            count += 60  # too quick for thirty: go on with more
    fp.compare_scenarios(task, count=count, folder=tmp_path / "calm", **SETTINGS)
    assert sorted(lines_of(tmp_path / "killed")) == sorted(lines_of(tmp_path / "calm"))


def _children(parent: int) -> list[int]:
    collected = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == parent:
            collected.append(int(stat.parent.name))
    return collected


_ORDERS: dict[str, Any] = {
    "random": lambda numbers: np.random.default_rng(0).permutation(numbers),
    "rising": np.sort,
    "falling": lambda numbers: np.sort(numbers)[::-1],
    "inwards": lambda numbers: np.stack([np.sort(numbers), np.sort(numbers)[::-1]], axis=1).ravel()[: len(numbers)],
}


@pytest.mark.parametrize("order", _ORDERS)
@pytest.mark.parametrize("room", [8, 64])
def test_a_quantile_is_no_further_away_than_it_says(order, room):
    """Of numbers in any order, with infinite ones; the bound is small beside the count, and the memory beside the numbers."""
    numbers = np.random.default_rng(1).normal(size=10_000)
    numbers[:300], numbers[300:400] = np.inf, -np.inf
    numbers = _ORDERS[order](numbers)
    told, true = Quantiles(numbers, room=room), np.sort(numbers)
    for place in range(0, 10_000, 37):
        value = told.at(place)
        first, last = np.searchsorted(true, value, "left"), np.searchsorted(true, value, "right") - 1
        assert first - told.error <= place <= last + told.error
    assert told.error <= 10_000 * np.log2(10_000 / room) / room
    assert sum(map(len, told._buffers)) <= room * (1 + np.log2(10_000 / room))


def test_few_numbers_are_told_exactly():
    """As long as they fit into one buffer."""
    numbers = np.random.default_rng(2).normal(size=64)
    told = Quantiles(numbers, room=64)
    assert (told.error, told.median) == (0, np.median(numbers))
    assert [told.at(k) for k in range(64)] == np.sort(numbers).tolist()


def test_the_summary_of_many_scenarios_is_that_of_all(monkeypatch):
    """Counts and worst cases to the last scenario, medians and the ends of intervals within the places that it says."""
    random_ = np.random.default_rng(3)
    before, after = random_.lognormal(size=(2, 6000))
    after[17] = np.inf
    pair = [_records(name, [None if np.isinf(e) else e for e in some]) for name, some in (("A", before), ("B", after))]
    exact = summarise("B", pair[1], pair[0], seed=0)
    monkeypatch.setattr(paired, "Quantiles", lambda room=256: Quantiles(room=min(room, 256)))
    monkeypatch.setattr(paired, "_SHOWN", 100)
    told = summarise("B", pair[1], pair[0], seed=0)
    assert (exact.median, exact.scenarios.size) == (np.median(after), 3000)
    for name in ("count", "worst_scenario", "first_ended", "outcomes", "statuses", "better", "equal", "worst_metrics"):
        assert getattr(told, name) == getattr(exact, name), name
    assert exact.rank_error < 0.001 < told.rank_error < 0.02
    assert told.scenarios.tolist() == list(range(0, 6000, 64))
    assert told.errors.tolist() == after[::64].tolist()
    assert abs(np.mean(after < told.median) - 0.5) <= told.rank_error
    assert abs(np.mean(after < after[told.median_scenario]) - 0.5) < 0.05
    assert told.difference is not None
    assert exact.difference is not None
    differences = np.sort(after - before)
    places = [np.searchsorted(differences, end) / 6000 for end in (told.difference.low, told.difference.high)]
    wider = [np.searchsorted(differences, end) / 6000 for end in (exact.difference.low, exact.difference.high)]
    assert wider[0] - 2 * told.rank_error <= places[0] <= wider[0]
    assert wider[1] <= places[1] <= wider[1] + 2 * told.rank_error


@pytest.mark.parametrize("seed", [0, 20])
def test_the_ends_of_all_resamples_are_those_of_many(seed, monkeypatch):
    """The binomial distribution of a resample's median beside 4000 resamples: within two places of the sorted values."""
    values = np.sort(np.random.default_rng(seed).normal(size=2001))
    exact = paired.median_interval(Quantiles(values), seed=0)
    monkeypatch.setattr(paired, "_MANY", 10**9)
    drawn = paired.median_interval(Quantiles(values), seed=0)
    for one, other in ((exact.low, drawn.low), (exact.high, drawn.high)):
        assert abs(int(np.searchsorted(values, one)) - int(np.searchsorted(values, other))) <= 2
    assert exact.median == drawn.median


def test_a_scenario_is_run_once_more_by_the_command_of_the_report(tmp_path, capsys):
    """With its parameters, dead times and noise: the saved run has the error of the record."""
    task = fp.load_problem("two_mass")
    command = "fpirhc compare two_mass --scenarios 5 --mismatch 20 --controllers CTC"
    study = fp.compare_scenarios(
        task,
        count=5,
        percent=20.0,
        seed=4,
        folder=tmp_path / "study",
        controllers=["CTC"],
        compiled=False,
        command=command,
    )
    [worst, median] = study.view.lists["Scenarios to look at"]
    number = study["CTC"].worst_scenario
    assert worst == f"CTC, worst ({number}): fpirhc run two_mass CTC --scenario {number} --mismatch 20 --seed 4"
    assert median.startswith("CTC, median (")
    words = shlex.split(worst.partition(": fpirhc ")[2])
    assert main([*words, "--no-compile", "--out", str(tmp_path)]) == 0
    run = fp.load_run(tmp_path / f"CTC_scenario_{number}.npz")
    late = run.time >= task.problem.measure_from
    assert float(np.sqrt(np.mean(run["true_error.q1"][late] ** 2))) == pytest.approx(
        study.records["CTC"][number]["metrics"]["rms_error"]["q1"], rel=1e-12
    )
    capsys.readouterr()
