"""Controllers as mock-up units: valid by FMPy, equal to the stepper and to a run, and strict about what a master may do."""

from __future__ import annotations

import re
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from fmi_master import apart_from_a_run, master

import fpirhc as fp
from fpirhc.errors import NotSupported
from fpirhc.export import binaries
from fpirhc.export.device import Device
from fpirhc.export.target import device_of, target_called, write
from fpirhc.symbolic.native import find_compiler

REASON = "FMPy is not installed: pip install 'fpirhc[fmu]'"
fmi1 = pytest.importorskip("fmpy.fmi1", reason=REASON)
validation = pytest.importorskip("fmpy.validation", reason=REASON)
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
CASES = {
    "torque": ("two_mass", "CTC+FPI (eq 6)", ("deformation.gain", "limits.inputs.Q1")),
    "plan": ("two_mass", "RHC+FPI", ()),
    "outputs": ("anaesthesia", "RHC+FPI", ()),
    "map": ("fishery", "RHC+FPI", ()),
}


@pytest.fixture(autouse=True)
def only_this_machine(monkeypatch):
    """Libraries for other platforms take half a minute the first time; one test asks for them."""
    monkeypatch.setattr(binaries, "find_spec", lambda _: None)


def exported(name: str, folder: Path, target: str) -> tuple[Device, Path]:
    of, title, live = CASES[name]
    task = fp.load_problem(of)
    device = device_of(task.problem, task.controllers[title], title, name="unit", live=live, cycles=1)
    write(device, target_called(target), folder)
    return device, folder / "unit.fmu"


@needs_compiler
@pytest.mark.parametrize(
    ("name", "target"), [*((name, "fmu") for name in CASES), ("torque", "fmu2"), ("outputs", "fmu2")]
)
def test_a_unit_is_valid_and_its_commands_are_those_of_the_stepper_bit_by_bit(name, target, tmp_path):
    """FMPy finds nothing wrong, and 300 samples of a run give the commands and statuses that the stepper gives."""
    device, path = exported(name, tmp_path, target)
    assert validation.validate_fmu(str(path)) == []
    period = device.problem.period
    run = fp.simulate(device.problem, device.controller, seed=0)
    samples = np.hstack([np.reshape(run[n], (len(run.time), -1)) for n in device.inputs.names[1:]])
    memory = device.stepper.start()
    with master(path) as unit:
        inputs, outputs = unit.names("input"), unit.names("output")
        for k in range(min(300, len(samples))):
            unit.set(inputs, samples[k])
            command, memory = device.stepper.step_measured(k * period, samples[k], memory)
            assert unit.get(outputs).tolist() == command.tolist(), k
            assert unit.get(["trace.status"])[0] == unit.status() == device.stepper.trace()["status"]
            unit.step(k * period, period)


@needs_compiler
def test_a_loop_of_unit_and_plant_is_the_run_where_inputs_pass_through_and_late_where_they_do_not(tmp_path):
    """A master that exchanges after each step alone is a dead time of one period: newtons off, and told on the page."""
    device, path = exported("plan", tmp_path, "fmu")
    state, command = apart_from_a_run(device.problem, device.controller, path, 500)
    assert state < 1e-12
    assert command < 1e-11
    assert apart_from_a_run(device.problem, device.controller, path, 500, late=True)[1] > 1.0
    assert "every command one period late" in (tmp_path / "README.md").read_text()
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "in")
    (tmp_path / "in" / "size.c").write_text('#include "sources/unit_fmu.c"\nchar size_of_it[sizeof(cycle_state)];\n')
    compiled = [str(find_compiler()), "-Isources", "-c", "size.c", "-o", "size.o"]
    subprocess.run(compiled, cwd=tmp_path / "in", check=True)
    symbols = subprocess.run(["nm", "-S", "size.o"], cwd=tmp_path / "in", capture_output=True, text=True, check=True)
    size = re.search(r"\w+ (\w+) \w size_of_it", symbols.stdout)
    assert size is not None
    said = (tmp_path / "sizes.txt").read_text()
    assert f"an instance: {int(size[1], 16)} bytes of RAM\nhere with -Os: " in said
    assert said.endswith(" of stack\n")


@needs_compiler
@pytest.mark.parametrize("target", ["fmu", "fmu2"])
def test_what_a_master_may_not_do(target, tmp_path):
    """Wrong settings, other steps, numbers that are computed: refused, and the unit stays as it was."""
    device, path = exported("torque", tmp_path, target)
    period, gain = device.problem.period, "setting.deformation.gain"
    with master(path) as unit:
        start = unit.get([gain])[0]
        assert (unit.variables[gain].min, unit.variables[gain].max) == tuple(
            None if np.isinf(e) else repr(e) for e in device.bounds["deformation.gain"]
        )
        for wrong in (np.nan, np.inf, 3.0):
            with pytest.raises(fmi1.FMICallException):
                unit.set([gain], np.array([wrong]))
            assert unit.get([gain])[0] == start
        unit.set([gain], np.array([start / 2]))
        assert unit.get([gain])[0] == start / 2
        for name in ("command.Q1", "trace.clipped", "time"):
            with pytest.raises(fmi1.FMICallException):
                unit.set([name], np.zeros(1))
        for step in (2 * period, 0.5 * period, np.nan):
            with pytest.raises(fmi1.FMICallException):
                unit.step(0.0, step)
        assert unit.get(["time"])[0] == 0.0


@needs_compiler
@pytest.mark.parametrize("target", ["fmu", "fmu2"])
def test_a_state_that_is_kept_comes_back_and_a_reset_begins_anew(target, tmp_path):
    """The same samples after both give the same commands; another unit beside it does not notice."""
    device, path = exported("plan", tmp_path, target)
    period, run = device.problem.period, fp.simulate(device.problem, device.controller, seed=0)
    samples = np.hstack([np.reshape(run[n], (len(run.time), -1)) for n in device.inputs.names[1:]])
    with master(path) as unit, master(path) as other:
        inputs, outputs = unit.names("input"), unit.names("output")

        def cycles(first: int, last: int) -> list[list[float]]:
            said = []
            for k in range(first, last):
                unit.set(inputs, samples[k])
                said.append(unit.get(outputs).tolist())
                unit.step(k * period, period)
            return said

        before = cycles(0, 20)
        kept = unit.unit.getFMUState()
        after = cycles(20, 40)
        unit.unit.setFMUState(kept)
        assert cycles(20, 40) == after
        unit.unit.freeFMUState(kept)
        other.set(inputs, samples[0])
        assert other.get(outputs).tolist() == before[0]
        unit.unit.reset()
        unit.begin()
        assert cycles(0, 20) == before


@needs_compiler
@pytest.mark.parametrize("target", ["fmu", "fmu2"])
def test_what_is_read_before_the_start_is_not_the_command_of_the_start(target, tmp_path):
    """The reference is another one at t = 5 s."""
    _, path = exported("torque", tmp_path, target)
    said = []
    with master(path) as unit:
        for early in (True, False):
            unit.unit.reset()
            if early:
                unit.get(unit.names("output"))
            unit.begin(5.0)
            said.append(unit.get(unit.names("output")).tolist())
    assert said[0] == said[1]


def test_without_a_compiler_a_unit_holds_its_sources_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(binaries, "find_compiler", lambda: None)
    exported("torque", tmp_path, "fmu")
    names = zipfile.ZipFile(tmp_path / "unit.fmu").namelist()
    assert not [name for name in names if name.startswith("binaries/")]
    assert {"sources/buildDescription.xml", "sources/unit.c", "sources/unit_fmu.c", "sources/fmi3Functions.h"} <= {
        *names
    }
    assert "none: no compiler was found" in (tmp_path / "README.md").read_text()


def test_the_same_controller_gives_the_same_archive(tmp_path):
    _, first = exported("torque", tmp_path / "a", "fmu2")
    _, second = exported("torque", tmp_path / "b", "fmu2")
    assert first.read_bytes() == second.read_bytes()


def test_without_fmpy_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "fmpy", None)
    with pytest.raises(NotSupported, match=r"the target fmu needs fmpy.*fpirhc\[fmu\]"):
        exported("torque", tmp_path, "fmu")


@pytest.mark.slow
def test_one_archive_serves_five_platforms(tmp_path, monkeypatch):
    """By zig: libraries whose first bytes are those of Linux, Windows and macOS."""
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[compiler]'")
    monkeypatch.undo()
    _, path = exported("torque", tmp_path, "fmu")
    archive = zipfile.ZipFile(path)
    first = {"linux": b"\x7fELF", "windows": b"MZ", "darwin": b"\xcf\xfa\xed\xfe"}
    libraries = {name.split("/")[1]: archive.read(name)[:4] for name in archive.namelist() if "binaries/" in name}
    assert set(libraries) == set(binaries.PLATFORMS)
    for platform, head in libraries.items():
        assert head.startswith(first[platform.partition("-")[2]])
