"""Controllers as WebAssembly: the commands of Python, and a wrapper that checks what it is told."""

import json
import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from helpers.exports import Exported, exported
from helpers.kinds import slow_but

CASES = {
    "torque": ("two_mass", "CTC+FPI (eq 6)"),
    "plan": ("two_mass", "RHC+FPI"),
    "outputs": ("anaesthesia", "CTC+FPI"),  # with RHC+FPI rounding grows: a replay does not feed the answer back
}
LIVE = {"torque": ("deformation.gain", "limits.inputs.Q1.0", "limits.inputs.Q1.1")}


def of_case(name: str, folder: Path) -> Exported:
    of, title = CASES[name]
    return exported(folder, of, title, "wasm", live=LIVE.get(name, ()))


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


@pytest.fixture
def tools() -> None:
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[compiler]'")
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")


@pytest.mark.usefixtures("tools")
@pytest.mark.parametrize("name", slow_but(CASES, "plan"))
def test_webassembly_has_the_commands_of_python(name, tmp_path):
    """Two thousand cycles with faults: statuses, and commands to 1e-9 of their size; exp and the like are the module's."""
    device = of_case(name, tmp_path)
    done = subprocess.run(
        [str(shutil.which("node")), str(tmp_path / "replay.mjs")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2000 cycles" in done.stdout
    found = {int(s): int(n) for s, n in re.findall(r"(\d+) \((\d+) cycles\)", done.stdout)}
    assert found == statuses(device, tmp_path)


def statuses(device: Exported, folder: Path) -> dict[int, int]:
    """Cycles by status of the stepper, for the samples of a replay."""
    data = np.frombuffer((folder / "samples.bin").read_bytes()[16:])
    rows = data.reshape(2000, -1)[:, : len(device.layout["inputs"]) + 1]
    memory, counts = device.stepper.start(), Counter[int]()
    for row in rows:
        if row[-1] >= 0:
            memory = memory.copy()
            memory[int(row[-1])] = np.nan
        _, memory = device.stepper.step_measured(row[0], row[1:-1], memory)
        counts[int(device.stepper.trace()["status"].item())] += 1
    return dict(counts)


@pytest.mark.slow
@pytest.mark.usefixtures("tools")
def test_the_wrapper_checks_what_it_is_told(tmp_path):
    """Settings by name with their bounds, samples by their number, several controllers side by side, a reset."""
    device = of_case("torque", tmp_path)
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
