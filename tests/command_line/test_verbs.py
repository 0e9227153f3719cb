"""Every command: found by a scan, explained by its help, and honest about its exit codes."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from test_cli import GOOD, HORIZON, PLANNERS, TIGHT

import fpirhc as fp
from fpirhc.cli import verb as discovery
from fpirhc.cli import verbs as package
from fpirhc.cli.main import main
from fpirhc.cli.output import reproducing
from fpirhc.cli.verb import OF_EVERY_VERB, ExitCode, shipped
from fpirhc.probing.probe import Probe, probe
from fpirhc.probing.rule import Rule
from fpirhc.problem_files.shipped import shipped_problems
from fpirhc.scaffold import create_problem
from fpirhc.studies.open_loop import optimiser_choices

ROOT = Path(__file__).resolve().parents[2]
VERBS = tuple(shipped().values())
THEIRS = """
import argparse
from fpirhc.cli.verb import ExitCode
from fpirhc.cli.verb import Verb

def add(parser):
    parser.add_argument("--code", type=int, default=0)

def run(options):
    print("theirs was here")
    return ExitCode(options.code)

VERB = Verb("theirs", "do something else", add, run, (("fpirhc theirs", "an example"),), {ExitCode.CHANGED: "it did"})
"""


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A working folder with a problem that is short, and its caches of commands left as they were."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(
        GOOD.replace("duration=2.0", "duration=0.2").replace("measure_from=1.0", "measure_from=0.1")
    )
    return tmp_path


@pytest.fixture
def scan():
    """Commands are scanned for anew, before and after the test."""
    discovery.shipped.cache_clear()
    yield
    discovery.shipped.cache_clear()
    sys.modules.pop("fpirhc.cli.verbs.theirs", None)


# --- Discovery --------------------------------------------------------------------------------------------------------


def test_a_new_command_is_one_new_file(tmp_path, monkeypatch, capsys, scan):
    """A module in the folder of commands is in the list, has help, and runs."""
    (tmp_path / "theirs.py").write_text(THEIRS)
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    assert main(["theirs", "--code", "5"]) == 5
    assert "theirs was here" in capsys.readouterr().out
    assert main([]) == 0
    assert "do something else" in capsys.readouterr().out


@pytest.fixture
def other_package(tmp_path, monkeypatch):
    """A function that installs a package with an entry point."""

    def install(name: str, target: str, code: str) -> None:
        info = tmp_path / "other_fpirhc_package-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-fpirhc-package\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[fpirhc.verbs]\n{name} = {target}\n")
        (tmp_path / "other_fpirhc_package.py").write_text(code)
        monkeypatch.syspath_prepend(str(tmp_path))

    yield install
    sys.modules.pop("other_fpirhc_package", None)


def test_another_package_adds_a_command(other_package, capsys):
    """It is listed without being imported, and runs when it is called."""
    other_package("theirs", "other_fpirhc_package:VERB", THEIRS)
    assert main([]) == 0
    assert "theirs     (of the package other-fpirhc-package)" in capsys.readouterr().out
    assert "other_fpirhc_package" not in sys.modules
    assert main(["theirs"]) == 0
    assert "theirs was here" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("raise RuntimeError('not today')", "cannot be imported (RuntimeError: not today)"),
        ("VERB = 3", "is a int: its entry point fpirhc.verbs must name a value"),
    ],
)
def test_a_broken_command_of_another_package_breaks_nothing_else(other_package, capsys, code, message):
    """It says which package is at fault; the list of commands is as before."""
    other_package("theirs", "other_fpirhc_package:VERB", code)
    assert main(["theirs"]) == ExitCode.BAD_INPUT
    assert message in capsys.readouterr().err
    assert main(["list"]) == 0


def test_another_package_replaces_no_command(other_package, capsys):
    """A name that exists is ignored with a notice."""
    other_package("list", "other_fpirhc_package:VERB", THEIRS)
    assert main(["list"]) == 0
    printed = capsys.readouterr()
    assert "two_mass" in printed.out
    assert "adds a command 'list', which exists: ignored" in printed.err


# --- Help -------------------------------------------------------------------------------------------------------------


def help_of(name: str, capsys) -> str:
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("verb", VERBS, ids=lambda v: v.name)
def test_help_has_examples_and_every_exit_code(verb, capsys):
    """Its own ones in its own words, and those of every command; every option has a text."""
    printed = help_of(verb.name, capsys)
    for line, remark in verb.examples:
        assert line in printed
        assert remark in printed
    codes = printed.partition("exit codes:\n")[2].splitlines()
    assert [int(line.split()[0]) for line in codes] == sorted({*OF_EVERY_VERB, *verb.codes})
    for code, meaning in verb.codes.items():
        assert f"{code:<4d} {meaning}" in printed
    assert all(action.help for action in verb.parser()._actions)
    assert "%%" not in printed


@pytest.mark.parametrize("name", ["compare", "limits", "robust", "sweep"])
def test_the_command_of_a_report_reproduces_its_options(name):
    """Parsed again, it gives every option that a number can depend on."""
    verb = shipped()[name]
    lines = [line for line, _ in verb.examples if line.startswith(f"fpirhc {name} ")]
    more = [
        "--no-compile --seed 3 --out elsewhere",
        *(["--scenarios 9 --shard 2/3 --mismatch 12.5"] if name == "compare" else []),
    ]
    for line in (*lines, *(f"{lines[0]} {options}" for options in more)):
        options = verb.options(shlex.split(line)[2:])
        again = verb.options(shlex.split(reproducing(verb, options))[2:])
        for one in (options, again):
            vars(one).update(dict.fromkeys(("out", "processes", "cluster", "json")))
        assert options == again


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """The task of a file that `fpirhc new` has just written."""
    problem, *_ = create_problem("my_arm", tmp_path_factory.mktemp("fresh"))
    return fp.load_problem(problem)


@pytest.mark.parametrize("verb", VERBS, ids=lambda v: v.name)
def test_examples_are_valid_commands(verb, fresh):
    """Each is one that the parser of its command accepts; what it names is there, in a file of `fpirhc new` too."""
    for line, _ in verb.examples:
        names_what_is_there(line, {"my_arm.py": fresh})


PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts)]
LINES = {
    page: re.findall(r"^    (?:\$ )?(fpirhc .+)$", page.read_text(encoding="utf-8"), re.MULTILINE) for page in PAGES
}


@pytest.mark.parametrize("page", [p for p in PAGES if LINES[p] and p.stem != "command-line"], ids=lambda p: p.stem)
def test_command_lines_on_a_page_are_valid(page):
    """As the examples of a help; files of a page's own are not read."""
    for line in LINES[page]:
        names_what_is_there(line, {})


def names_what_is_there(line, tasks):
    """Require that the parser accepts a command line, and that controllers, cases, ranges and optimisers that it names exist."""
    program, name, *rest = shlex.split(line, comments=True)
    assert program == "fpirhc"
    verb = shipped()[name]
    options = vars(verb.options(rest))
    assert set(options.get("optimisers") or ()) <= {*optimiser_choices(), "all"}
    problems = [options["problem"]] if "problem" in options else options.get("problems", [])
    assert all(p in shipped_problems() or p == "FILE" or p.endswith(".py") for p in problems)
    one = options.get("controller")
    for task in (tasks.get(p) or fp.load_problem(p) for p in problems if p in tasks or p in shipped_problems()):
        assert {*(options.get("controllers") or ()), *([one] if one else ())} <= set(task.controllers)
        patterns = [*(options.get("cases") or ()), *filter(None, [options.get("case")])]
        assert not patterns or (task.cases and task.cases.matching(patterns))
        assert name != "tune" or task.tuning
        metric, _, of = (options.get("headline") or "rms_error").partition(".")
        assert metric in {m.name for m in task.metrics}
        assert of in ("", *task.problem.judged_names)


@pytest.mark.parametrize("name", ["compare", "solve"])
def test_help_names_every_optimiser(name, capsys):
    words = " ".join(help_of(name, capsys).split())
    assert f"{', '.join(optimiser_choices())}, or all" in words


HEAVY = ("casadi", "numpy", "scipy", "rich", "jinja2", "matplotlib", "control", "pandas", "osqp")


@pytest.mark.parametrize(
    ("first", "absent"),
    [
        ("from fpirhc.cli.main import main; main([])", HEAVY),
        ("from fpirhc.cli.main import main; main(['list'])", HEAVY),
        ("import fpirhc as fp; fp.Problem", HEAVY[2:]),
        ("import fpirhc as fp; fp.load_problem('two_mass')", ("matplotlib", "rich", "jinja2")),
        ("import fpirhc.report.html", ("matplotlib",)),
        ("import fpirhc.studies.comparison.compare", ("scipy",)),
        ("from fpirhc.review import question as q; q.known_questions(q.ControllerQuestion)", ("scipy",)),
    ],
)
def test_what_comes_first_is_light(first, absent):
    """The lists of commands and of problems need no heavy library, and a problem none but CasADi and numpy."""
    code = f"import sys; {first}; print([m for m in {absent} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("verb", ["compare", "review", "run", "solve", "tune"])
def test_the_message_of_a_wrong_file_is_light(verb, tmp_path):
    """What a file lacks is said before anything that draws, computes or tells a result is imported."""
    wrong = tmp_path / "wrong.py"
    wrong.write_text("nothing = 3\n")
    words = [verb, str(wrong), *(["RHC"] if verb == "run" else [])]
    code = f"import sys; from fpirhc.cli.main import main; main({words}); print([m for m in {HEAVY[2:]} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert "wrong.py" in done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


def test_pages_are_what_the_code_says():
    """README's table of exit codes is the one that the script writes; its page has every command with its options."""
    spec = importlib.util.spec_from_file_location("make_command_line", ROOT / "docs" / "make_command_line.py")
    assert spec is not None
    assert spec.loader is not None
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    assert maker.README.read_text(encoding="utf-8") == maker.readme()
    page = maker.page()
    assert re.findall(r"^## (\w+)$", page, re.MULTILINE) == [verb.name for verb in VERBS]
    assert "| `--mismatch PERCENT` |" in page
    rows = [line.split("|") for line in maker.README.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    table = {int(r[1]): r[2].strip() for r in rows if r[1].strip().isdigit()}
    assert table == {int(code): code.meaning for code in ExitCode}


# --- Exit codes -------------------------------------------------------------------------------------------------------


def edited(old: str, new: str) -> None:
    text = Path("line.py").read_text()
    assert old in text
    Path("line.py").write_text(text.replace(old, new))


def receding() -> None:
    """The problem with a horizon and two planners."""
    edited("measure_from=0.1,\n", HORIZON.replace("1.0,", "0.1,", 1))
    edited("controllers = {\n", PLANNERS)


def tunable() -> None:
    edited("controllers = {", 'tuning = {"CTC+FPI": {"deformation.gain": fp.LogSpan(-1.0, -0.1)}}\ncontrollers = {')


def diverging() -> None:
    edited("- p.k * q.y", "- p.k * q.y + 1e-9 * ca.sqrt(0.5001 - q.y)")


def too_weak() -> None:
    edited("measure_from", 'limits=fp.Limits(inputs={"u": (-0.01, 0.01)}), measure_from')


def taken() -> None:
    Path("taken").write_text("a file, not a folder")


def faster() -> None:
    edited("2 * t", "3 * t")


def stale() -> None:
    edited("rate=6.0", "rate=7.0")


def recorded() -> None:
    period = fp.load_problem("line.py").problem.period
    rows = "".join(f"{k * period},0.5,0.0,0.0\n" for k in range(5))
    Path("run.csv").write_text("time,y,y',y''\n" + rows)


def in_parts() -> None:
    """One of two parts of a study of two scenarios."""
    main(shlex.split("compare line.py --scenarios 2 --mismatch 10 --shard 1/2 --out part --no-compile"))


# name of the command: (what to do before, its words, the exit code), one after the other
JOURNEYS: dict[str, Any] = {
    "merge": [(in_parts, "part --out joined", 0), (None, "part", 2), (None, "nowhere --out joined", 3)],
    "list": [(None, "", 0), (None, "--alll", 2)],
    "review": [(None, "line.py", 0), (None, "line.py --mismatch 250", 2), (too_weak, "line.py", 1)],
    "probe": [
        (None, "line.py --cycles 80 --no-trials", 0),
        (None, "line.py --cycles 10", 2),
        (too_weak, "line.py --cycles 80", 1),
    ],
    "replay": [
        (recorded, "line.py CTC run.csv", 0),
        (None, "line.py CTC nowhere.csv", 2),
        (recorded, "line.py CTC run.csv --out nowhere/commands.csv", 3),
    ],
    "solve": [
        (None, "line.py", 2),
        (receding, "line.py", 0),
        (taken, "line.py --out taken/results", 3),
        (lambda: edited("inputs={\"u\": (-30.0, 30.0)}", TIGHT[len("limits=fp.Limits("):-1]), "line.py", 4),
    ],
    "run": [
        (None, "line.py CTC --no-compile", 0),
        (None, "line.py CCT", 2),
        (taken, "line.py CTC --out taken/results", 3),
        (diverging, "line.py CTC --no-compile", 4),
    ],
    "compare": [
        (None, "line.py --no-compile", 0),
        (None, "line.py --controllers CCT", 2),
        (None, "line.py --scenarios 2 --mismatch 10 --no-compile --out twice", 0),
        (None, "line.py --scenarios 2 --mismatch 20 --no-compile --out twice", 3),
    ],
    "tune": [
        (None, "line.py", 2),
        (tunable, "line.py --trials 2 --out tuned --format csv", 0),
        (stale, "line.py --trials 2 --out tuned", 3),
    ],
    "limits": [
        (None, "line.py --over latency --controllers CTC --no-compile --format csv", 0),
        (None, "line.py --over latncy", 2),
        (taken, "line.py --out taken/results", 3),
    ],
    "robust": [
        (None, "line.py --controllers CTC --risk 0.5 --confidence 0.5 --no-compile --format csv", 0),
        (None, "line.py --risk 2", 2),
        (taken, "line.py --out taken/results", 3),
    ],
    "sweep": [
        (None, "line.py --over tracking.rate=2:6:3 --controllers CTC --no-compile --out swept", 0),
        (None, "line.py --over tracking.rate=2:6:4 --controllers CTC --no-compile --out swept", 3),
        (None, "line.py --over tracking.rate=2:2:3", 2),
    ],
    "export": [
        (None, "line.py CTC --out device --cycles 50", 0),
        (None, "line.py CTC --out device", 3),
        (None, "line.py CTC --out other --to d", 2),
        (None, "line.py CTC --out other --name 2nd", 2),
    ],
    "lab": [
        (None, "line.py --controllers CTC+FPI --out lab.html", 0),
        (None, "line.py --out line.py/lab.html", 3),
        (None, "line.py --controllers nobody", 2),
    ],
    "new": [(None, "class", 2), (None, "arm", 0), (None, "arm", 3)],
    "check": [
        (None, "", 6),
        (None, "--markdown line.py", 3),
        (lambda: main(["accept", "line.py", "--reason", "first", "--no-compile", "--seeds", "2"]), "--no-compile", 0),
        (None, "lin.py", 2),
        (faster, "--no-compile", 5),
    ],
    "accept": [
        (None, "line.py --reason first --no-compile --seeds 2", 0),
        (None, "line.py", 2),
        (None, "line.py --reason first --baselines ../elsewhere", 3),
    ],
    "completion": [(None, "bash", 0), (None, "pwsh", 2)],
    "doctor": [(None, "--json", 0), (lambda: FAULTY.append(True), "", 7), (None, "--jsonn", 2)],
}  # fmt: skip
FAULTY: list[bool] = []


def test_doctor_and_readme_say_the_same_about_a_faulty_installation(capsys):
    """The code of `doctor` in its help, in README's table, and in the program."""
    code = ExitCode.FAULTY_INSTALLATION
    assert f"  {code:<4d} {code.meaning}\n" in help_of("doctor", capsys)
    assert f"| {code:d} | {code.meaning} |\n" in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("verb", VERBS, ids=lambda v: v.name)
def test_exit_codes_are_those_of_the_help(verb, folder, monkeypatch, capsys):
    """With right and wrong input every code that the help lists is met, and no other one."""
    from fpirhc.doctor import Diagnosis, Finding, Outcome

    # The baseline of a new problem is measured in a test of its own.
    monkeypatch.setattr("fpirhc.scaffold.first_baseline", lambda path: path.with_suffix(".json"))
    monkeypatch.setattr(
        "fpirhc.doctor.examine",
        lambda: Diagnosis({}, [Finding("a check", Outcome.FAIL if FAULTY else Outcome.OK, "found")]),
    )
    # Loops are compiled for a page in tests of their own, where zig is.
    monkeypatch.setattr("fpirhc.export.lab.lab.package", lambda *_: None)
    monkeypatch.setattr("fpirhc.export.lab.loop.web_module", lambda _: b"")
    FAULTY.clear()
    if verb.name == "completion":
        pytest.importorskip("shtab")
    met = set()
    for before, words, code in JOURNEYS[verb.name]:
        if before:
            before()
        assert outcome([verb.name, *shlex.split(words)]) == code, (words, capsys.readouterr().err)
        met.add(code)
    assert met == set(verb.exit_codes) - {ExitCode.CRASHED, ExitCode.INTERRUPTED, ExitCode.OUTPUT_CLOSED}


def outcome(words: list[str]) -> int:
    """The exit code, also where argparse ends the program."""
    try:
        return main(words)
    except SystemExit as stop:
        return int(stop.code or 0)


@pytest.mark.parametrize(
    ("error", "code"),
    [(KeyboardInterrupt(), ExitCode.INTERRUPTED), (ZeroDivisionError("in a model"), ExitCode.CRASHED)],
)
def test_interrupts_and_crashes_have_codes_of_their_own(error, code, monkeypatch, capsys):
    """A crash must not end with 1, which is an answer of the review; it is one line, and --debug prints its traceback."""

    def run(options):
        raise error

    commands = {**shipped(), "list": replace(shipped()["list"], run=run)}
    monkeypatch.setattr(discovery, "shipped", lambda: commands)
    assert main(["list"]) == code
    printed = capsys.readouterr().err
    assert ("ZeroDivisionError" in printed) == (code == ExitCode.CRASHED)
    assert len(printed.splitlines()) == 1
    assert main(["list", "--debug"]) == code
    assert "Traceback" in capsys.readouterr().err


def test_a_reader_that_closes_the_output_ends_it_in_silence():
    """`fpirhc list | head -1`: no traceback, and not Python's exit code 1, which is an answer."""
    words = [sys.executable, "-m", "fpirhc", "list"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == ExitCode.OUTPUT_CLOSED


# --- probe ------------------------------------------------------------------------------------------------------------


def test_journey_of_probe(folder, capsys, monkeypatch):
    """The estimates of a problem whose plant is 1.6 times as strong as its model, as text and as JSON; both tell of one probe."""
    found: list[Probe] = []

    def probed(*words: Any, **more: Any) -> Probe:
        found.append(found[0] if found else probe(*words, **more))
        return found[-1]

    monkeypatch.setattr("fpirhc.probing.probe.probe", probed)
    words = ["probe", "line.py", "--cycles", "60", "--controller", "CTC", "--no-trials"]
    assert main(words) == ExitCode.FINISHED
    printed = capsys.readouterr().out
    assert re.search(r"gain of y +1\.6", printed)
    assert re.search(r"dead time of u, cycles +0", printed)
    assert "deformation=fp." in printed
    assert main([*words, "--json"]) == ExitCode.FINISHED
    facts = json.loads(capsys.readouterr().out)
    assert set(facts) == {"gain", "dead_time", "lag", "noise", "drift", "lines", "why", "trials", "notes"}
    assert len(found) == 2


def test_review_asks_the_plant_as_estimated(folder, capsys, monkeypatch):
    """A plant outside has no equations: after a probe its inverse, poles and margins are answered as those of the estimate."""
    del folder
    monkeypatch.setattr(Rule, "shortlist", lambda _: {})  # a review of the plant needs no choice of a deformation
    Path("outside.py").write_text(OUTSIDE)
    answers = []
    for words in ([], ["--probe"]):
        main(["review", "outside.py", "--json", "--controllers", "CTC+FPI", *words])
        facts = json.loads(capsys.readouterr().out)
        every = [*facts["answers"], *facts["controllers"]["CTC+FPI"]]
        answers.append(sum(one["verdict"] != "unknown" for one in every))
    assert answers[1] >= answers[0] + 3


OUTSIDE = """import fpirhc as fp
import casadi as ca

class Body:
    def reset(self, seed):
        self.y, self.v, self.late = 0.0, 0.0, [0.0]
        return [0.0, 0.0, 0.0]
    def step(self, time, command):
        self.late.append(float(command[0]))
        a = 1.4 * self.late.pop(0) - 3 * self.y - 0.2 * self.v
        self.y, self.v = self.y + 5e-3 * self.v + 1.25e-5 * a, self.v + 5e-3 * a
        return [self.y, self.v, a]

parameters = {"b": fp.Parameter(1.0, 1.0, "1/kg")}
plant = fp.Plant({"y": "m"}, {"u": "N"}, parameters, lambda q, v, u, p: {"y": p.b * u.u})
problem = fp.Problem(
    plant=plant,
    reality=fp.ExternalPlant(Body(), measures={"y": "m", "y'": "m/s", "y''": "m/s^2"}),
    reference=fp.Trajectory(lambda t: {"y": ca.sin(2 * t)}), start={"y": 0.0, "y'": 2.0}, period=5e-3, duration=2.0,
    limits=fp.Limits(inputs={"u": (-30.0, 30.0)}),
)
law = fp.Exponential(rate=6.0)
controllers = {"CTC": fp.ComputedTorque(law), "CTC+FPI": fp.ComputedTorque(law, fp.ModelReferenced(fp.Affine(gain=-0.3)))}
"""
