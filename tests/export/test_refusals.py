"""What `fpirhc export` refuses, and what it says: the whole message of each, with what to do instead."""

from __future__ import annotations

import os
import re
import shutil

import pytest
from first_files import messages_of
from kinds import slow_but

from fpirhc.cli.main import main
from fpirhc.export import binaries

IPOPT = """import fpirhc as fp

problem = fp.load_problem("two_mass").problem
controllers = {"ipopt": fp.RecedingHorizon(fp.Ipopt(1e-6), fp.Sigmoid(gain=-0.5, scale=50.0))}
"""
ROWS = messages_of("""
two_mass RHC+FPI --to cc =>
    the target 'cc' is unknown. Did you mean 'c'? Valid: arduino, c, cortex-m, fmu, fmu2, library, ros2_control, simulink, wasm.
two_mas RHC+FPI =>
    problem 'two_mas' is unknown. Did you mean 'two_mass'? Give the path of a problem file, or a name from 'fpirhc list'
own.py ipopt =>
    'ipopt' cannot be exported: it calls a solver that cannot be written as C: its own library is needed
    (coin-or/IpStdCInterface.h). In place of Ipopt use FixedPoint(iterations=1, tolerance=...), which is C of its own
two_mass RHC+FPI --to wasm =>
    the target wasm needs ziglang, which is not installed: pip install 'fpirhc[compiler]'
two_mass RHC+FPI --to cortex-m =>
    the target cortex-m needs ziglang, which is not installed: pip install 'fpirhc[cortex]'
two_mass RHC+FPI --to fmu =>
    the target fmu needs fmpy, which is not installed: pip install 'fpirhc[fmu]'
two_mass RHC+FPI --check =>
    a program of this machine needs a C compiler: compilation is turned off (FPIRHC_CC=none); install gcc or clang, or name one
    by FPIRHC_CC
two_mass RHC+FPI --to library =>
    a shared library needs a C compiler: compilation is turned off (FPIRHC_CC=none); install gcc or clang, or pip install
    'fpirhc[compiler]'
two_mass RHC+FPI --out full =>
    'full' is not an empty folder, and nothing in it is replaced; choose another one with --out
two_mass RHC+FPI --name 2nd =>
    '2nd' cannot be the name of a controller in C: expected at most 40 letters, digits and underscores, a letter first, and no
    word of C or of the files beside it. Did you mean 'c_2nd'?
two_mass RHC+FPI --name replay =>
    'replay' cannot be the name of a controller in C: expected at most 40 letters, digits and underscores, a letter first, and no
    word of C or of the files beside it. Did you mean 'c_replay'?
anaesthesia CTC+FPI --to ros2_control =>
    ros2_control updates a whole number of times per second, and the period is 5 s: the nearest one is 1 s
two_mass RHC+FPI --bare --live deformation.gain =>
    --bare has no live settings, since nothing checks them: leave out 'deformation.gain' or --bare
two_mass RHC+FPI --to arduino --libm own =>
    the target arduino computes in float, and --libm own in double; leave --libm out
two_mass RHC+FPI --to arduino =>
    'two_mass RHC+FPI' fits no board: Uno lacks N bytes of flash and N bytes of RAM; Mega 2560 lacks N bytes of RAM. Use fewer
    stages, or --to cortex-m; with --bare the Mega 2560 still lacks N bytes of RAM
noisy_motor RHC+FPI --to arduino =>
    'noisy_motor RHC+FPI' fits no board: Uno lacks N bytes of flash and N bytes of RAM; Mega 2560 lacks N bytes of RAM. Use
    --bare, which fits the Mega 2560, fewer stages, or --to cortex-m
""")


@pytest.mark.parametrize("row", slow_but(ROWS, *(row for row in ROWS if not row.endswith("RHC+FPI --to arduino"))))
def test_what_is_refused_says_why_and_what_to_do(row, tmp_path, monkeypatch, capsys):
    """Exit code 2, or 3 for a folder; one line, and nothing is written."""
    if row.endswith("--to arduino") and shutil.which("avr-gcc") is None:
        pytest.skip("no avr-gcc (packages gcc-avr and avr-libc)")
    words = row.split()
    (tmp_path / "own.py").write_text(IPOPT)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    for module in ("ziglang", "fmpy"):
        monkeypatch.setitem(__import__("sys").modules, module, None)
    if "--check" in words or "library" in words:
        monkeypatch.setenv("FPIRHC_CC", "none")
        monkeypatch.setattr(binaries, "find_spec", lambda _: None)
    out = [] if "--out" in words else ["--out", "new"]
    code = main(["export", *words, *out, "--cycles", "1"])
    said = re.sub(r"\d+ bytes", "N bytes", capsys.readouterr().err)
    assert said == f"fpirhc: {ROWS[row]}\n"
    assert code == (3 if "full" in words else 2)
    assert not (tmp_path / "new").exists()
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("compiler", "words", "reason"),
    [
        ("broken", "--to library", "no library for {here}: '{compiler}' cannot be started: No such file or directory"),
        (
            "absent",
            "--check",
            "the C compiler '{compiler}', asked for by FPIRHC_CC, was not found; install gcc or clang",
        ),
    ],
)
def test_a_compiler_that_does_not_work_is_named_and_no_folder(compiler, words, reason, tmp_path, monkeypatch, capsys):
    """One whose interpreter is not there cannot be started, which is no fault of the folder."""
    path = tmp_path / compiler
    if compiler == "broken":
        path.write_text("#!/no/such/interpreter\n")
        path.chmod(0o700)
    monkeypatch.setenv("FPIRHC_CC", str(path))
    monkeypatch.setattr(binaries, "find_spec", lambda _: None)
    monkeypatch.chdir(tmp_path)
    assert main(["export", "two_mass", "CTC+FPI (eq 6)", *words.split(), "--out", "new", "--cycles", "1"]) == 2
    assert reason.format(here=binaries._here(), compiler=path) in capsys.readouterr().err


@pytest.mark.skipif(os.name != "posix", reason="a script of a shell")
def test_deviations_from_misra_are_counted_for_any_controller(tmp_path, monkeypatch, capsys):
    """A script stands for cppcheck, which takes a minute; without it nothing is written."""
    words = [
        "export",
        "crane_slots",
        "slots+FPI",
        "--name",
        "crane",
        "--cycles",
        "1",
        "--misra",
        "--out",
        str(tmp_path / "new"),
    ]
    monkeypatch.setattr(shutil, "which", lambda *_, **__: None)
    assert main(words) == 2
    assert capsys.readouterr().err == "fpirhc: --misra needs cppcheck, which is not installed: package cppcheck\n"
    assert not (tmp_path / "new").exists()
    program = tmp_path / "cppcheck"
    program.write_text("#!/bin/sh\nfor one in *_step.c; do echo misra-c2012-10.3; echo misra-c2012-2.2; done >&2\n")
    program.chmod(0o700)
    monkeypatch.setattr(shutil, "which", lambda *_, **__: str(program))
    assert main(words) == 0
    said = (tmp_path / "new" / "misra.md").read_text()
    assert "2 deviations from 2 rules" in said
    assert said.index("| 2.2 | 1 | a value that") < said.index("| 10.3 | 1 | comparisons")
