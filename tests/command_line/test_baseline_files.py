"""Baselines: what bands are made of, what a baseline file may be, which problems are checked, and the pytest plugin."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.line import line_text

import fpirhc as fp
from fpirhc.__main__ import main

pytest_plugins = ["pytester"]
SHORT = "period=1e-3, duration=0.3"
PLANNED = """measure_from=0.1, limits=fp.Limits(inputs={"u": (-25.0, 25.0)}), horizon=fp.Horizon(stages=8, step=1e-2),
    cost=fp.Quadratic(states={"y": 100.0, "y'": 1.0}, deviation={"u": 1e-2})"""
SIGMOID = "fp.Sigmoid(gain=-0.5, shift=0.3, scale=50.0)"
PLANS = f'controllers["RHC+FPI"] = fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-3), {SIGMOID})\n'
LINE = line_text(f"{SHORT}, {PLANNED}", SIGMOID, more=PLANS)
NOISE = "disturbances={'u': fp.Noise(0.5), 'y': fp.Noise(2.0)}"
NOISY = line_text(f"{SHORT}, {NOISE}", more='del controllers["CTC+FPI"]\n')
NOISY = NOISY.replace("ca.sin(2 * t)", "0 * t").replace('"y": 0.5', '"y": 0.0')
TWO = NOISY.replace("controllers = ", "controllers: dict = ")
PROBLEMS = {"line": LINE, "noisy": NOISY}


@pytest.fixture(scope="module")
def blessed(tmp_path_factory) -> Path:
    """A folder with two problems and their baselines."""
    folder: Path = tmp_path_factory.mktemp("blessed")
    for name, text in PROBLEMS.items():
        (folder / f"{name}.py").write_text(text)
        words = ["accept", str(folder / f"{name}.py"), "--reason", "first", "--seeds", "4", "--no-compile"]
        assert main([*words, "--baselines", str(folder / "baselines")]) == 0
    return folder


@pytest.fixture
def folder(blessed, tmp_path, monkeypatch) -> Path:
    """A copy that a test may spoil."""
    shutil.copytree(blessed, tmp_path / "project")
    monkeypatch.chdir(tmp_path / "project")
    return tmp_path / "project"


def changed(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    facts = json.loads(path.read_text())
    change(facts)
    path.write_text(json.dumps(facts))


def test_a_band_is_three_times_the_spread_of_seeds_and_never_narrower_than_rounding(blessed):
    """Another seed's run stays in it; without noise it is a millionth of the value, or what rounding moves."""
    task = fp.load_problem(blessed / "noisy.py")
    noisy = json.loads((blessed / "baselines/noisy.json").read_text())["controllers"]["CTC"]["metrics"]
    value, band = noisy["rms_error.y"]
    runs = [fp.simulate(task.problem, task.controllers["CTC"], seed=s, compiled=False) for s in range(6)]
    errors = [fp.measure(task.problem, run).rms_error["y"] for run in runs]
    assert value == errors[0]
    assert band == pytest.approx(3 * (max(errors[:4]) - min(errors[:4])), rel=0.02)
    assert all(abs(error - value) <= band for error in errors[4:])
    exact = json.loads((blessed / "baselines/line.json").read_text())["controllers"]
    for one in exact.values():
        assert all(1e-6 * abs(v) <= b < 1e-3 * abs(v) + 1e-9 for v, b in one["metrics"].values())


def test_a_baseline_is_small_and_says_what_it_was_made_of(blessed):
    text = (blessed / "baselines/line.json").read_text()
    facts = json.loads(text)
    assert facts["reason"] == "first"
    assert {"fpirhc", "casadi", "machine"} <= {*facts["versions"]}
    assert len(text.splitlines()) <= 17 + len(facts["controllers"])
    kinds = {metric.partition(".")[0] for one in facts["controllers"].values() for metric in one["metrics"]}
    assert len(kinds) <= 6


CHANGES: dict[str, tuple[str, Callable[[dict[str, Any]], object] | tuple[str, str], int, str]] = {
    "nothing": ("line", lambda _: None, 0, "metrics hold"),
    "another seed": ("noisy", lambda f: f.update(seed=9), 0, "metrics hold"),
    "a value": ("line", lambda f: f["controllers"]["CTC"]["metrics"]["rms_error.y"].__setitem__(0, 1.0), 5, "CTC"),
    "an outcome": ("line", lambda f: f["controllers"]["CTC"].update(outcomes=["diverged"]), 5, "outcome"),
    "the model": ("line", ("approximate=1.0", "approximate=1.1"), 5, "the problem file changed"),
    "the reference": ("line", ("ca.sin(2 * t)", "ca.sin(3 * t)"), 5, "the problem file changed"),
    "a comment": ("line", ("import casadi", "# said\nimport casadi"), 0, "hold; the problem file changed"),
    "a run that ends": ("line", ("p.k * q.y", "p.k * q.y + 1e-9 * ca.sqrt(0.5001 - q.y)"), 5, "ended early"),
    "a controller gone": ("line", lambda f: f["controllers"].pop("CTC"), 6, "has no row of 'CTC'; measure it again"),
    "a list of settings": ("line", lambda f: f.update(controllers=[]), 6, "measure it again: fpirhc accept"),
    "text": ("line", lambda f: f["controllers"]["CTC"].update(metrics={"rms_error.y": ["a", 1]}), 6, "whole"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_changed_is_found(name, folder, capsys):
    problem, change, code, said = CHANGES[name]
    if isinstance(change, tuple):
        text = (folder / f"{problem}.py").read_text()
        assert change[0] in text
        (folder / f"{problem}.py").write_text(text.replace(*change))
    else:
        changed(folder / f"baselines/{problem}.json", change)
    assert main(["check", f"{problem}.py", "--no-compile"]) == code
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "<<<<<<< HEAD\n{}", "[" * 100_000, "\xff"])
def test_a_damaged_file_is_no_baseline(text, folder, capsys):
    (folder / "baselines/line.json").write_bytes(text.encode("latin-1"))
    assert main(["check", "line.py", "--no-compile"]) == 6
    assert "is no whole baseline" in capsys.readouterr().out


def test_one_controller_is_checked_alone_and_small_changes_can_be_ignored(folder):
    task = fp.load_problem(folder / "line.py")
    path, other = folder / "baselines/line.json", {"rms_error.y": [9.0, 0.0]}
    changed(path, lambda f: f["controllers"]["CTC"]["metrics"].update(other))
    assert fp.check(task, controllers=["CTC+FPI"], compiled=False).holds
    assert list(fp.check(task, compiled=False).changed.metric) == ["rms_error.y"]
    assert fp.check(task, ignore=0.999, compiled=False).holds


def test_problems_of_a_folder_and_the_folders_inside_it(tmp_path, monkeypatch, capsys):
    """Those whose packages are installed, and that are not left out for a reason; a file without controllers is none."""
    (tmp_path / "problems/gallery/baselines").mkdir(parents=True)
    (tmp_path / "problems/gallery/baselines/unchecked.toml").write_text('slow = "takes a minute"')
    texts = {"one.py": NOISY, "gallery/two.py": TWO, "gallery/slow.py": NOISY, "gallery/data.py": "x = 1"}
    texts["gallery/far.py"] = NOISY + 'needs = ("no_such_package",)\n'
    for name, text in texts.items():
        (tmp_path / "problems" / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    for words, named in (([], ["one", "two"]), (["problems/gallery"], ["two"])):
        assert main(["check", *words]) == 6
        assert re.findall(r"(\w+): there is no baseline", capsys.readouterr().out) == named


TEST = """
import pytest

@pytest.mark.parametrize("controller", ["CTC", "RHC+FPI"])
def test_line(fpirhc_check, controller):
    fpirhc_check("line.py", controller)
"""


def test_pytest_plugin(pytester, blessed, monkeypatch):
    """A changed controller fails by name, a reason accepts it, and an empty reason is refused before anything runs."""
    monkeypatch.setenv("FPIRHC_CC", "none")
    shutil.copytree(blessed, pytester.path, dirs_exist_ok=True)
    pytester.makepyfile(test_line=TEST)
    quiet = "-p", "no:cacheprovider"
    pytester.runpytest_inprocess(*quiet).assert_outcomes(passed=2)
    file = pytester.path / "line.py"
    file.write_text(file.read_text().replace("rate=6.0", "rate=7.0"))
    result = pytester.runpytest_inprocess(*quiet)
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*the problem file changed*", "*CTC*rms_error.y*"])
    assert pytester.runpytest_inprocess("--fpirhc-accept", " ").ret == pytest.ExitCode.USAGE_ERROR
    pytester.runpytest_inprocess(*quiet, "--fpirhc-accept", "new", "-k", "CTC").assert_outcomes(passed=1, deselected=1)
    pytester.runpytest_inprocess(*quiet).assert_outcomes(passed=2)
