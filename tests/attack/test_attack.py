"""A machine survives what clocks, disks and random command lines do: a share of the attacks here, all of them with `-m slow`."""

import contextlib
import io
import os
import random
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.line import line_text
from helpers.machine import needs_compiler
from helpers.plants import simulated

import fpirhc as fp
from fpirhc.__main__ import main
from fpirhc.errors import FpirhcError

LINE = line_text(
    "period=5e-3, duration=0.2, measure_from=0.05, limits=fp.Limits(inputs={'u': (-50.0, 50.0)}), "
    "disturbances={'u': fp.Noise(0.1)}",
    bounds="(0.5, 2.4)",
)
CHEAP = ("accept", "check", "compare", "list", "new", "review", "run", "study", "tune")
WORDS = (
    "line.py", "line.py", "line.py", "no_such.py", "broken.py", "empty.py", "two_mas", "", ".", "/", "CTC", "CTC+FPI", "CTC+FP",
    "0", "1", "2", "-1", "1e300", "nan", "inf", "0.1%", "x", "--", "-", "y", "out", "file", "\x00", "ü", "a" * 300, "=", "a=b",
    "deformation.gain=-0.4", "tracking.rate=nan", "rms error", "*", "../..", "~", "bash", "csh",
)  # fmt: skip
FLAGS = ("--help", "--debug", "--no-such-option", "-x", "--out", "--draws", "--processes", "--seed", "--no-compile")
SLOW = ("--trials", "--draws", "--seeds", "--processes", "--cycles")  # options with a number that is kept small
CODES = {0, 1, 2, 3, 4, 5, 6}


@cache
def options_of(name: str) -> list[tuple[str, bool]]:
    """Options of a command and whether a value follows them, as its help has them."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        main([name, "--help"])
    found = re.findall(r"^ +(?:-\w, )?(--[a-z-]+)(?: ([A-Z<\[].*?))?(?:  |$)", said.getvalue(), re.MULTILINE)
    assert found
    return [(option, bool(value)) for option, value in found]


def random_line(seed: int) -> list[str]:
    """The words of one command line."""
    numbers = random.Random(seed)
    if numbers.random() < 0.05:
        return [numbers.choice((*WORDS, *FLAGS)) for _ in range(numbers.randrange(3))]
    name = numbers.choice(CHEAP)
    options = options_of(name)
    words = [name, *(["line.py"] if numbers.random() < 0.7 else [])]
    for _ in range(numbers.choice((0, 0, 1, 1, 2, 3, 4))):
        if options and numbers.random() < 0.6:
            option, takes = numbers.choice(options)
            value = numbers.choice(("0", "-1", "1", "2", "x")) if option in SLOW else numbers.choice(WORDS)
            words += [option, value] if takes and numbers.random() < 0.9 else [option]
        else:
            words.append(numbers.choice((*WORDS, *FLAGS)))
    # What runs is short: few trials, and no compiler.
    return [*words, "--trials", "2"] if name == "tune" else words


def raw_end(words: list[str]) -> str:
    """What is wrong with the end of a command line; empty where nothing is. A working folder must have been prepared."""
    printed, complained = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(complained):
        try:
            code = main(list(words))
        except BaseException as error:  # noqa: BLE001 -- what is looked for
            return f"{words}: {type(error).__name__}: {error}"
    if code not in CODES:
        return f"{words}: exit code {code}: {complained.getvalue()[-300:]}"
    if "Traceback" in complained.getvalue() and "--debug" not in words:
        return f"{words}: a traceback"
    if code == 2 and not (printed.getvalue() + complained.getvalue()).strip():
        return f"{words}: bad input without a word"
    return ""


@contextlib.contextmanager
def prepared(folder: Path) -> Iterator[None]:
    """A working folder with a good problem, a broken one and an empty one; commands find no compiler there."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "line.py").write_text(LINE, encoding="utf-8")
    (folder / "broken.py").write_text("plant = (", encoding="utf-8")
    (folder / "empty.py").write_text("", encoding="utf-8")
    (folder / "file").write_text("no folder", encoding="utf-8")
    before, compiler = Path.cwd(), os.environ.get("FPIRHC_CC")
    os.environ["FPIRHC_CC"] = "none"
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
        if compiler is None:
            del os.environ["FPIRHC_CC"]
        else:
            os.environ["FPIRHC_CC"] = compiler


@pytest.mark.slow
@needs_compiler
def test_compilations_survive_their_kills(tmp_path):
    """A process is killed while it loads, compiles or runs: the next one has the same numbers."""
    command, logs = [sys.executable, "-m", "fpirhc", "run", "two_mass", "CTC", "--out", str(tmp_path)], set()
    for seconds in np.linspace(0.1, 6.0, 12):
        place = {**os.environ, "FPIRHC_CACHE": str(tmp_path / f"{seconds}")}
        with suppress(subprocess.TimeoutExpired):
            subprocess.run(command, env=place, capture_output=True, timeout=seconds)
        subprocess.run(command, env=place, capture_output=True, check=True)
        logs.add(fp.load_run(tmp_path / "CTC.npz").log.tobytes())
    assert len(logs) == 1


@pytest.mark.parametrize("flips", [40, pytest.param(400, marks=pytest.mark.slow)])
def test_flipped_bits_of_a_saved_run_are_noticed(flips, tmp_path):
    """It is refused by name, or reads as it was written."""
    task, path = fp.load_problem("two_mass"), tmp_path / "run.npz"
    short = replace(task.problem, duration=0.02, measure_from=0.0)
    simulated(short, task.controllers["CTC"]).save(path)
    told = lambda run: (run.log.tobytes(), *(repr(v) for n, v in vars(run).items() if n != "log"))  # noqa: E731
    written, whole = told(fp.load_run(path)), path.read_bytes()
    for place in np.random.default_rng(flips).integers(0, 8 * len(whole), size=flips):
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << (place % 8)
        path.write_bytes(damaged)
        with suppress(FpirhcError):
            assert told(fp.load_run(path)) == written, place


@pytest.mark.parametrize("count", [30, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_command_lines(count, tmp_path):
    """A documented exit code, words for what is wrong, and never a traceback."""
    with prepared(tmp_path / "work"):
        assert [end for end in (raw_end(random_line(count + k)) for k in range(count)) if end] == []
