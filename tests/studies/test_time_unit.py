"""A plant whose time is in days says days: signals, metrics, pages, terminals, figures, studies and messages."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc.__main__ import main
from fpirhc.errors import InvalidProblem

SHORT = '''"""A tumour with a dose a day, for thirty days."""
from dataclasses import replace
import fpirhc as fp
task = fp.load_problem("tumour_daily")
problem = replace(task.problem, duration=30.0, measure_from=10.0)
controllers = {name: task.controllers[name] for name in ("RHC", "RHC+FPI")}
'''
UNIT, VELOCITY = "day", "ln(mm^3)/day"
SECONDS = re.compile(r"\d s\b|\[s\]|\b1/s\b|/s\^|[A-Za-z\)]/s\b| s\]")  # a number in seconds, or a unit that has them
ALLOWED = re.compile(r"took [\d.]+ s\.")  # wall time


def without_scripts(page: str) -> str:
    """The text of a page, without code, styles, pictures and wall times."""
    return ALLOWED.sub("", re.sub(r"<(script|style)>.*?</\1>|data:image[^']*", " ", page, flags=re.DOTALL))


def test_nothing_speaks_of_seconds(tmp_path, monkeypatch, capsys):
    """What commands print and write, a run's signals, units, short forms and figures."""
    monkeypatch.chdir(tmp_path)
    Path("daily.py").write_text(SHORT)
    said = []
    study = "study daily.py --draws 2 --mismatch 5% --out results/study"
    for command in (study, "review daily.py -c RHC"):
        assert main([*command.split(), *([] if "review" in command else ["--no-compile"])]) in (0, 1)
        said.append(ALLOWED.sub("", capsys.readouterr().out))
    said += [without_scripts(page.read_text(encoding="utf-8")) for page in Path("results").rglob("*.html")]
    said.append(Path("results/study/study.csv").read_text().splitlines()[0])
    assert f"[{UNIT}]" in said[-1]
    task = fp.load_problem("daily.py")
    run = fp.simulate(task.problem, task.controllers["RHC"], seed=0, compiled=False)
    first, metrics = task.problem.plant.names[0], fp.measure(task.problem, run)
    assert task.problem.time_unit == run.time_unit == run.unit("time") == metrics.units["settling"][first] == UNIT
    assert run.unit(f"desired.{first}") == f"{VELOCITY}^{task.problem.plant.orders[0]}".removesuffix("^1")
    assert run.to_dataframe().index.name == f"time [{UNIT}]"
    assert f"cycles of {task.problem.period:g} {UNIT}" in repr(run)
    labels = [text for axis in run.plot().axes for text in (axis.get_xlabel(), axis.get_ylabel(), axis.get_title())]
    assert any(f"[{UNIT}]" in label for label in labels)
    said += [*labels, *(f"[{unit}]" for unit in run.layout.units), repr(run), repr(metrics)]
    assert [text for text in said if SECONDS.search(text)] == []
    with pytest.raises(InvalidProblem, match=rf"{task.problem.period * 1.3:g} {UNIT} does not divide .* {UNIT}"):
        replace(task.problem, period=task.problem.period * 1.3)
    with pytest.raises(InvalidProblem, match="time_unit is ''"):
        replace(task.problem.plant, time_unit="")
