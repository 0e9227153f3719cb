"""A controller as a shared library with arrays: it answers samples as the stepper does, bit by bit."""

from __future__ import annotations

import ctypes
import json
from pathlib import Path

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.export.device import Device
from fpirhc.export.target import device_of, target_called, write
from fpirhc.symbolic.native import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
LIVE = ("deformation.gain", "limits.inputs.Q1")
GAIN, CYCLES = -0.25, 40
CHANGE, LATER = 30, -0.3  # another gain from a cycle on


def exported(folder: Path, target: str) -> Device:
    task = fp.load_problem("two_mass")
    title = "CTC+FPI (eq 6)"
    device = device_of(task.problem, task.controllers[title], title, name="arm", live=LIVE, cycles=1)
    write(device, target_called(target), folder)
    return device


def answered(device: Device) -> tuple[np.ndarray, np.ndarray]:
    """Samples, one of them bad, and what the stepper answers to them with other gains: status and command of each cycle."""
    generator, period = np.random.default_rng(3), device.problem.period
    rows = np.tile([0.0, 1.9, 5.4, 0.0, 0.0, 0.1, -0.2], (CYCLES, 1)) + 1e-3 * generator.standard_normal((CYCLES, 7))
    rows[:, 0] = period * np.arange(CYCLES)
    rows[20, 1] = np.nan
    assert isinstance(device.stepper, fp.Stepper)
    device.stepper.change({"deformation.gain": GAIN})
    memory, answers = device.stepper.start(), []
    for k, row in enumerate(rows):
        if k == CHANGE:
            device.stepper.change({"deformation.gain": LATER})
        command, memory = device.stepper.step_measured(row[0], row[1:], memory)
        answers.append([float(device.stepper.trace()["status"].ravel()[0]), *command])
    return rows, np.array(answers)


@needs_compiler
def test_a_library_answers_as_the_stepper_bit_by_bit(tmp_path):
    """Arrays in and out by ctypes, two controllers side by side, a setting by its number."""
    device = exported(tmp_path, "library")
    [path] = [one for one in tmp_path.glob("arm_*") if one.suffix in (".so", ".dylib", ".dll")]
    called = ctypes.CDLL(str(path))
    first, other = (ctypes.create_string_buffer(called.arm_size()) for _ in range(2))
    called.arm_begin(first), called.arm_begin(other)
    settings = list(json.loads((tmp_path / "layout.json").read_text())["bounds"])
    assert called.arm_change(first, settings.index("deformation.gain"), ctypes.c_double(3.0)) == 0
    assert called.arm_change(first, 99, ctypes.c_double(GAIN)) == 0
    assert called.arm_change(first, settings.index("deformation.gain"), ctypes.c_double(GAIN)) == 1
    rows, answers = answered(device)
    command, said, apart = (ctypes.c_double * 2)(), [], False
    for k, row in enumerate(rows):
        if k == CHANGE:
            assert called.arm_change(first, settings.index("deformation.gain"), ctypes.c_double(LATER)) == 1
        sample = (ctypes.c_double * 7)(*row)
        called.arm_cycle(other, sample, command)
        before = list(command)
        said.append([called.arm_cycle(first, sample, command), *command])
        apart |= list(command) != before
    np.testing.assert_array_equal(np.array(said), answers)
    assert apart
