"""A newcomer's first commands: `fpirhc new` and `fpirhc doctor`."""

from __future__ import annotations

import json
import os
import stat
import sys

import casadi as ca
import pytest

import fpirhc as fp
from fpirhc import doctor as machine
from fpirhc.cli.main import main
from fpirhc.doctor import Diagnosis, Finding, Outcome, ask
from fpirhc.scaffold import create_problem
from fpirhc.symbolic.native import Native, cache_folder, own_name

pytest_plugins = ["pytester"]
CACHE = cache_folder()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


# new


def test_new_files_work_at_once(pytester, monkeypatch, capsys):
    """Adaptation helps, every cycle is solved, and the written test passes.

    What it says of the controllers is left out: the laws of controllers are tested on the shipped ones.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(CACHE.parent))  # pytester has a home of its own, without what was compiled
    assert main(["new", "my_arm", "--dir", "arms/left"]) == 0
    assert "fpirhc compare arms/left/my_arm.py" in capsys.readouterr().out
    folder = pytester.path / "arms" / "left"
    assert fp.load_problem(str(folder / "my_arm.py")).title.startswith("my_arm: ")
    of = json.loads((folder / "baselines" / "my_arm.json").read_text())["controllers"]
    plain, adaptive = of["RHC"]["metrics"], of["RHC+FPI"]["metrics"]
    assert adaptive["rms_error.y"]["value"] < 0.2 * plain["rms_error.y"]["value"]
    assert adaptive["status.OK"]["value"] == adaptive["cycles"]["value"]
    done = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-W", "error", "-k", "not test_controller")
    done.assert_outcomes(passed=3, deselected=3)


@pytest.mark.parametrize("taken", ["arm.py", "test_arm.py", "baselines/arm.json"])
def test_new_never_overwrites(folder, capsys, taken):
    """Nothing is written where one of the three files is there, and the file keeps its text; exit code 3."""
    (folder / taken).parent.mkdir(exist_ok=True)
    (folder / taken).write_text("mine")
    assert main(["new", "arm"]) == 3
    assert f"'{taken}' exists already and is kept" in capsys.readouterr().err
    assert [str(f.relative_to(folder)) for f in folder.rglob("*") if f.is_file()] == [taken]
    assert (folder / taken).read_text() == "mine"


def test_new_does_not_follow_a_link(folder):
    """A link that leads elsewhere counts as a file, also where nothing is at its end."""
    (folder / "arm.py").symlink_to(folder / "elsewhere.py")
    with pytest.raises(OSError, match="exists already"):
        create_problem("arm", folder)
    assert not (folder / "elsewhere.py").exists()


def test_new_in_another_project_goes_there_first(folder, capsys, monkeypatch):
    """A baseline of another project is not accepted from here."""
    monkeypatch.setattr("fpirhc.scaffold.first_baseline", lambda problem: problem)
    (folder / "here").mkdir()
    monkeypatch.chdir(folder / "here")
    assert main(["new", "arm", "--dir", "../there"]) == 0
    assert capsys.readouterr().out.partition("next:\n")[2].splitlines()[:2] == [
        "  cd ../there",
        "  fpirhc compare arm.py",
    ]


def test_new_that_is_interrupted_leaves_nothing(folder, monkeypatch):
    """Else its own files are in the way of the next attempt; what others wrote stays."""

    def stopped(problem):
        raise KeyboardInterrupt

    monkeypatch.setattr("fpirhc.scaffold.first_baseline", stopped)
    (folder / "old").mkdir()
    assert [main(["new", "arm", "--dir", place]) for place in ("new/arms", "old")] == [130, 130]
    assert [path.name for path in folder.rglob("*")] == ["old"]


def test_new_into_a_file(folder, capsys):
    """A folder that cannot be made: exit code 3 and what to do."""
    (folder / "taken").write_text("")
    assert main(["new", "arm", "--dir", "taken"]) == 3
    assert "choose another with --dir" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("", "my_plant"),
        ("my-arm", "my_arm"),
        ("arm.py", "arm"),
        ("../../etc/passwd", "etc_passwd"),
        ("a; rm -rf ~", "a_rm_rf"),
        ("$(id)", "id"),
        ("<script>alert(1)</script>", "script_alert_1_script"),
        ("[bold]arm", "bold_arm"),
        ("\x1b[31mred", "plant_31mred"),
        ("2dof", "plant_2dof"),
        ("_hidden", "hidden"),
        ("arm\n", "arm"),
        ("größe", "gr_e"),
        ("class", "my_class"),
        ("numpy", "my_numpy"),
        ("json", "my_json"),
        ("two_mass", "my_two_mass"),
        ("test_arm", "my_test_arm"),
        ("x_test", "x_plant"),
        ("x" * 300, "x" * 52),
    ],
)
def test_hostile_names_are_refused_with_the_fix(folder, capsys, name, fix):
    """Exit code 2, nothing written, nothing that a terminal would obey, and the offered name is accepted."""
    assert main(["new", name]) == 2
    output = capsys.readouterr().err
    assert f"Try '{fix}'" in output
    assert "\x1b" not in output
    assert len(output) < 400
    assert not list(folder.iterdir())
    assert len(create_problem(fix, folder)) == 2


# doctor


def test_doctor_finds_this_installation_in_order(capsys, tmp_path, monkeypatch):
    """Every check by name; no check fails where the tests pass; one JSON object."""
    monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    assert main(["doctor", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {"fpirhc", "casadi", "numpy", "python"} <= set(document["versions"])
    assert document["outcome"] in ("ok", "warn")
    checks = {c["name"]: c for c in document["checks"]}
    assert list(checks) == [check.__name__.replace("_", "-") for check in machine.CHECKS]
    assert str(tmp_path / "cache") in checks["cache"]["evidence"]


def test_a_missing_compiler_is_a_warning(monkeypatch):
    """Everything works without one, more slowly; what to do is said."""
    monkeypatch.setenv("FPIRHC_CC", "none")
    outcome, result, remedy = machine.c_compiler()
    assert outcome == Outcome.WARN
    assert "FPIRHC_CC=none" in result
    assert "gcc" in remedy


def test_what_exports_lack_is_named_with_its_package(monkeypatch):
    monkeypatch.setattr(machine, "find_spec", lambda _: None)
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/avr-gcc" if name == "avr-gcc" else None)
    outcome, said, _ = machine.export_tools()
    assert outcome == Outcome.OK
    assert said.startswith(
        "here: avr-gcc; without ziglang for WebAssembly, labs, Cortex-M and other platforms: pip install 'fpirhc[comp"
    )
    assert said.endswith("without cppcheck for deviations from MISRA C: package cppcheck")


@pytest.mark.skipif(os.name != "posix", reason="permissions of another kind")
def test_a_cache_that_others_may_write_is_closed(tmp_path, monkeypatch):
    """What is loaded from the cache is run, so nobody else may put a library there."""
    monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path))
    tmp_path.chmod(0o777)
    own = tmp_path / own_name()
    own.mkdir()
    own.chmod(0o777)
    assert machine.cache()[0] == Outcome.OK
    assert [stat.S_IMODE(p.stat().st_mode) for p in (tmp_path, own)] == [0o777, 0o700]


def test_a_cache_that_cannot_be_made_is_a_warning(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path / "file" / "cache"))
    outcome, result, _ = machine.cache()
    assert outcome == Outcome.WARN
    assert "temporary folder" in result


def test_missing_solvers_are_named(monkeypatch):
    monkeypatch.setattr("casadi.has_nlpsol", lambda name: name != "fatrop")
    outcome, result, _ = machine.solver_plugins()
    assert outcome == Outcome.WARN
    assert "missing fatrop" in result


def test_a_compiler_that_computes_wrongly_fails(monkeypatch):
    """The compiled Function is evaluated, not only built."""
    x = ca.SX.sym("x")
    wrong = Native(ca.Function("fpirhc_step", [x], [3 * x]), True, "")
    monkeypatch.setattr(machine, "native", lambda function: wrong)
    outcome, result, remedy = machine.c_compiler()
    assert outcome == Outcome.FAIL
    assert "3 * 2 + 1 = 6" in result
    assert "FPIRHC_CC" in remedy


def test_a_large_cache_is_a_warning(tmp_path, monkeypatch):
    monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(machine, "_LARGE_CACHE", 10.0)
    (cache_folder() / "old.so").write_bytes(bytes(11))
    outcome, _, remedy = machine.cache()
    assert outcome == Outcome.WARN
    assert "remove old libraries" in remedy


def test_a_folder_without_room_for_results_is_a_warning(tmp_path, monkeypatch):
    """Read-only folders, full disks: what the system says, and --out as the remedy."""

    def full(**settings):
        raise OSError(28, "No space left on device")

    monkeypatch.chdir(tmp_path)
    assert machine.results_folder()[0] == Outcome.OK
    monkeypatch.setattr("tempfile.TemporaryFile", full)
    outcome, result, remedy = machine.results_folder()
    assert outcome == Outcome.WARN
    assert "No space left" in result
    assert "--out" in remedy


def test_a_python_without_its_lock_fails(monkeypatch):
    """CasADi's Functions are not made for threads that run at once."""
    monkeypatch.setattr(sys, "_is_gil_enabled", lambda: False, raising=False)
    outcome, result, remedy = machine.python_threads()
    assert outcome == Outcome.FAIL
    assert "global lock off" in result
    assert "processes" in remedy


def test_a_check_that_raises_has_failed_and_the_rest_goes_on(capsys, monkeypatch):
    """One line for the error, one for what to do; exit code 7."""

    def broken_library():
        raise OSError("libfoo.so: cannot open\nmore")

    findings = ask([broken_library, machine.python_threads])
    assert findings[0].outcome == Outcome.FAIL
    assert findings[0].name == "broken-library"
    assert findings[0].evidence == "OSError: libfoo.so: cannot open"
    assert findings[1].outcome == Outcome.OK
    monkeypatch.setattr("fpirhc.doctor.examine", lambda: Diagnosis({"fpirhc": "0"}, findings))
    assert main(["doctor"]) == 7
    printed = capsys.readouterr().out
    assert "fail  broken-library" in printed
    assert "to do: install" in printed
    assert "1 ok, 0 to look at, 1 failed" in printed


def test_warnings_alone_exit_with_zero(monkeypatch, capsys):
    findings = [Finding("slow", Outcome.WARN, "slow", "be patient")]
    monkeypatch.setattr("fpirhc.doctor.examine", lambda: Diagnosis({}, findings))
    assert main(["doctor", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["outcome"] == "warn"
