"""A machine survives what sensors, actuators, clocks and disks do: a share of the attacks here, all of them with `-m slow`."""

import os
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from helpers.attack.commands import prepared, random_line, raw_end
from helpers.attack.faults import FAULTS
from helpers.attack.harness import PROBLEMS, Bench, shipped
from helpers.machine import needs_compiler
from helpers.plants import simulated

import fpirhc as fp
from fpirhc.errors import FpirhcError

QUICK = (("two_mass", "CTC+FPI (eq 6)"), ("two_mass", "RHC+FPI"), ("noisy_motor", None))


@pytest.mark.parametrize(("problem", "name"), QUICK)
def test_faults_of_the_loop(problem, name):
    """No raw error, no command outside its limits, no controller frozen; a single bad sample is a tick left out."""
    task = fp.load_problem(problem)
    bench = Bench(task.problem, task.controllers[name or next(iter(task.controllers))])
    wrong = {fault.name: bench.wrong(fault) for fault in FAULTS}
    assert {k: v for k, v in wrong.items() if v} == {}


@pytest.mark.slow
@pytest.mark.parametrize("problem", PROBLEMS)
def test_every_fault_of_the_loop(problem):
    wrong: dict[str, str] = {}
    for label, task, controller in shipped():
        if label.startswith(f"{problem}/"):
            bench = Bench(task, controller)
            wrong |= {f"{label}: {fault.name}": bench.wrong(fault) for fault in FAULTS}
    assert {k: v for k, v in wrong.items() if v} == {}


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
