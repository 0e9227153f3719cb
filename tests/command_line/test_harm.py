"""A gentle plain form around a model that is nearly right is worse than no adaptation; every command that runs it says so first."""

from __future__ import annotations

import json
import re
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import abroad
import pytest

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.symbolic.native import Native

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


TERMINAL = {"FORCE_COLOR": "1", "TERM": "xterm", "COLUMNS": "4000"}


@pytest.fixture
def file(tmp_path, monkeypatch) -> Path:
    """A folder with the file, and a terminal with colours and wide lines."""
    monkeypatch.chdir(tmp_path)
    for name, value in TERMINAL.items():
        monkeypatch.setenv(name, value)
    Path("line.py").write_text(FILE)
    return Path("line.py")


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> tuple[str, Path]:
    """What a comparison of the file prints, and its results."""
    folder = tmp_path_factory.mktemp("compared")
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as printed:
        patch.chdir(folder)
        for name, value in TERMINAL.items():
            patch.setenv(name, value)
        Path("line.py").write_text(FILE)
        assert main(["compare", "line.py", "--no-compile"]) == 0
    return printed.getvalue(), folder / "results" / "line"


def shown(capsys, *words: str) -> str:
    """What a command prints, without progress bars."""
    assert main(list(words)) == 0
    return str(capsys.readouterr().out)


def red(text: str) -> list[str]:
    """The red lines."""
    return [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in text.splitlines() if line.startswith(RED)]


LOSES = r"- CTC\+gentle does not help: it raises the rms error of y from (\S+) to (\S+) m \((\S+) times more\)"
FAILS = r"- Null test \(the approximate model as plant\): failed, CTC\+gentle is worse than (CTC.*) although"


def test_a_pair_that_is_no_headline_stands_in_red_before_the_table(compared):
    """Both reasons are there, the run and the null test; the good pair has no red line."""
    printed, results = compared
    before, title, _ = printed.partition("line, from t = 1 s")
    assert title
    first, second = red(before)
    lost = re.match(LOSES, first)
    assert lost
    assert float(lost[2]) > 2 * float(lost[1])
    assert re.match(FAILS, second)
    assert red(printed) == [first, second]
    facts = json.loads((results / "results.json").read_text())
    assert facts["outcome"] == "better"
    assert [test["harmful"] for test in facts["null_tests"]] == [False, True]
    assert facts["null_tests"][1]["pair"] == ["CTC", "CTC+gentle"]
    assert facts["null_test"] == facts["null_tests"][0]
    page = (results / "report.html").read_text()
    assert page.count("class='outcome-worse'") == 2


def test_a_run_of_it_says_the_same_as_its_comparison(file, compared, capsys):
    """The numbers are those of the comparison; a controller that helps has no red line."""
    printed = shown(capsys, "run", "line.py", "CTC+gentle", "--no-compile")
    alone = [line.replace("CTC+gentle without adaptation", "CTC") for line in red(printed)]
    assert alone == red(compared[0])
    assert printed.startswith(RED)
    assert red(shown(capsys, "run", "line.py", "CTC+model-referenced", "--no-compile")) == []
    assert red(shown(capsys, "run", "line.py", "CTC", "--no-compile")) == []
    assert main(["run", "line.py", "CTC+gentle", "--no-compile"]) == 0
    bars = capsys.readouterr().err
    assert all(
        f"\n{one}" in re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", bars).replace("\r", "\n")
        for one in ("CTC+gentle without", "null test")
    )


def test_a_run_with_another_gain_is_judged_with_it(file, capsys, monkeypatch):
    """The smaller the gain of the plain form, the more it harms; the compiler has two loops for all gains, with it and without."""
    factors, codes = [], set()

    def native(function, *_arguments, **_named):
        codes.add(function.serialize())
        return Native(function, False, "it is not called here")

    monkeypatch.setattr("fpirhc.simulation.simulate.native", native)
    for gain in (-0.9, -0.2, -0.05):
        printed = shown(capsys, "run", "line.py", "CTC+gentle", "--set", f"deformation.gain={gain}")
        factors += [float(match[3]) for match in [re.match(LOSES, red(printed)[0])] if match]
    assert (len(factors), len(codes)) == (3, 2)
    assert factors[2] > 3 * factors[1]
    assert factors[1] > 1.5 * factors[0]


def test_a_run_to_other_set_points_has_no_verdict_on_those_of_the_file(file, capsys):
    text = Path("line.py").read_text()
    steps = 'fp.Setpoint({"y": [(0.0, 0.0), (1.0, 0.1)]}, rate=6.0)'
    Path("line.py").write_text(text.replace('fp.Trajectory(lambda t: {"y": ca.sin(3 * t)})', steps))
    assert red(shown(capsys, "run", "line.py", "CTC+gentle", "--no-compile"))
    assert red(shown(capsys, "run", "line.py", "CTC+gentle", "--no-compile", "--set", "setpoints.y=0.5")) == []


def test_tuning_says_that_the_best_settings_do_harm(file, capsys):
    """The search may not leave small gains, and the best of them still loses."""
    pytest.importorskip("optuna")
    printed = shown(capsys, "tune", "line.py", "--trials", "2", "--no-compile")
    before, title, _ = printed.partition("line: 2 trials each")
    assert title
    assert re.match(LOSES, red(before)[0])
    assert re.match(FAILS, red(before)[1])
    [saved] = Path("results").rglob("tuning.json")
    assert main(["tune", "line.py", "--trials", "2", "--no-compile", "--json"]) == 0
    assert capsys.readouterr().out == saved.read_text()
    assert len(json.loads(saved.read_text())["controllers"]["CTC+gentle"]["harm"]) == 2


def test_review_puts_every_no_first_with_what_to_do(file, capsys):
    """A red line for each, before any other answer, under the name of its controller; all of them are below once more."""
    assert main(["review", "line.py", "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    noes = [(name, a) for name, group in facts["controllers"].items() for a in group if a["verdict"] == "no"]
    assert {name for name, _ in noes} == {"CTC+gentle"}
    assert [(one["about"], one["question"]) for one in facts["to_do"]] == [(n, a["question"]) for n, a in noes]
    assert main(["review", "line.py"]) == 1
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == "A mass on a line; the model has 2 % too little gain."
    wanted = [f"  no      {one['about']}: {one['question']} -> {one['what']}" for one in facts["to_do"]]
    assert lines[1 : len(wanted) + 2] == [*wanted, ""]
    assert all(one["what"].endswith(".") for one in facts["to_do"])
    assert sum(line.startswith("  no      ") for line in lines) == 2 * len(wanted)
    [null] = [one["what"] for one in facts["to_do"] if "right model alone" in one["question"]]
    assert null.startswith("The model-referenced form passes: in a run of at most 1000 cycles the rms error of y is ")


def test_a_review_without_a_no_begins_with_its_answers(file, capsys):
    assert main(["review", "line.py", "--controllers", "CTC+model-referenced"]) == 0
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in capsys.readouterr().out.splitlines()]
    assert lines[1] == "  yes     Is the problem well posed?"


def test_a_form_that_loses_with_the_wrong_model_is_not_proposed(tmp_path, monkeypatch, capsys):
    """do-mpc's reactor: the model-referenced form leaves a right model alone, and with the wrong one it loses to RHC alone."""
    text = (Path(abroad.__file__).parent / "cstr.py").read_text()
    monkeypatch.chdir(tmp_path)
    Path("reactor.py").write_text(text.replace("problem = task(reactor(1.0, 1.0))\nwrong =", "problem ="))
    main(["review", "reactor.py", "--controllers", "RHC+FPI", "--json"])
    answers = json.loads(capsys.readouterr().out)["controllers"]["RHC+FPI"]
    [form] = [a for a in answers if "form of the iteration" in a["question"]]
    found = re.search(
        r"but here with the wrong model the rms error of C_b is (\S+) mol/l without adaptation, (\S+) mol/l with it$",
        form["evidence"],
    )
    assert found
    assert form["change"] == "Keep the form that a comparison shows to be better."
    task = abroad.load("cstr", "wrong")
    bare = task.controllers["RHC"]
    referenced = bare.with_deformation(fp.ModelReferenced(task.controllers["RHC+FPI"].deformation))
    for controller, number in zip((bare, referenced), found.groups(), strict=True):
        run = fp.simulate(task.problem, controller, seed=0, compiled=False)
        assert fp.measure(task.problem, run).rms_error["C_b"] == pytest.approx(float(number), rel=0.01)
    [null] = [a for a in answers if "right model alone" in a["question"]]
    assert "form passes" not in null["change"]
    [gain] = [a for a in answers if "gain admissible" in a["question"]]
    assert gain["numbers"]["recommended"] is None
