"""The command line as it is used: a table of journeys with exit codes and first lines, and what all commands share."""

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from helpers.line import line_text

import fpirhc as fp
from fpirhc.__main__ import main

pytest_plugins = ["pytester"]
ROOT = Path(__file__).resolve().parents[2]
COMMANDS = ["accept", "check", "compare", "doctor", "export", "list", "new", "probe", "review", "run", "study", "tune"]
HORIZON = """measure_from=0.5,
    horizon=fp.Horizon(stages=10, step=1e-2),
    cost=fp.Quadratic(states={"y": 100.0, "y'": 1.0}, deviation={"u": 1e-2}),
    limits=fp.Limits(inputs={"u": (-30.0, 30.0)}),
"""
PLANNERS = """controllers = {
    "RHC": fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-3)),
    "RHC+FPI": fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-3), fp.Sigmoid(gain=-0.5, scale=50.0)),
"""


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A working folder with a problem that is short."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(line_text("period=2e-3, duration=1.0, measure_from=0.5"))
    return tmp_path


def edited(old: str, new: str) -> Callable[[], None]:
    """Function that changes the problem file."""

    def edit() -> None:
        text = Path("line.py").read_text()
        assert old in text
        Path("line.py").write_text(text.replace(old, new))

    return edit


def receding() -> None:
    edited("measure_from=0.5,\n", HORIZON)()
    edited("controllers = {\n", PLANNERS)()


def recorded() -> None:
    task = fp.load_problem("line.py")
    run = fp.simulate(task.problem, task.controllers["CTC"], seed=0, compiled=False)
    columns = {"u": "command.u", "y": "state.y", "y'": "state.y'", "y''": "realised.y"}
    rows = zip(run.time, *(run[name] for name in columns.values()), strict=True)
    lines = [",".join(map(repr, map(float, row))) for row in rows]
    Path("run.csv").write_text("\n".join([",".join(["time", *columns]), *lines]))


TIGHT = edited('"u": (-30.0, 30.0)}', '"u": (-1.0, 1.0)}, states={"y": (0.8, 1.0)}')
WEAK = edited("measure_from", 'limits=fp.Limits(inputs={"u": (-0.01, 0.01)}), measure_from')
DIVERGING = edited("- p.k * q.y", "- p.k * q.y + 1e-9 * ca.sqrt(0.5001 - q.y)")
SPANS = 'tuning = {"CTC+FPI": {"deformation.gain": fp.LogSpan(-1.0, -0.1)}}'
TUNABLE = edited("controllers = {", f"{SPANS}\ncontrollers = {{")
PLAN = "fp.FixedPointSolver(iterations=1, tolerance=1e-3)"
IPOPT = '    "IPOPT": fp.RecedingHorizon(fp.Ipopt(tolerance=1e-6)),\n'
PRECISE = edited(f"{PLAN}),\n", f"fp.FixedPointSolver(tolerance=1e-6)),\n{IPOPT}")
OF_AN_END = edited(
    'fp.Quadratic(states={"y": 100.0, "y\'": 1.0}, deviation={"u": 1e-2})',
    """fp.CustomCost(
        lambda v: {"u": v.input.u**2}, terminal=lambda v: -v.state.y**2)""",
)  # bends down
BENDS = edited(f"{PLAN},", f"{PLAN[:-1]}, hessian=fp.ExactHessian()),")
TOO = '"Too": fp.ComputedTorque(tracking, fp.Sigmoid(gain=0.5, scale=1.0)'
WRONG_SIGN = edited("gain=-0.5)", f"gain=0.5, scale=1.0)), {TOO}")
INTERRUPTED = edited(
    "controllers = {",
    """metrics = [fp.Metric("last", lambda problem, run: stop(run))]
def stop(run):
    if run.controller == "CTC+FPI":
        raise KeyboardInterrupt
    return 1.0
controllers = {""",
)
FAST = edited("measure_from", 'limits=fp.Limits(states={"y\'": (-0.5, 0.5)}), measure_from')
WITH_CASES = edited("controllers = {", 'cases = fp.Cases({"soft": {"exact.k": 1.0}})\ncontrollers = {')
MASS = "A mass on a line with a wrong gain. Errors from t = 0.5 s on, seed 0."
RUN = "A mass on a line with a wrong gain."


def of_whole_run() -> None:
    """Every signal of a run is kept."""
    kept = fp.load_run("kept/CTC_FPI.npz")
    assert {name: len(kept[name]) for name in kept.layout}["deformed"] == len(kept["deformed.y"]) == 500


def of_whole_file() -> None:
    """The results are those of the whole file, also after a part of it has run."""
    facts = json.loads(Path("results/line/results.json").read_text())
    errors = {name: one["metrics"]["rms_error"]["y"] for name, one in facts["controllers"].items()}
    assert (errors["CTC+FPI"] < 0.9 * errors["CTC"], facts["seed"]) == (True, 3)


SLOWLY = "virtual machine, more slowly, because --no-compile was given"
# What is done before, the words, the exit code, what the first lines say, and what else is said. Those of a row follow one another.
JOURNEYS: dict[str, list[tuple[Any, ...]]] = {
    "help": [(None, "", 0, "Usage: fpirhc"), (None, "help run", 0, "Usage: fpirhc run"), (None, "--version", 0, "fpirhc 0.")],
    "list": [(None, "list", 0, "first examples")],
    "review": [
        (None, "review line.py -c CTC", 0, "CTC: 5 of 5 yes"),
        (edited("exact=1.6", "exact=-1.6"), "review line.py", 1, "problem"),
    ],
    "probe": [
        (None, "probe line.py --cycles 80 --no-trials", 0, "line: probe with CTC"),
        (recorded, "probe line.py --recording run.csv --json", 0, "{"),
        (None, "probe line.py --cycles 80 --chatter 1e-9 --no-trials", 1, "line: probe with CTC"),
        (None, "probe heat_exchanger", 2, "fpirhc: probe needs a controller that deforms the response"),
        (WEAK, "probe line.py --cycles 80", 2, "fpirhc: two runs of 80 cycles to excite the plant; then some"),
    ],
    "compare": [
        (None, "compare line.py --no-compile", 0, MASS),
        (None, "compare line.py --no-compile -c CTC CTC+FPI --set deformation.gain=-0.4 exact.k=4", 0, MASS),
        (None, "compare --controllers CTC --json line.py --no-compile", 0, "{"),
        (WRONG_SIGN, "compare line.py --no-compile", 2, "fpirhc: problem 'line': controllers 'CTC+FPI', 'Too'"),
    ],
    "kept": [
        (None, "run line.py CTC+FPI --no-compile --out kept", 0, RUN, SLOWLY),
        (of_whole_run, "study line.py --draws 1 --no-compile -c CTC", 0, "A mass on a line", SLOWLY),
        (None, "compare line.py --json --seed 3 --no-compile", 0, "{"),
        (of_whole_file, "compare line.py --no-compile -c CTC", 0, MASS, "results/line/part/report.html"),
        (of_whole_file, "compare line.py --no-compile", 0, f"{MASS}\n- CTC+FPI against CTC: better"),
    ],
    "left": [(FAST, "compare line.py --no-compile -c CTC", 0, f"{MASS}\n- The reference of", "- CTC violates a limit: y'")],
    "interrupted": [(INTERRUPTED, "compare line.py --no-compile", 130, MASS, "CTC+FPI (interrupted before it finished)")],
    "plans": [
        (None, "compare line.py --no-compile -c CTC --set exact.b=1e-3", 1, MASS),  # it does not follow
        (None, "compare line.py --plans", 2, "fpirhc: problem 'line' has no horizon, or none of CTC, CTC+FPI plans"),
        (edited("controllers = {\n", PLANNERS), "run line.py RHC", 2, "fpirhc: line.py, line 14: RecedingHorizon needs"),
        (None, "compare line.py -c RHC", 2, "fpirhc: line.py, line 14: RHC: RecedingHorizon needs Problem(horizon=...)"),
        (edited("measure_from=0.5,\n", HORIZON), "compare line.py --no-compile -c RHC", 0, MASS),
        (OF_AN_END, "compare line.py --plans -c RHC", 2, "fpirhc: FixedPointSolver needs a cost that"),
        (BENDS, "compare line.py --plans -c RHC+FPI", 0, "line, first horizon"),
    ],
    "run": [
        (None, "run line.py CTC --no-compile --out kept", 0, f"{RUN} CTC: errors from t = 0.5 s on, seed 0.\nrms"),
        (None, "run line.py", 2, "fpirhc: Missing argument 'CONTROLLER': one of CTC, CTC+FPI"),
        (None, "run lime.py", 2, "fpirhc: no file at 'lime.py'. Did you mean 'line.py'?"),
        (None, "run line.py CTC+FPI --draw 3 --mismatch 20% --no-compile", 0, ""),
        (DIVERGING, "run line.py CTC --no-compile", 4, ""),
        (None, "compare line.py --no-compile -c CTC CTC+FPI", 1, f"{MASS}\n- CTC does not finish: "),
    ],
    "study": [
        (None, "study line.py --draws 2 --mismatch 20% --no-compile", 0, "A mass on a line"),
        (None, "study line.py --draws 3 --mismatch 20% --no-compile --out twice", 0, "A mass on a line"),
        (None, "study line.py --draws 3 --mismatch 30% --no-compile --out twice", 3, "fpirhc: "),
        (None, "study line.py --over tracking.rate=2:6:3 exact.k=1:9:2:log -c CTC --no-compile", 0, "A mass on a line"),
        (None, "study line.py --margins latency --processes 1 -c CTC --no-compile", 0, "A mass on a line"),
        (WITH_CASES, "study line.py --cases soft --no-compile --json", 0, "{"),
        (None, "run line.py CTC --case soft --no-compile", 0, ""),
        (None, "run line.py CTC --case sof --no-compile", 2, "fpirhc: "),
    ],
    "tune": [
        (TUNABLE, "tune line.py --trials 2 --out tuned", 0, "controller"),
        (None, "tune line.py --trials 3 --out tuned --json", 0, '[{"controller":"CTC+FPI"'),
    ],
    "export": [
        (None, "export line.py CTC --out device --live tracking.rate --name arm", 0, "wrote "),
        (None, "export line.py CTC --out device", 3, "fpirhc: 'device' is not an empty folder"),
        (None, "export line.py CTC --out other --name 2nd", 2, "fpirhc: '2nd' cannot be the name"),
    ],
    "baselines": [
        (None, "check --no-compile", 6, "line: there is no baseline"),
        (None, "accept line.py --reason first --no-compile --seeds 2", 0, "baseline: baselines/line.json"),
        (None, "check --no-compile", 0, "line: 10 metrics hold"),
        (edited("2 * t", "3 * t"), "check line.py --no-compile", 5, "line: the problem file changed"),
        (lambda: Path("a.py").write_text("controllers = {"), "check --no-compile", 5, "line: the problem file changed"),
        (None, "accept line.py --reason faster --no-compile --seeds 2", 0, "baseline: baselines/line.json"),
        (None, "check line.py --no-compile", 0, "line: 10 metrics hold"),
        (lambda: Path("baselines/line.json").write_text("[]"), "check line.py --no-compile", 6, "line: 'line.json' is no whole"),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", JOURNEYS)
def test_journey(name, folder, monkeypatch, capsys):
    """Exit code, words, no traceback; a comparison fits on a screen, its verdict comes first, and what it prints is written."""
    monkeypatch.setenv("COLUMNS", "80" if name == "kept" else "100")
    for before, words, code, first, *more in JOURNEYS[name]:
        if before:
            before()
        found = main(shlex.split(words))
        printed = capsys.readouterr()
        said = printed.out if code not in (2, 3) else printed.err
        assert found == code, (words, printed)
        assert said.lstrip().startswith(first), (words, said)
        assert [one for one in more if one not in printed.out + printed.err] == []
        assert "Traceback" not in printed.err
        if first == "{" and words.startswith("compare"):
            assert json.loads(said) in [json.loads(file.read_text()) for file in folder.rglob("results.json")]
        if first.startswith(MASS):
            verdict, *_ = lines = said.splitlines()[1:]
            assert (verdict[:2], len(lines) < 20, Path(re.findall(r"report: (\S+)", said)[0]).exists()) == (
                "- ",
                True,
                True,
            )
            assert max(map(len, lines[:-1])) <= (80 if name == "kept" else 100)


def test_journeys_have_every_command_and_exit_code():
    used = {shlex.split(words)[0] for rows in JOURNEYS.values() for _, words, *_ in rows if words}
    assert {*COMMANDS} - used == {"doctor", "new"}  # below
    assert {code for rows in JOURNEYS.values() for _, _, code, *_ in rows} == {0, 1, 2, 3, 4, 5, 6, 130}


def test_options_are_few_and_explained(capsys):
    """Twelve commands; every option and argument has a text, and every example of a help is a line that runs."""
    assert main([]) == 0
    found = re.findall(r"^  (\w+) {2,}\S", capsys.readouterr().out.partition("Commands:")[2], re.MULTILINE)
    assert sorted(found) == COMMANDS
    options = 0
    for name in COMMANDS:
        assert main([name, "--help"]) == 0
        said, _, examples = capsys.readouterr().out.partition("Examples:")
        own = re.findall(r"^  (?:-\w, )?(--[\w-]+)(.*(?:\n {4,}.*)*)", said, re.MULTILINE)
        assert [option for option, text in own if not re.search(r"[a-z]{3}", text)] == []
        options += len(own) - 1  # --help
        assert f"fpirhc {name}" in examples
    assert options <= 75


@pytest.mark.parametrize("step", [0, 3])
def test_progress_without_a_terminal_is_a_line_at_most_every_two_seconds(step, folder, capsys, monkeypatch):
    monkeypatch.setattr("time.monotonic", count(0, step).__next__)  # a command that takes no time says nothing
    assert main(["run", "line.py", "CTC", "--no-compile"]) == 0
    told = re.findall(r"fpirhc: (\S+): 500 of 500 after \d+ s", capsys.readouterr().err)
    assert told == ["CTC"] * (step > 0)


def test_plans_are_certified_side_by_side(folder, capsys, monkeypatch):
    """A plan to 1e-6 by either optimiser is the same optimum, and its bound says so; a limit that is broken has its name."""
    monkeypatch.setenv("COLUMNS", "200")
    receding()
    PRECISE()
    assert main(["compare", "line.py", "--plans", "-c", "RHC", "IPOPT"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.split()[:1] in (["RHC"], ["IPOPT"])]
    assert len({row[1] for row in rows}) == 1
    assert all(float(row[4]) < 1 and float(row[5]) < 1e-3 for row in rows)
    TIGHT()
    assert main(["compare", "line.py", "--plans"]) == 4
    assert "'y' is 0.5 m, below 0.8, at stage 0" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("error", "code"), [(KeyboardInterrupt(), 130), (ZeroDivisionError("in a model"), 70), (OSError(28, "full"), 3)]
)
def test_interrupts_and_crashes_have_codes_of_their_own(error, code, monkeypatch, capsys):
    """One line each; --debug prints the traceback."""

    def fails() -> None:
        raise error

    monkeypatch.setattr("fpirhc.problem_files.shipped.shipped_groups", fails)
    assert main(["list"]) == code
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert main(["list", "--debug"]) == code
    assert ("Traceback" in capsys.readouterr().err) == (code != 130)


def test_a_reader_that_closes_the_output_ends_it_in_silence():
    """`fpirhc list | head -1`: no traceback, and not Python's exit code 1, which is an answer."""
    with subprocess.Popen(
        [sys.executable, "-m", "fpirhc", "list"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout
        assert process.stderr
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 141


HEAVY = ("casadi", "numpy", "scipy", "rich", "jinja2", "matplotlib", "control", "pandas", "joblib")


@pytest.mark.parametrize(
    ("first", "absent"),
    [
        ("from fpirhc.__main__ import main; main([]); main(['list'])", HEAVY),
        ("from fpirhc.__main__ import main; main(['list'])", (*HEAVY, "pydantic")),
        ("import fpirhc as fp; fp.Problem", HEAVY[2:]),
        ("import fpirhc as fp; fp.load_problem('two_mass')", ("matplotlib", "rich", "jinja2", "pandas", "joblib")),
        ("from fpirhc.__main__ import main; main(['compare', 'wrong.py'])", HEAVY[3:]),
        ("import fpirhc.report.html", ("matplotlib",)),
        ("import fpirhc.studies.compare", ("scipy",)),
    ],
)
def test_what_comes_first_is_light(first, absent, tmp_path):
    """Lists need no heavy library, a wrong file nothing that draws, and linear algebra has one thread unless the user says more."""
    (tmp_path / "wrong.py").write_text("nothing = 3\n")
    code = f"import sys, os; {first}; print([m for m in {absent} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60, cwd=tmp_path
    )
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(("command", "encoding"), [("review mine.py -c θ", "cp1252"), ("run mine.py θ", "ascii")])
def test_names_that_an_output_cannot_write_are_escaped(command, encoding, tmp_path):
    text = line_text("period=1e-2, duration=0.1").replace('"CTC"', '"θ"').replace('"y"', '"θ"').replace("q.y", "q.θ")
    (tmp_path / "mine.py").write_text(text, encoding="utf-8")
    environment = {"PYTHONIOENCODING": encoding, "PYTHONPATH": str(ROOT), "FPIRHC_CC": "none"}
    words = [sys.executable, "-m", "fpirhc", *command.split()]
    done = subprocess.run(words, capture_output=True, cwd=tmp_path, env=environment, check=False, timeout=100)
    assert done.returncode in (0, 1)
    assert b"\\u03b8" in done.stdout


# --- new and doctor ---------------------------------------------------------------------------------------------------


def test_new_files_work_at_once(pytester, capsys, monkeypatch):
    """Adaptation helps, and the written test passes, with a baseline and without one."""
    assert main(["new", "my_arm", "--dir", "arms/left"]) == 0
    assert "fpirhc compare arms/left/my_arm.py; python -m pytest" in capsys.readouterr().out
    task = fp.load_problem(str(pytester.path / "arms/left/my_arm.py"))
    errors = {
        n: fp.measure(task.problem, fp.simulate(task.problem, c, seed=0)).rms_error["y"]
        for n, c in task.controllers.items()
    }
    assert errors["RHC+FPI"] < 0.2 * errors["RHC"]
    (pytester.path / "arms/left/baselines").mkdir()  # of another problem
    monkeypatch.setattr("fpirhc.cli.find_spec", lambda name: None)
    assert main(["new", "other"]) == 0
    assert "pip install pytest; python -m pytest test_other.py" in capsys.readouterr().out
    path = pytester.path / "other.py"
    path.write_text(re.sub(r"([\"'.])y\b", r"\1angle", path.read_text()))  # a coordinate of another name
    done = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-W", "error", "-k", "not test_controller")
    done.assert_outcomes(passed=4, skipped=2, deselected=6)


@pytest.mark.parametrize("taken", ["arm.py", "test_arm.py"])
def test_new_never_overwrites(folder, capsys, taken):
    """No file, and not what a link points to."""
    Path(taken).symlink_to("elsewhere.py")
    assert main(["new", "arm"]) == 3
    assert f"'{taken}' exists already and is kept" in capsys.readouterr().err
    assert {file.name for file in folder.iterdir()} == {taken, "line.py"}


NAMES = {
    "": "my_plant",
    "my-arm": "my_arm",
    "../../etc/passwd": "etc_passwd",
    "$(id)": "id",
    "\x1b[31mred": "plant_31mred",
    "größe": "gr_e",
    "json": "my_json",
    "test_arm": "my_test_arm",
    "x" * 300: "x" * 52,
}


@pytest.mark.parametrize("name", NAMES)
def test_hostile_names_are_refused_with_one_that_is_accepted(folder, capsys, name):
    assert main(["new", name]) == 2
    said = capsys.readouterr().err
    assert f"Try '{NAMES[name]}'" in said
    assert "\x1b" not in said
    assert len(said) < 400
    assert main(["new", NAMES[name]]) == 0


def test_doctor_finds_this_installation_and_a_faulty_one(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path / "cache"))
    assert main(["doctor", "--json"]) == 0
    checks = {one["name"]: one for one in json.loads(capsys.readouterr().out)}
    assert "fpirhc 0." in checks["versions"]["evidence"]
    assert str(tmp_path / "cache") in checks["cache"]["evidence"]
    assert "fail" not in {one["outcome"] for one in checks.values()}
    monkeypatch.setenv("FPIRHC_CC", "none")
    monkeypatch.setattr("fpirhc.doctor.find_spec", lambda name: None if name in ("optuna", "pytest") else name)
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"warn  compiler: .*FPIRHC_CC=none.*needed for .*to do: sudo apt install gcc", said)
    assert "none  extra tune: optuna not installed, needed for fpirhc tune; to do: pip install 'fpirhc[tune]'" in said
    assert "none  extra test: pytest not installed, needed for the test that fpirhc new writes; to do: pip" in said
    monkeypatch.setattr("casadi.has_nlpsol", lambda name: 1 / 0)
    assert main(["doctor"]) == 7
    assert re.search(r"fail  solvers: ZeroDivisionError", capsys.readouterr().out)
