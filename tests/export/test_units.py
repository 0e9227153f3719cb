"""Controllers as mock-up units: valid by FMPy, equal to the stepper and to a run, and strict about what a master may do."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc.errors import NotSupported
from fpirhc.export import binaries
from fpirhc.export.device import Device
from fpirhc.export.target import device_of, target_called, write

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
