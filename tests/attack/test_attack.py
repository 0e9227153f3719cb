"""A machine survives what sensors, actuators, clocks and disks do: a share of the attacks here, all of them with `-m slow`."""

from __future__ import annotations

import pytest

import fpirhc as fp
from attack.faults import FAULTS
from attack.files import flipped_bits, killed_compilations
from attack.harness import PROBLEMS, Bench, shipped
from fpirhc.symbolic.native import find_compiler

QUICK = (("two_mass", "CTC+FPI (eq 6)"), ("two_mass", "RHC+FPI"), ("noisy_motor", None))
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")


@pytest.mark.parametrize(("problem", "name"), QUICK)
def test_faults_of_the_loop(problem, name):
    """No raw error, no command outside its limits, no controller frozen; a single bad sample is a tick left out."""
    task = fp.load_problem(problem)
    bench = Bench(task.problem, task.controllers[name or next(iter(task.controllers))])
    wrong = {fault.name: bench.outcome(fault).wrong for fault in FAULTS}
    assert {k: v for k, v in wrong.items() if v} == {}


@pytest.mark.slow
@pytest.mark.parametrize("problem", PROBLEMS)
def test_every_fault_of_the_loop(problem):
    """The same for every shipped controller of a problem."""
    wrong: dict[str, str] = {}
    for label, task, controller in shipped():
        if label.startswith(f"{problem}/"):
            bench = Bench(task, controller)
            wrong |= {f"{label}: {fault.name}": bench.outcome(fault).wrong for fault in FAULTS}
    assert {k: v for k, v in wrong.items() if v} == {}


@needs_compiler
def test_flipped_bits_of_a_library_are_noticed(tmp_path):
    """No library with a flipped bit, and none with a flipped bit in its checksum, is loaded."""
    assert flipped_bits(tmp_path, 40, seed=0) == 0


@pytest.mark.slow
@needs_compiler
def test_every_flipped_bit_and_every_kill(tmp_path):
    """400 flipped bits, and 30 compilations that are killed: the next process has right numbers."""
    assert flipped_bits(tmp_path / "flips", 400, seed=1) == 0
    assert killed_compilations(tmp_path / "kills", 30, seed=1) == 0
