"""Wrong input at the command line: a message says what is wrong and where, what was expected, the nearest name, and what to write.

Every row is a command, its exit code and its message. Nothing runs before it, there is no traceback, and no file is written.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from fpirhc.cli.main import main

CONTROLLERS = (
    "Valid: 'CTC', 'CTC+FPI (eq 3)', 'CTC+FPI (eq 6)', 'RHC', 'RHC+FPI, model-referenced', 'RHC+FPI', 'RHC exact model', "
    "'RHC, absolute effort', 'RHC+FPI, absolute effort', 'RHC, stiff', 'RHC+FPI, stiff, small S'."
)
UNKNOWN = "problem 'two_mass': controller '{}' is unknown.{} " + CONTROLLERS
NEITHER = "neither the controller nor the problem's cost, limits, dead_time, reference, sensing, disturbances have"
ROWS = {
    "fpirhc comprae two_mass": (
        2,
        "the command 'comprae' is unknown. Did you mean 'compare'? Valid: accept, check, compare, ",
    ),
    # problems
    "fpirhc compare": (
        2,
        "PROBLEM (name of a shipped problem, or path of a problem file) is missing. See fpirhc compare --help.",
    ),
    "fpirhc compare two_mas": (
        2,
        "problem 'two_mas' is unknown. Did you mean 'two_mass'? Give the path of a problem file, or a name",
    ),
    "fpirhc review nosuch": (
        2,
        "problem 'nosuch' is unknown. Give the path of a problem file, or a name from 'fpirhc list'",
    ),
    "fpirhc compare nosuch.py": (
        2,
        "no file at 'nosuch.py'. Give the path of a problem file, or a name from 'fpirhc list'",
    ),
    "fpirhc compare folder": (2, "'folder' is a folder; a problem file ends in .py"),
    "fpirhc compare text.txt": (2, "'text.txt' is not a Python file; a problem file ends in .py"),
    "fpirhc run empty.py CTC": (
        2,
        "problem file 'empty.py': 2 mistakes 1. it must define problem = fpirhc.Problem(...), outside every function 2. it must "
        "define controllers = {'name': fpirhc.ComputedTorque(...), ...}",
    ),
    "fpirhc tune syntax.py": (2, "syntax.py, line 1: invalid syntax def problem(:"),
    # names
    "fpirhc compare two_mass --controllers RHC+FIP": (2, UNKNOWN.format("RHC+FIP", " Did you mean 'RHC+FPI'?")),
    "fpirhc run two_mass RHC+FP": (2, UNKNOWN.format("RHC+FP", " Did you mean 'RHC+FPI'?")),
    "fpirhc review two_mass --controllers CTX": (2, UNKNOWN.format("CTX", " Did you mean 'CTC'?")),
    "fpirhc export two_mass RHX --out o": (2, UNKNOWN.format("RHX", " Did you mean 'RHC'?")),
    "fpirhc replay two_mass X bad.csv": (2, UNKNOWN.format("X", "")),
    "fpirhc probe two_mass --controller X": (2, UNKNOWN.format("X", "")),
    "fpirhc lab two_mass --controllers X": (2, UNKNOWN.format("X", "")),
    "fpirhc limits two_mass --controllers X": (2, UNKNOWN.format("X", "")),
    "fpirhc limits two_mass --over nosuch": (
        2,
        "quantity 'nosuch' is unknown. Did you mean 'noise'? Valid: mismatch, latency, ",
    ),
    "fpirhc compare two_mass --headline rmse": (
        2,
        "metric 'rmse' is unknown. Did you mean 'rms_error'? Valid: relative error, ",
    ),
    "fpirhc compare two_mass --optimisers ipot": (
        2,
        "optimiser 'ipot' is unknown. Did you mean 'ipopt'? Valid: fixed-point, ipopt, ",
    ),
    "fpirhc compare two_mass --cases heavy": (
        2,
        "problem 'two_mass' has no cases; add to its file cases = fpirhc.Cases({'heavy': ",
    ),
    "fpirhc run two_mass CTC --case heavy": (
        2,
        "problem 'two_mass' has no cases; add cases = fpirhc.Cases({...}) to its file",
    ),
    "fpirhc export two_mass RHC --to matlab --out o": (
        2,
        "the target 'matlab' is unknown. Valid: arduino, c, cortex-m, fmu, fmu2, library, ",
    ),
    "fpirhc export two_mass CTC --out o --name int": (
        2,
        "'int' cannot be the name of a controller in C: expected at most 40 letters, ",
    ),
    "fpirhc completion tcsh2": (2, "SHELL 'tcsh2' is unknown. Did you mean 'tcsh'? Valid: bash, zsh, fish, tcsh."),
    "fpirhc new 'two mass'": (
        2,
        "'two mass' is no name for a problem: it must begin with a letter and go on with letters, digits ",
    ),
    "fpirhc new 2mass": (2, "Try 'plant_2mass'; a folder is given by --dir"),
    # options
    "fpirhc list --x": (2, "the option '--x' is unknown. Valid: --help, --debug. See fpirhc list --help."),
    "fpirhc compare two_mass --controllers": (
        2,
        "--controllers needs a value: --controllers NAME. See fpirhc compare --help.",
    ),
    "fpirhc tune two_mass CTC": (
        2,
        "'CTC' is a word too many; write fpirhc tune PROBLEM [options]. See fpirhc tune --help.",
    ),
    "fpirhc doctor x": (2, "'x' is a word too many; write fpirhc doctor [options]. See fpirhc doctor --help."),
    "fpirhc accept two_mass": (2, "--reason is missing. See fpirhc accept --help."),
    "fpirhc run two_mass CTC --seed -1": (
        2,
        "--seed: expected a whole number of at least 0, got '-1'. See fpirhc run --help.",
    ),
    "fpirhc compare two_mass --seed 1.5": (2, "--seed: expected a whole number of at least 0, got '1.5'."),
    "fpirhc compare two_mass --processes 0": (2, "--processes: expected a whole number of at least 1, got '0'."),
    "fpirhc compare two_mass --scenarios 5": (
        2,
        "every scenario would be the same: the problem has no disturbances and no parameter ",
    ),
    "fpirhc compare two_mass --mismatch a": (
        2,
        "--mismatch: expected percent from 0 to below 100, such as 20%, got 'a'.",
    ),
    "fpirhc review two_mass --mismatch -1": (
        2,
        "--mismatch: expected percent from 0 to below 100, such as 20%, got '-1'. See fpirhc review --help.",
    ),
    "fpirhc accept two_mass --reason x --seeds 1": (2, "--seeds: expected a whole number of at least 2, got '1'."),
    "fpirhc export two_mass CTC --out o --cycles -3": (2, "--cycles: expected a whole number of at least 1, got '-3'."),
    "fpirhc export two_mass CTC --out o --to fmu --check": (2, "--check is there for c, cortex-m, not for fmu"),
    "fpirhc probe two_mass --cycles 3": (
        2,
        "probe: 3 cycles are too few to tell a gain from noise; expected at least 40, 300 are usual",
    ),
    # settings
    "fpirhc run two_mass RHC+FPI --set gain=-1": (
        2,
        f"setting 'gain': {NEITHER} 'gain'. Did you mean 'optimiser.map.gain' or ",
    ),
    "fpirhc run two_mass RHC+FPI --set deformation.gian=-1": (
        2,
        "(Sigmoid) has no 'gian'. Did you mean 'gain'? Valid: gain, shift, scale.",
    ),
    "fpirhc run two_mass RHC --set deformation.gain=-1": (
        2,
        "setting 'deformation.gain': 'deformation' of the controller (Identity) has no 'gain'. It has no settings; the "
        "controller has settings in: optimiser, replanning.",
    ),
    "fpirhc run two_mass RHC+FPI --set deformation.gain": (
        2,
        "--set deformation.gain: expected PATH=NUMBER, such as deformation.gain=-1.2, ",
    ),
    "fpirhc run two_mass RHC+FPI --set limits.inputs.Q3=1,2": (
        2,
        "setting 'limits.inputs.Q3': 'limits.inputs' of the problem has no 'Q3'. Did you mean 'Q2'? Valid: Q1, Q2.",
    ),
    "fpirhc run two_mass CTC --set limits.inputs.Q1=5,-5": (
        2,
        "problem: limits: 'Q1' has lower 5.0 above upper -5.0; swap them",
    ),
    "fpirhc export two_mass CTC --out o --live gain": (2, f"setting 'gain': {NEITHER} 'gain'."),
    # files
    "fpirhc compare two_mass --tuned nosuch.json": (
        2,
        "cannot read 'nosuch.json': No such file or directory; 'fpirhc tune two_mass'",
    ),
    "fpirhc compare two_mass --tuned text.txt": (2, "'text.txt' is not a file that 'fpirhc tune' wrote"),
    "fpirhc replay two_mass CTC nosuch.csv": (2, "recording 'nosuch.csv' cannot be read: No such file or directory"),
    "fpirhc replay two_mass CTC bad.csv": (2, "recording bad.csv: line 2 has 1 entries, the line of names 2"),
    "fpirhc compare two_mass --out text.txt": (
        3,
        "cannot write to the folder 'text.txt': it is a file; choose another with --out",
    ),
    "fpirhc run two_mass CTC --out text.txt": (
        3,
        "cannot write to the folder 'text.txt': it is a file; choose another with --out",
    ),
    "fpirhc lab two_mass --out text.txt/lab.html": (
        3,
        "cannot write to the folder 'text.txt': it is a file; choose another with --out",
    ),
    "fpirhc new arm --dir text.txt": (
        3,
        "cannot write to the folder 'text.txt': it is a file; choose another with --dir",
    ),
    "fpirhc export two_mass CTC --out folder --cycles 1": (
        3,
        "'folder' is not an empty folder, and nothing in it is replaced; choose another",
    ),
}


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """A folder with wrong files."""
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    contents = {
        "folder/kept": "",
        "empty.py": "",
        "syntax.py": "def problem(:\n",
        "text.txt": "hello",
        "bad.csv": "a,b\n1\n",
    }
    for file, text in contents.items():
        Path(file).write_text(text, encoding="utf-8")
    return tmp_path


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("command", ROWS)
def test_wrong_input_is_named(command, place, capsys):
    before, (code, message) = files(place), ROWS[command]
    assert main(shlex.split(command)[1:]) == code
    printed = capsys.readouterr()
    said = re.sub(r"\s+", " ", printed.err)
    assert said.strip().startswith("fpirhc: ")
    assert message in said
    assert "Traceback" not in said
    assert printed.out == ""
    assert files(place) == before
