"""What `fpirhc export` refuses, and what it says: the whole message of each, with what to do instead."""

import re

import pytest
from helpers.first_files import messages_of

from fpirhc.__main__ import main

IPOPT = """import fpirhc as fp

problem = fp.load_problem("two_mass").problem
controllers = {"ipopt": fp.RecedingHorizon(fp.Ipopt(1e-6), fp.Sigmoid(gain=-0.5, scale=50.0))}
"""
ROWS = messages_of("""
two_mass RHC+FPI --to cc =>
    the target 'cc' is unknown; one of arduino, c, fmu2, library, wasm, lab
two_mas RHC+FPI =>
    problem 'two_mas' is unknown. Did you mean 'two_mass'? Give the path of a problem file, or a name from 'fpirhc list'
own.py ipopt =>
    'ipopt' cannot be exported: it calls a solver that is not written as C, but linked as a library (coin-or/IpStdCInterface.h
    is its header). In place of Ipopt use FixedPointSolver(iterations=1, tolerance=...), which is C of its own
two_mass RHC+FPI --to wasm =>
    the target wasm needs ziglang, not installed here: pip install 'fpirhc[compiler]'
two_mass RHC+FPI --to fmu2 =>
    the target fmu2 needs fmpy, not installed here: pip install 'fpirhc[fmu]'
two_mass RHC+FPI --to library =>
    a shared library needs a C compiler: compilation is turned off (FPIRHC_CC=none); install gcc or clang, or pip install
    'fpirhc[compiler]'
two_mass RHC+FPI --out full =>
    'full' is not an empty folder; nothing in it is replaced; choose another with --out
two_mass RHC+FPI --name 2nd =>
    '2nd' cannot be the name of a controller in C: expected at most 40 letters, digits and underscores, a letter first, and no
    word of C or of the files beside it. Did you mean 'c_2nd'?
""")


@pytest.mark.parametrize("row", ROWS)
def test_what_is_refused_says_why_and_what_to_do(row, tmp_path, monkeypatch, capsys):
    """Exit code 2, or 3 for a folder; one line, and nothing is written."""
    words = re.findall(r"RHC\+FPI|\S+", row)
    (tmp_path / "own.py").write_text(IPOPT)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    for module in ("ziglang", "fmpy"):
        monkeypatch.setitem(__import__("sys").modules, module, None)
    if "library" in words:
        monkeypatch.setenv("FPIRHC_CC", "none")
    code = main(["export", *words, *([] if "--out" in words else ["--out", "new"])])
    assert capsys.readouterr().err == f"fpirhc: {ROWS[row]}\n"
    assert code == (3 if "full" in words else 2)
    assert not (tmp_path / "new").exists()
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["mine.txt"]


def test_a_compiler_that_does_not_work_is_named_and_no_folder(tmp_path, monkeypatch, capsys):
    """One whose interpreter is not there cannot be started, which is no fault of the folder."""
    path = tmp_path / "broken"
    path.write_text("#!/no/such/interpreter\n")
    path.chmod(0o700)
    monkeypatch.setenv("FPIRHC_CC", str(path))
    monkeypatch.chdir(tmp_path)
    assert main(["export", "two_mass", "CTC+FPI (eq 6)", "--to", "library", "--out", "new"]) == 2
    assert f"'{path}' cannot be started: No such file or directory" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
