"""A gentle plain form around a model that is nearly right is worse than no adaptation; every command that runs it says so first."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from fpirhc.cli.main import main

RED = "\x1b[1;31m"
FILE = '''"""A mass on a line; the model has 2 % too little gain."""
import casadi as ca
import fpirhc as fp

plant = fp.Plant(
    coordinates={"y": "m"},
    inputs={"u": "N"},
    parameters={"b": fp.Parameter(approximate=1.0, exact=1.02, unit="1/kg")},
    response=lambda q, v, u, p: {"y": p.b * u.u - q.y},
)
problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}),
    start={"y": 0.0, "y'": 3.0},
    period=5e-3,
    duration=4.0,
    measure_from=1.0,
)
tracking = fp.Exponential(rate=6.0)
controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+model-referenced": fp.ComputedTorque(tracking, fp.ModelReferenced(fp.Affine(gain=-0.5))),
    "CTC+gentle": fp.ComputedTorque(tracking, fp.Affine(gain=-0.05)),
}
headline = ("CTC", "CTC+model-referenced")
tuning = {"CTC+gentle": {"deformation.gain": fp.Span(-0.05, -0.04)}}
'''


@pytest.fixture
def file(tmp_path, monkeypatch) -> Path:
    """A folder with the file, and a terminal with colours and wide lines."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "4000")
    Path("line.py").write_text(FILE)
    return Path("line.py")


def shown(capsys, *words: str) -> str:
    """What a command prints, without progress bars."""
    assert main(list(words)) == 0
    return str(capsys.readouterr().out)


def red(text: str) -> list[str]:
    """The red lines."""
    return [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in text.splitlines() if line.startswith(RED)]


LOSES = r"- CTC\+gentle does not help: it raises the rms error of y from (\S+) to (\S+) m \((\S+) times more\)"
FAILS = r"- Null test \(the approximate model as plant\): failed, CTC\+gentle is worse than (CTC.*) although"


def test_a_pair_that_is_no_headline_stands_in_red_before_the_table(file, capsys):
    """Both reasons are there, the run and the null test; the good pair has no red line."""
    printed = shown(capsys, "compare", "line.py", "--no-compile")
    before, title, _ = printed.partition("line, from t = 1 s")
    assert title
    first, second = red(before)
    lost = re.match(LOSES, first)
    assert lost
    assert float(lost[2]) > 2 * float(lost[1])
    assert re.match(FAILS, second)
    assert red(printed) == [first, second]
    facts = json.loads(Path("results/line/results.json").read_text())
    assert facts["outcome"] == "better"
    assert [test["harmful"] for test in facts["null_tests"]] == [False, True]
    assert facts["null_tests"][1]["pair"] == ["CTC", "CTC+gentle"]
    assert facts["null_test"] == facts["null_tests"][0]
    page = Path("results/line/report.html").read_text()
    assert page.count("class='outcome-worse'") == 2


def test_a_run_of_it_says_the_same_as_its_comparison(file, capsys):
    """The numbers are those of the comparison; a controller that helps has no red line."""
    compared = red(shown(capsys, "compare", "line.py", "--no-compile"))
    printed = shown(capsys, "run", "line.py", "CTC+gentle", "--no-compile")
    alone = [line.replace("CTC+gentle without adaptation", "CTC") for line in red(printed)]
    assert alone == compared
    assert printed.startswith(RED)
    assert red(shown(capsys, "run", "line.py", "CTC+model-referenced", "--no-compile")) == []
    assert red(shown(capsys, "run", "line.py", "CTC", "--no-compile")) == []


def test_a_run_with_another_gain_is_judged_with_it(file, capsys):
    """The smaller the gain of the plain form, the more it harms."""
    factors = []
    for gain in (-0.9, -0.2, -0.05):
        printed = shown(capsys, "run", "line.py", "CTC+gentle", "--no-compile", "--set", f"deformation.gain={gain}")
        factors += [float(match[3]) for match in [re.match(LOSES, red(printed)[0])] if match]
    assert len(factors) == 3
    assert factors[2] > 3 * factors[1]
    assert factors[1] > 1.5 * factors[0]


def test_tuning_says_that_the_best_settings_do_harm(file, capsys):
    """The search may not leave small gains, and the best of them still loses."""
    pytest.importorskip("optuna")
    printed = shown(capsys, "tune", "line.py", "--trials", "2", "--no-compile")
    before, title, _ = printed.partition("line: 2 trials each")
    assert title
    assert re.match(LOSES, red(before)[0])
    assert re.match(FAILS, red(before)[1])
    [saved] = Path("results").rglob("tuning.json")
    assert len(json.loads(saved.read_text())["controllers"]["CTC+gentle"]["harm"]) == 2
