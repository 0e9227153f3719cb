"""Maps over settings: every cell is a run, and where runs fail is what theory says."""

from __future__ import annotations

import csv
import io
import json
import shlex
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.cli.output import table_writer
from fpirhc.controllers.contract import Controller
from fpirhc.errors import FpirhcError, OutputError
from fpirhc.problem_files.problem_file import Task
from fpirhc.report.figures import sweep_figure, sweep_panels
from fpirhc.studies.scenarios.bench import Bench, ranges, relative_error
from fpirhc.studies.sweep import Axis, Sweep, sweep

RATE, PERIOD = 2.0, 0.02  # 1/s, s


def pump() -> fp.Problem:
    """Y' = b u with a model of gain 1, led from 1 m to rest at zero."""
    plant = fp.Plant(
        {"y": "m"},
        {"u": "V"},
        {"b": fp.Parameter(1.0, 1.0, "m/(s V)", bounds=(1e-6, 1e6))},
        lambda q, u, p: {"y": p.b * u.u},
        order=1,
    )
    still = fp.Trajectory(lambda t: {"y": 0 * t})
    return fp.Problem(plant, still, {"y": 1.0}, period=PERIOD, duration=40.0, measure_from=0.0)


LAW = fp.ComputedTorque(fp.Exponential(rate=RATE, integral=False))
ADAPTIVE = LAW.with_deformation(fp.ModelReferenced(fp.Affine(gain=-0.8)))
PLAIN = LAW.with_deformation(fp.Affine(gain=-0.8))


def task_of(**controllers: Controller) -> Task:
    return Task("pump", Path(__file__), "A pump", "", pump(), controllers or {"law": LAW, "FPI": ADAPTIVE})


def swept(folder: Path, *texts: str, task: Task | None = None, **settings) -> Sweep:
    axes = [Axis.parsed(text) for text in texts]
    return sweep(task or task_of(), axes, folder=folder, compiled=False, **settings)


def test_a_sampled_law_fails_from_its_limit_on(tmp_path: Path) -> None:
    """e+ = (1 - T b rate) e, and T rate = 0.04: decays below b = 50, and grows above."""
    found = swept(tmp_path, "exact.b=44:56:6").of("law")  # 44, 46.4, 48.8, 51.2, 53.6, 56
    assert list(found.outcomes == "finished") == [True] * 3 + [False] * 3


def test_a_cell_is_the_run_with_its_numbers(tmp_path: Path) -> None:
    found = swept(tmp_path, "exact.b=0.5:2:3", "deformation.map.gain=-1.2:-0.4:3").of("FPI")
    for i, b in enumerate((0.5, 1.25, 2.0)):
        for j, gain in enumerate((-1.2, -0.8, -0.4)):
            problem = pump().with_exact(np.array([b]))
            controller = LAW.with_deformation(fp.ModelReferenced(fp.Affine(gain=gain)))
            run = fp.simulate(problem, controller, seed=0, compiled=False)
            error = relative_error(fp.measure(problem, run), ranges(pump()))
            assert found.values[i, j] == pytest.approx(error, rel=1e-12)


def test_the_best_controller_of_a_cell_has_the_least_error(tmp_path: Path) -> None:
    """Adaptation costs nothing where the model is right, and there neither is better."""
    found = swept(tmp_path, "exact.b=0.25:1:4")
    law, adaptive = (found.of(name).values for name in ("law", "FPI"))
    assert list(found.winners[:3]) == [int(a < b) for a, b in zip(adaptive[:3], law[:3], strict=True)]
    assert law[3] == adaptive[3]
    assert found.winners[3] == -1
    assert [text for text, _ in found.view.sentences] == [
        "The error is best with: FPI in 3 of 4 cells.",
        "No controller fails anywhere.",
    ]


def test_a_controller_without_the_setting_is_the_same_along_it(tmp_path: Path) -> None:
    found = swept(tmp_path, "deformation.map.gain=-1:-0.5:3", "exact.b=0.5:2:2")
    law = found.of("law")
    assert law.without == ("deformation.map.gain",)
    assert (law.values == law.values[0]).all()
    assert len((tmp_path / "sweep.jsonl").read_text().splitlines()) == 1 + 2 + 6  # head, law, FPI


def test_what_cannot_be_live_is_built_anew_and_says_so(tmp_path: Path) -> None:
    """The order of a fractional law is the length of its memory's weights, which are numbers."""
    slow = fp.ComputedTorque(fp.Fractional(rate=2.0, order=0.8, memory=1.0))
    found = swept(tmp_path, "tracking.memory=1:3:3", task=task_of(slow=slow))
    assert found.of("slow").rebuilt == ("tracking.memory",)
    assert (
        "slow: tracking.memory cannot be live, so every value has a loop of its own"
        in found.view.lists["How it was run"]
    )
    for value, memory in zip(found.of("slow").values, (1.0, 2.0, 3.0), strict=True):
        run = fp.simulate(pump(), fp.ComputedTorque(fp.Fractional(2.0, 0.8, memory)), seed=0, compiled=False)
        assert value == pytest.approx(relative_error(fp.measure(pump(), run), ranges(pump())), rel=1e-12)


def test_a_gain_beyond_its_limit_is_refused_with_the_reason(tmp_path: Path) -> None:
    """The model-referenced form bears a lambda < 2, and lambda is 1 where b is."""
    found = swept(tmp_path, "deformation.map.gain=-9:-1:3").of("FPI")
    assert list(found.outcomes) == ["refused", "refused", "finished"]
    assert "(gain=-9)) is too large" in found.reasons["refused"]


def test_finished_cells_are_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = swept(tmp_path, "exact.b=0.5:2:3")
    monkeypatch.setattr(Bench, "record", lambda *_: pytest.fail("a cell was run again"))
    again = swept(tmp_path, "exact.b=0.5:2:3")
    assert [m.values.tolist() for m in again.maps] == [m.values.tolist() for m in first.maps]
    with pytest.raises(OutputError, match="holds results of something else"):
        swept(tmp_path, "exact.b=0.5:2:4")


def test_a_map_of_the_contraction_factor(tmp_path: Path) -> None:
    """|1 - a lambda| of every cell, with a of half the map's gain, and lambda the plant's b over the model's 1."""
    texts = ("deformation.gain=-0.8:-0.2:4", "exact.b=0.5:1.5:3")
    found = swept(tmp_path, *texts, task=task_of(FPI=PLAIN), metric="contraction.predicted").of("FPI")
    expected = 1 - 0.5 * np.outer([0.8, 0.6, 0.4, 0.2], [0.5, 1.0, 1.5])
    np.testing.assert_allclose(found.values, expected, rtol=1e-9)


def test_larger_is_better_where_the_figure_says_so(tmp_path: Path) -> None:
    """Time in a band: the table has the share as it is, and the best is the largest."""
    task = replace(task_of(), metrics=(*task_of().metrics, fp.figures.InBand("state.y", -0.1, 0.1)))
    found = swept(tmp_path, "exact.b=0.25:1:4", task=task, metric="in_band")
    told = [row["in_band"] for row in found.rows() if row["controller"] == "law"]
    assert told == sorted(told)
    assert 0 < told[0] < told[-1] <= 1


def test_a_run_that_diverged_wins_nothing(tmp_path: Path) -> None:
    """Its figure may be the smallest one, and stands in the rows alone."""
    found = swept(tmp_path, "exact.b=0.5:1:2", task=task_of(law=LAW, FPI=ADAPTIVE))
    lost = replace(found.maps[0], figures=np.array([1e-9, 1e-9]), outcomes=np.array(["diverged", "diverged"]))
    result = replace(found, maps=(lost, found.maps[1]))
    assert list(result.winners) == [1, 1]
    assert result.view.tables[0].rows[0].cells[2:] == ["none", "", ""]
    assert np.isnan(result.view.facts["maps"][0]["values"]).all()
    assert [row[result.aim.name] for row in result.rows()][:2] == [1e-9, 1e-9]


WRONG = {
    "deformation.gain": "expected PATH=LOW:HIGH:COUNT, or PATH=LOW:HIGH:COUNT:log, such as deformation.gain=-2:-0.1:40",
    "exact.b=1:1:5": "an empty range; expected two different finite ends and at least 2 values",
    "exact.b=1:2:1": "an empty range",
    "exact.b=1:inf:3": "an empty range",
    "exact.b=1:2:10000000000": "expected at most 1000000 values",
    "exact.b=-1:1:3:log": "equal factors need two ends of one sign that are not zero",
    "exact.b=1:2:3:lin": "expected PATH=LOW:HIGH:COUNT",
    "exact.bb=1:2:3": "'exact.NAME' has a parameter of what moves, and there is no 'bb'. Did you mean 'b'?",
    "mass.exact=1:2:3": "the problem has no parameter 'mass'. Valid: ",
    "exat.b=1:2:3": "neither the problem nor a controller has 'exat.b'. Did you mean 'exact'?",
    "b=1:2:3": "neither the problem nor a controller has 'b'. The parameter is 'exact.b'.",
    "deformation.map.gian=-2:-1:3": "has no 'gian'. Did you mean 'gain'?",
    "exact.b=-2:1:3": "-2",
}


def test_a_value_in_the_middle_that_the_problem_does_not_take_is_named(tmp_path: Path) -> None:
    """By the setting: a sweep has no cases of which anybody knows."""
    horizon, cost = fp.Horizon(stages=4, step=PERIOD), fp.Quadratic(states={"y": 1.0}, deviation={"u": 1e-3})
    task = replace(task_of(), problem=replace(pump(), horizon=horizon, cost=cost))
    with pytest.raises(FpirhcError, match=r"^horizon.stages = 6.5: .*Horizon.stages: expected a whole number"):
        swept(tmp_path, "horizon.stages=4:9:3", task=task)


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_axis_is_named(tmp_path: Path, text: str) -> None:
    with pytest.raises(FpirhcError) as refusal:
        swept(tmp_path, text)
    assert WRONG[text] in str(refusal.value)


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        ((), "a sweep has one setting or two, got 0"),
        (("exact.b=1:2:2", "start.y=0:1:2", "period=0.01:0.02:2"), "a sweep has one setting or two, got 3"),
        (("exact.b=1:2:2", "b.exact=1:2:3"), "'exact.b' is given twice"),
    ],
)
def test_a_wrong_number_of_settings_is_named(tmp_path: Path, texts: tuple[str, ...], words: str) -> None:
    with pytest.raises(FpirhcError, match=words):
        swept(tmp_path, *texts)


def test_a_whole_number_has_whole_values(tmp_path: Path) -> None:
    with pytest.raises(FpirhcError, match=r"is a whole number, and the values are 1, 1.5, 2; choose another COUNT"):
        sweep(
            fp.load_problem("two_mass"),
            [Axis.parsed("optimiser.iterations=1:2:3")],
            folder=tmp_path,
            controllers=["RHC"],
        )


@pytest.mark.parametrize(
    "command", ["sweep two_mass --over exact.m1=1:2:2", "compare two_mass --scenarios 2 --mismatch 9"]
)
def test_parquet_without_pyarrow_is_refused_before_a_run(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: pytest.fail(name) if name != "pyarrow" else None)
    assert main([*command.split(), "--format", "parquet", "--out", str(tmp_path)]) == 2
    assert (
        "--format parquet needs pyarrow, which is not installed: pip install 'fpirhc[parquet]'"
        in capsys.readouterr().err
    )
    assert not list(tmp_path.iterdir())


def test_a_table_in_parquet_is_the_table_in_csv(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    table = swept(tmp_path, "exact.b=0.5:2:3").to_dataframe()
    for form, parts in (("csv", [table.iloc[:1], table.iloc[1:]]), ("parquet", [table])):
        table_writer(form)(parts, tmp_path / "sweep")
    kept = pd.read_parquet(tmp_path / "sweep.parquet")
    pd.testing.assert_frame_equal(kept, table)
    assert kept.attrs == {"units": {"exact.b": "m/(s V)"}}
    with_units = table.rename(columns={"exact.b": "exact.b [m/(s V)]"})
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "sweep.csv"), with_units)


def test_the_command_writes_table_page_picture_and_facts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["sweep", "two_mass", "--over", "deformation.gain=-1:-0.25:2", "--over", "m1.exact=0.8:1.2:2"]
    words += ["--controllers", "CTC", "CTC+FPI (eq 6)", "--no-compile", "--out", str(tmp_path)]
    assert main(words) == 0
    assert "without deformation.gain, and the same along it: CTC" in " ".join(capsys.readouterr().out.split())
    with (tmp_path / "sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    facts = json.loads((tmp_path / "results.json").read_text())
    assert [row["exact.m1 [kg]"] for row in rows[:4]] == ["0.8", "1.2", "0.8", "1.2"]
    assert [float(row["relative error"]) for row in rows[4:]] == facts["maps"][1]["values"]
    page = (tmp_path / "report.html").read_text()
    assert "Over deformation.gain and exact.m1" in page
    assert "data:image/png;base64," in page
    assert (tmp_path / "sweep.png").stat().st_size > 10_000
    # The command of a cell makes its run, also of one without the setting.
    cells = json.loads(page.partition("const SWEEP=")[2].partition(";\n")[0])
    assert [panel["centres"][1][1] > panel["centres"][1][0] for panel in cells["panels"]] == [True] * 3
    for law, place in ((0, (0, 1)), (1, (1, 0))):
        one, settings = cells["maps"][law], [axis["set"][k] for axis, k in zip(cells["axes"], place, strict=True)]
        kept = [text for text in settings if text.partition("=")[0] not in one["without"]]
        command = shlex.split(one["run"] + "".join(f" --set {text}" for text in kept) + cells["seed"])
        assert command[0] == "fpirhc"
        assert main([*command[1:], "--no-compile", "--out", str(tmp_path)]) == 0
        run = fp.load_run(tmp_path / f"{''.join(c if c.isalnum() else '_' for c in one['controller'])}.npz")
        problem, cell = fp.load_problem("two_mass").problem, 2 * place[0] + place[1]
        error = relative_error(fp.measure(problem, run), ranges(problem))
        assert facts["maps"][law]["values"][cell] == pytest.approx(error, rel=1e-9)
        assert one["cells"][cell].startswith("relative error ")


def test_a_cell_of_the_picture_is_where_the_page_looks_for_it(tmp_path: Path) -> None:
    """Cells that failed are grey there, and no other ones."""
    found = swept(tmp_path, "exact.b=10:90:5", "deformation.map.gain=-1.2:-0.4:3")
    figure = sweep_figure(found)
    assert figure.axes[-1].get_ylabel() == "relative error [%]"  # as in the table
    assert " m/(s V)" in found.view.tables[0].rows[0].cells[3]
    pixels = plt.imread(io.BytesIO(figure._repr_png_()))
    for panel, one in zip(sweep_panels(figure, found), found.maps, strict=False):
        for place in np.ndindex(one.values.shape):
            x, y = (panel["centres"][k][i] for k, i in enumerate(place))
            colour = pixels[round((1 - y) * pixels.shape[0]), round(x * pixels.shape[1]), :3]
            assert (np.ptp(colour) < 0.01) == (one.outcomes[place] != "finished"), (one.controller, place)
    assert 0 < found.of("law").failed < 1
