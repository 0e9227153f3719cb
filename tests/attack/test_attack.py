"""A machine survives what sensors, actuators, clocks and disks do: a share of the attacks here, all of them with `-m slow`."""

import pytest
from helpers.attack.artefacts import ARTEFACTS, flipped
from helpers.attack.commands import prepared, random_line, raw_end
from helpers.attack.faults import FAULTS
from helpers.attack.files import killed_compilations
from helpers.attack.harness import PROBLEMS, Bench, shipped
from helpers.machine import needs_compiler

import fpirhc as fp

QUICK = (("two_mass", "CTC+FPI (eq 6)"), ("two_mass", "RHC+FPI"), ("noisy_motor", None))


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
    wrong: dict[str, str] = {}
    for label, task, controller in shipped():
        if label.startswith(f"{problem}/"):
            bench = Bench(task, controller)
            wrong |= {f"{label}: {fault.name}": bench.outcome(fault).wrong for fault in FAULTS}
    assert {k: v for k, v in wrong.items() if v} == {}


@pytest.mark.slow
@needs_compiler
def test_compilations_survive_their_kills(tmp_path):
    """The next process has right numbers."""
    assert killed_compilations(tmp_path / "kills", 30, seed=1) == 0


@pytest.mark.parametrize("flips", [40, pytest.param(400, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ARTEFACTS)
def test_flipped_bits_of_files_are_noticed(name, flips, tmp_path):
    """A saved run with a flipped bit is refused by name, or reads as it was written."""
    result = flipped(name, tmp_path / "flips", flips, seed=flips)
    assert (result.raw, result.unnoticed) == ((), 0)


@pytest.mark.parametrize("count", [30, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_command_lines(count, tmp_path):
    """A documented exit code, words for what is wrong, and never a traceback."""
    with prepared(tmp_path / "work"):
        assert [end for end in (raw_end(random_line(count + k)) for k in range(count)) if end] == []
