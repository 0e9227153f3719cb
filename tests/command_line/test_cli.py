"""User journeys through the command line, with right and wrong input."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from line import line_text

import fpirhc as fp
from fpirhc.cli.main import main

GOOD = line_text("period=1e-3, duration=2.0, measure_from=1.0")


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """An empty working folder with one problem file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "line.py").write_text(GOOD)
    return tmp_path


def _write(folder: Path, old: str, new: str) -> None:
    assert old in GOOD
    (folder / "line.py").write_text(GOOD.replace(old, new))


def test_compare_writes_a_report_and_says_what_it_found(folder, capsys):
    assert main(["compare", "line.py", "--no-compile"]) == 0
    printed = capsys.readouterr()
    assert "CTC+FPI lowers the rms error of y" in printed.out.replace("\n", " ")
    assert (folder / "results" / "line" / "report.html").stat().st_size < 3e6
    assert "loops ran in CasADi's virtual machine, more slowly, because --no-compile was given" in printed.err


def test_json_is_one_object_on_standard_output(folder, capsys):
    """Machines read the same numbers that people see; the same object stands beside the report."""
    assert main(["compare", "line.py", "--json", "--seed", "3", "--no-compile"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert json.loads((folder / "results" / "line" / "results.json").read_text(encoding="utf-8")) == document
    assert document["problem"] == "line"
    assert document["seed"] == 3
    assert set(document["versions"]) >= {"fpirhc", "casadi"}
    plain, adaptive = document["controllers"]["CTC"], document["controllers"]["CTC+FPI"]
    assert adaptive["rms_error"]["y"] < 0.2 * plain["rms_error"]["y"]
    assert plain["contraction"] is None
    assert adaptive["contraction"]["predicted"] == pytest.approx(1 - 0.5 * 0.396737 * 1.6, abs=1e-3)
    assert adaptive["contraction"]["measured"] == pytest.approx(adaptive["contraction"]["predicted"], abs=0.02)
    assert set(adaptive["cycle_us"]) == {"median", "p99", "max", "first", "planning"}
    assert adaptive["statuses"] == {"OK": 2000}


def test_controllers_can_be_chosen(folder, capsys):
    """Only the named ones run; without a pair the verdict does not judge adaptation."""
    assert main(["compare", "line.py", "--controllers", "CTC", "--no-compile"]) == 0
    assert "adaptation itself is not judged" in capsys.readouterr().out.replace("\n", " ")


def test_run_saves_every_signal(folder, capsys):
    assert main(["run", "line.py", "CTC+FPI", "--out", "kept", "--no-compile"]) == 0
    run = fp.load_run(folder / "kept" / "CTC_FPI.npz")
    assert run.problem == "line"
    assert run["deformed.y"].shape == (2000,)
    assert (folder / "kept" / "CTC_FPI.png").stat().st_size > 1000
    assert "rms error" in capsys.readouterr().out


def test_list_and_help(capsys):
    assert main(["list"]) == 0
    assert "two_mass" in capsys.readouterr().out
    assert main([]) == 0
    assert "examples:" in capsys.readouterr().out
    assert main(["--version"]) == 0
    with pytest.raises(SystemExit) as stop:
        main(["compare", "--help"])
    assert stop.value.code == 0


def test_wrong_sign_of_the_gain_is_explained(folder, capsys):
    """It is refused before anything runs, naming the controller, the right sign and the admissible gains."""
    _write(folder, "gain=-0.5", "gain=0.5, scale=1.0")
    assert main(["compare", "line.py", "--no-compile"]) == 2
    printed = capsys.readouterr().err
    assert "controller 'CTC+FPI'" in printed
    assert "wrong sign" in printed
    assert "recommended -" in printed
    assert not (folder / "results").exists()  # a folder that would be empty


def test_ended_run_has_its_own_exit_code(folder, capsys):
    """A signal that is not finite ends the run; its name, time and finite part are kept."""
    _write(folder, "- p.k * q.y", "- p.k * q.y + 1e-9 * ca.sqrt(0.9 - q.y)")
    assert main(["run", "line.py", "CTC", "--no-compile"]) == 4
    assert "is not finite at t = 0." in capsys.readouterr().out.replace("\n", " ")
    assert fp.load_run(folder / "results" / "line" / "CTC.npz").cycles > 100


def test_ctrl_c_keeps_what_is_finished(folder, capsys, monkeypatch):
    """The finished controller is reported, the other is named as interrupted; exit code 130."""
    from fpirhc.studies.comparison import compare as study

    ordinary = vars(study)["judged_run"]

    def interrupted(loop, **settings):
        if settings["name"] == "CTC+FPI":
            raise KeyboardInterrupt
        return ordinary(loop, **settings)

    monkeypatch.setattr(study, "judged_run", interrupted)
    assert main(["compare", "line.py", "--no-compile"]) == 130
    assert (folder / "results" / "line" / "report.html").exists()
    assert "interrupted before it finished" in capsys.readouterr().out.replace("\n", " ")


def test_without_a_compiler_it_says_so(folder, capsys, monkeypatch):
    monkeypatch.setitem(os.environ, "FPIRHC_CC", "none")
    _write(folder, "duration=2.0, measure_from=1.0", "duration=0.02")
    assert main(["compare", "line.py"]) == 0
    assert "because compilation is turned off (FPIRHC_CC=none)" in capsys.readouterr().err


HORIZON = """measure_from=1.0,
    horizon=fp.Horizon(stages=10, step=1e-2),
    cost=fp.Quadratic(states={"y": 100.0, "y'": 1.0}, deviation={"u": 1e-2}),
    limits=fp.Limits(inputs={"u": (-30.0, 30.0)}),
"""
PLANNERS = """controllers = {
    "RHC": fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3)),
    "RHC+FPI": fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3), fp.Sigmoid(gain=-0.5, scale=50.0)),
"""


def _receding(folder: Path) -> None:
    short = GOOD.replace("duration=2.0, measure_from=1.0,\n", "duration=0.1, " + HORIZON.replace("1.0,", "0.05,", 1))
    text = short.replace("controllers = {\n", PLANNERS)
    (folder / "line.py").write_text(text + 'headline = ("RHC", "RHC+FPI")\n')


def test_solve_prints_certificates_and_draws_the_plan(folder, capsys):
    """Every optimiser finds the same cost; the picture is there; the exit code says that all converged."""
    _receding(folder)
    assert main(["solve", "line.py", "--optimisers", "fixed-point", "qrqp", "--tolerance", "1e-5"]) == 0
    printed = capsys.readouterr().out
    assert "FPI" in printed
    assert "SQP qrqp" in printed
    assert "contraction factor" in printed
    assert (folder / "results" / "line" / "plan.png").stat().st_size > 10_000


def test_solve_tells_what_is_violated_by_name(folder, capsys):
    """Limits that the first state breaks: named with values, an exit code of their own, and the remedy."""
    _receding(folder)
    text = (folder / "line.py").read_text()
    (folder / "line.py").write_text(text.replace('limits=fp.Limits(inputs={"u": (-30.0, 30.0)})', TIGHT))
    assert main(["solve", "line.py"]) == 4
    printed = capsys.readouterr().out
    assert "'y' is 0.5 m, below 0.8, at stage 0" in printed
    assert "check the initial state" in printed.replace("\n", " ")


TIGHT = 'limits=fp.Limits(inputs={"u": (-1.0, 1.0)}, states={"y": (0.8, 1.0)})'


def test_optimisers_are_compared_by_name(folder, capsys):
    """The headline pair once per optimiser, with their distance from the optimum."""
    _receding(folder)
    assert main(["compare", "line.py", "--optimisers", "fixed-point", "qrqp", "--no-compile"]) == 0
    printed = capsys.readouterr().out.replace("\n", " ")
    for name in (
        "RHC (FPI)",
        "RHC+FPI (FPI)",
        "RHC (SQP qrqp)",
        "RHC+FPI (SQP qrqp)",
        "gap: cost above the converged optimum",
    ):
        assert name in printed


def test_solve_without_a_horizon_says_what_is_missing(folder, capsys):
    """A problem for tracking laws has nothing to solve."""
    assert main(["solve", "line.py"]) == 2
    assert "no horizon or no cost" in capsys.readouterr().err


def test_linear_algebra_has_one_thread_unless_the_user_says_otherwise():
    """NumPy is imported after the number is set, so a command of its own process is asked."""
    for given, expected in ((None, "1"), ("2", "2")):
        environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
        environment |= {} if given is None else {"OPENBLAS_NUM_THREADS": given}
        code = "import os, sys\nfrom fpirhc.cli.main import main\nassert 'numpy' not in sys.modules\nmain(['list', '--x'])\n"
        asked = [sys.executable, "-c", f"{code}print(os.environ['OPENBLAS_NUM_THREADS'])"]
        done = subprocess.run(asked, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == expected
