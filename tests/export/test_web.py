"""Controllers as WebAssembly: the commands of the same C on this machine bit by bit, and a wrapper that checks what it is told."""

from __future__ import annotations

import json
import math
import re
import shutil
import struct
import subprocess
from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc.errors import NotSupported
from fpirhc.export.device import Device
from fpirhc.export.target import device_of, target_called, write
from fpirhc.symbolic.native import find_compiler

CASES = {
    "torque": ("two_mass", "CTC+FPI (eq 6)"),
    "plan": ("two_mass", "RHC+FPI"),
    "outputs": ("anaesthesia", "RHC+FPI"),
}
LIVE = {"torque": ("deformation.gain", "limits.inputs.Q1")}


def exported(name: str, folder: Path, target: str, cycles: int = 2000) -> Device:
    of, title = CASES[name]
    task = fp.load_problem(of)
    live = LIVE.get(name, ())
    device = device_of(task.problem, task.controllers[title], title, name="arm", live=live, cycles=cycles, libm="own")
    write(device, target_called(target), folder)
    return device


def node(folder: Path, text: str) -> str:
    """What a module prints that has the wrapper and its bytes."""
    head = 'import { readFileSync } from "node:fs";\nimport { layout, load } from "./arm.mjs";\n'
    bytes_ = 'const bytes = readFileSync(new URL("arm.wasm", import.meta.url));\n'
    (folder / "try.mjs").write_text(head + bytes_ + text)
    done = subprocess.run(
        [str(shutil.which("node")), str(folder / "try.mjs")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def answers(text: str) -> str:
    found = re.search(r"answers ([0-9a-f]{16})", text)
    assert found is not None, text
    return found[1]


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_with_functions_of_its_own_c_has_the_same_bits_at_the_lowest_and_the_highest_level(tmp_path):
    """exp, log and the like come with the export, so that levels and machines do not decide over digits."""
    exported("outputs", tmp_path, "c")
    sources = sorted(str(path) for path in tmp_path.glob("*.c"))
    said = set()
    for level in ("-O0", "-O3"):
        program = tmp_path / "program"
        strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off", level]
        subprocess.run([str(find_compiler()), *strict, *sources, "-o", str(program), "-lm"], check=True)
        done = subprocess.run(
            [str(program), str(tmp_path / "samples.bin")], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout
        said.add(answers(done.stdout))
    assert len(said) == 1


def test_without_zig_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ziglang", None)
    with pytest.raises(NotSupported, match=r"the target wasm needs ziglang.*fpirhc\[compiler\]"):
        exported("torque", tmp_path, "wasm", cycles=1)


@pytest.fixture
def tools() -> None:
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[compiler]'")
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")


@pytest.mark.slow
@pytest.mark.usefixtures("tools")
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", CASES)
def test_webassembly_has_the_commands_of_this_machine_bit_by_bit(name, tmp_path):
    """Ten thousand cycles with faults, and the commands are those of Python to 1e-9 of their size."""
    exported(name, tmp_path / "wasm", "wasm", cycles=10_000)
    exported(name, tmp_path / "c", "c", cycles=10_000)
    done = subprocess.run(
        [str(shutil.which("node")), str(tmp_path / "wasm" / "replay.mjs")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    program, sources = tmp_path / "program", sorted(str(path) for path in (tmp_path / "c").glob("*.c"))
    command = [str(find_compiler()), "-std=c99", "-O2", "-ffp-contract=off", *sources, "-o", str(program), "-lm"]
    subprocess.run(command, check=True)
    here = subprocess.run(
        [str(program), str(tmp_path / "c" / "samples.bin")], capture_output=True, text=True, check=True
    )
    assert answers(done.stdout) == answers(here.stdout)
    assert done.stdout.splitlines()[-1] in here.stdout  # statuses


def in_wasmtime(folder: Path) -> str:
    """Hash of the commands of the recorded cycles, as main.c makes it, by a module in wasmtime."""
    wasmtime = pytest.importorskip("wasmtime", reason="wasmtime is not installed: pip install wasmtime")
    store = wasmtime.Store()
    module = wasmtime.Module.from_file(store.engine, str(folder / "arm.wasm"))
    e = wasmtime.Instance(store, module, []).exports(store)
    if "_initialize" in e:
        e["_initialize"](store)
    e["init"](store)
    assert f"memory: {e['memory'].data_len(store)} bytes" in (folder / "sizes.txt").read_text()
    memory, given, made, kept = e["memory"], *(e[n](store) for n in ("inputs", "command", "memory_of_controller"))
    data = (folder / "samples.bin").read_bytes()
    cycles, inputs, commands, _ = struct.unpack_from("<4i", data)
    size, answers, statuses = 8 * (inputs + 1 + commands + 2), 0xCBF29CE484222325, set[int]()
    for k in range(cycles):
        row = data[16 + k * size : 16 + (k + 1) * size]
        [damaged] = struct.unpack_from("<d", row, 8 * inputs)
        if damaged >= 0:
            memory.write(store, struct.pack("<d", math.nan), kept + 8 * int(damaged))
        memory.write(store, row[: 8 * inputs], given)
        statuses.add(e["step"](store))
        for word in struct.unpack(f"<{commands}Q", bytes(memory.read(store, made, made + 8 * commands))):
            answers = (answers ^ word) * 0x100000001B3 & (1 << 64) - 1
    assert len(statuses) > 1  # faults are among them
    return f"{answers:016x}"


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", CASES)
def test_ten_thousand_cycles_in_wasmtime_have_the_bits_of_c(name, tmp_path):
    """Another engine than Node's, and other machine code: the same hash of all commands, faults included."""
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[compiler]'")
    exported(name, tmp_path / "wasm", "wasm", cycles=10_000)
    exported(name, tmp_path / "c", "c", cycles=10_000)
    program, sources = tmp_path / "program", sorted(str(path) for path in (tmp_path / "c").glob("*.c"))
    command = [str(find_compiler()), "-std=c99", "-O2", "-ffp-contract=off", *sources, "-o", str(program), "-lm"]
    subprocess.run(command, check=True)
    here = subprocess.run(
        [str(program), str(tmp_path / "c" / "samples.bin")], capture_output=True, text=True, check=True
    )
    assert in_wasmtime(tmp_path / "wasm") == answers(here.stdout)


@pytest.mark.slow
@pytest.mark.usefixtures("tools")
def test_the_wrapper_checks_what_it_is_told(tmp_path):
    """Settings by name with their bounds, samples by their number, several controllers side by side, a reset."""
    device = exported("torque", tmp_path, "wasm", cycles=1)
    said = json.loads(
        node(
            tmp_path,
            """
const a = await load(bytes), b = await load(bytes);
const sample = layout.inputs.map((one) => one.start);
sample[1] = 1.9, sample[2] = 5.4;
const wrong = [NaN, Infinity, 3].map((v) => a.set("deformation.gain", v)), right = a.set("deformation.gain", -0.25);
const errors = [];
for (const call of [() => a.set("gain", -1), () => a.step([0, 1])]) try { call(); } catch (error) { errors.push(error.message); }
for (let k = 0; k < 5; ++k) for (const one of [a, b]) sample[0] = k * layout.period, one.step(sample);
const apart = a.command[0] !== b.command[0], command = [...b.command];
b.reset();
for (let k = 0; k < 5; ++k) sample[0] = k * layout.period, b.step(sample);
console.log(JSON.stringify({ wrong, right, errors, apart, again: command.every((v, k) => v === b.command[k]),
  gain: a.data.settings[0], memory: a.memory.length }));
""",
        )
    )
    assert said["wrong"] == [False, False, False]
    assert said["right"]
    assert said["gain"] == -0.25
    assert said["apart"]
    assert said["again"]
    assert said["memory"] == device.stepper.memory.size
    assert said["errors"] == [
        "no live setting 'gain'; there are: deformation.gain, limits.inputs.Q1.0, limits.inputs.Q1.1",
        "a sample has 7 numbers, those of layout.inputs; got 2",
    ]
