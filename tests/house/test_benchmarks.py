"""The scripts that write the tables of `docs/performance.md`: they start, and replace what is there."""

from __future__ import annotations

import importlib
import pkgutil
import re
from pathlib import Path

import gate
import numpy as np
import pytest
import tasks

import fpirhc as fp

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py"))


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_starts_and_what_it_replaces_is_there(name):
    """The type checker reads every name of a script, but not those that it patches as texts."""
    importlib.import_module(name)
    for target in re.findall(r'patch\(\s*"([\w.]+)"', (FOLDER / f"{name}.py").read_text(encoding="utf-8")):
        assert pkgutil.resolve_name(target) is not None


@pytest.mark.parametrize("name", gate.CONTROLLERS)
def test_without_its_gate_a_step_is_the_same_but_checks_nothing(name):
    """What `gate.py` compares: the same commands for good samples, and a bad one that reaches the controller."""
    problem, controller = tasks.two_mass.problem, tasks.two_mass.controllers[name]
    with gate.no_gate():
        bare = fp.Stepper(problem, controller, compiled=False)
    steppers = [bare, fp.Stepper(problem, controller, compiled=False)]
    memories = [s.start() for s in steppers]
    sample = problem.start_state, np.zeros(len(problem.plant.inputs))
    for k in range(5):
        (a, memories[0]), (b, memories[1]) = [
            s.step(k * problem.period, *sample, m) for s, m in zip(steppers, memories, strict=True)
        ]
        np.testing.assert_array_equal(a, b)
    bad = np.full_like(sample[0], np.nan), sample[1]
    for stepper, memory in zip(steppers, memories, strict=True):
        stepper.step(5 * problem.period, *bad, memory)
    statuses = [int(stepper.trace()["status"][0]) for stepper in steppers]
    assert statuses[1] == fp.Status.BAD_SAMPLE != statuses[0]
