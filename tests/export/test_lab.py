"""Controllers as WebAssembly and as a lab: the commands and curves of Python, and a slider that would need Python is left out."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import exports
from helpers.exports import Exported
from helpers.kinds import slow_but
from helpers.labs import exported, run, same_curves

import fpirhc as fp
from fpirhc.__main__ import main

CASES = {"two_mass": "RHC+FPI", "crane_slots": "slots+FPI", "noisy_motor": "RHC+FPI", "turbojet": "RHC+FPI"}
DRIVER = """
const asked = JSON.parse(require("fs").readFileSync(process.argv[2]));
globalThis.postMessage = (said) => { if (said.ready) return onmessage({ data: { ...asked, loops: undefined, number: 1 } });
  console.log(JSON.stringify(said, (_, v) => (v instanceof Float64Array ? [...v] : v))); };
"""


@pytest.fixture(autouse=True)
def zig() -> None:
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[compiler]'")


@pytest.fixture
def tools() -> None:
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")


def node(*words: object) -> str:
    """What a module prints."""
    done = subprocess.run([str(shutil.which("node")), *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def answers(data: Any, moved: dict[str, float], folder: Path) -> Any:
    """What the page's worker says of the loops, with some sliders moved."""
    sliders = [s for s in data["sliders"] if s["path"] in moved]
    numbers = [
        [{"place": place, "value": moved[s["path"]]} for s in sliders for place in s["places"][k]]
        for k in range(len(data["loops"]))
    ]
    (folder / "asked.json").write_text(json.dumps({"loops": data["loops"], "numbers": numbers}))
    end = "\nonmessage({ data: { loops: asked.loops } });\n"
    (folder / "worker.cjs").write_text(data["worker"].replace("onmessage =", "globalThis.onmessage =") + DRIVER + end)
    return json.loads(node(folder / "worker.cjs", folder / "asked.json"))["answers"]


@pytest.mark.slow
@pytest.mark.usefixtures("tools")
@pytest.mark.parametrize("name", CASES)
def test_a_page_has_the_numbers_of_the_loop(name, tmp_path):
    """Every curve and the sums of squares, with parameters of plant and model and a gain moved: 1e-12 of the largest."""
    _, data = exported(tmp_path, name, CASES[name])
    values = {s["path"]: s["value"] for s in data["sliders"]}
    moved = {}
    for begin, end, ratio in (("exact.", "", 1.1), ("approximate.", "", 0.95), ("", "gain", 0.9)):
        path = next(p for p in values if p.startswith(begin) and p.endswith(end))
        moved[path] = ratio * values[path]
    [one], [loop] = answers(data, moved, tmp_path), data["loops"]
    python = run(name, CASES[name], moved, loop["live"])
    assert one["cycles"] == python.cycles
    same_curves(data, one["columns"], python)
    problem = fp.load_problem(name).problem
    shown = data["charts"][0]["column"].partition(".")[0]
    counted = np.reshape(python[shown], (python.cycles, -1))
    counted = counted[int(np.ceil(problem.measure_from / problem.period - 1e-9)) :]
    assert np.allclose(one["squares"], (counted**2).sum(axis=0), rtol=1e-9, atol=0)


def test_a_page_has_sliders_of_parameters_gains_and_limits(tmp_path):
    """A zero has none, as it says no range; every other one is within its bounds. The page runs its own scripts alone."""
    page, data = exported(tmp_path, "noisy_motor", "RHC+FPI")
    sliders = {s["path"]: s for s in data["sliders"]}
    assert {"exact.coulomb", "deformation.map.gain"} <= {*sliders}
    assert "approximate.coulomb" not in sliders
    assert all(s["low"] <= s["value"] <= s["high"] for s in sliders.values())
    text = page.read_text(encoding="utf-8")
    policy = text.partition('content="')[2].partition('"')[0]
    assert "default-src 'none'" in policy
    assert "'wasm-unsafe-eval'; worker-src blob:;" in policy
    assert text.count("</script>") == 3


PROBLEM = """from dataclasses import replace
import fpirhc as fp
task = fp.load_problem("two_mass")
problem, controllers = task.problem, {"RHC": task.controllers["RHC"]}
"""
OUTSIDE = """
class Body:
    def reset(self, seed): return [float(seed)] * 6
    def step(self, time, command): return [time + command[0]] * 6
names = ("q1", "q2", "q1'", "q2'", "q1''", "q2''")
units = ("m", "m", "m/s", "m/s", "m/s^2", "m/s^2")
problem = replace(problem, reality=fp.ExternalPlant(Body(), measures=dict(zip(names, units))))
"""


def test_what_has_no_lab(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(PROBLEM)
    Path("far.py").write_text(PROBLEM + OUTSIDE)
    lossy = 'problem = replace(problem, sensing=fp.Sensing({"q1": fp.Sensor(dropout=0.1)}))\n'
    Path("lossy.py").write_text(PROBLEM + lossy)
    refused = {
        "lossy.py RHC": "leave out the plant outside, and dropout and range",
        "own.py RHC --live deformation.gain": "a lab has sliders of parameters, gains and limits of inputs, no others",
        "far.py RHC": "leave out the plant outside, and dropout and range",
    }
    for words, said in refused.items():
        assert main(["export", *words.split(), "--to", "lab"]) == 2
        assert said in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "ziglang", None)
    assert main(["export", "own.py", "RHC", "--to", "lab"]) == 2
    assert "a lab needs ziglang" in capsys.readouterr().err


@pytest.mark.slow
def test_a_wheel_has_all_that_the_package_reads(tmp_path):
    """Every file of the package and nothing else beside the problems; a lab is written with the wheel's files alone."""
    builders = pytest.importorskip("hatchling.builders.wheel", reason="pip install hatchling")
    root = Path(fp.__file__).parents[1]
    listed = subprocess.run(["git", "ls-files", "fpirhc"], cwd=root, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("the package is in no repository")
    wheel = next(builders.WheelBuilder(str(root)).build(directory=str(tmp_path)))
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if name.startswith("fpirhc/")}
        archive.extractall(tmp_path / "installed")
    assert {name for name in names if not name.startswith("fpirhc/_problems/")} == {*listed.stdout.split()}
    words = ["-m", "fpirhc", "export", "crane_slots", "slots", "--to", "lab", "--out", str(tmp_path)]
    away = {**os.environ, "PYTHONPATH": str(tmp_path / "installed")}
    done = subprocess.run([sys.executable, *words], cwd=tmp_path, env=away, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "crane_slots-lab.html").stat().st_size > 100_000


# Modules: the commands of Python, and a wrapper that checks what it is told
MODULES = {
    "torque": ("two_mass", "CTC+FPI (eq 6)"),
    "plan": ("two_mass", "RHC+FPI"),
    "outputs": ("anaesthesia", "CTC+FPI"),  # with RHC+FPI rounding grows: a replay does not feed the answer back
}
LIVE = {"torque": ("deformation.gain", "limits.inputs.Q1.0", "limits.inputs.Q1.1")}


def of_case(name: str, folder: Path) -> Exported:
    of, title = MODULES[name]
    return exports.exported(folder, of, title, "wasm", live=LIVE.get(name, ()))


@pytest.mark.usefixtures("tools")
@pytest.mark.parametrize("name", slow_but(MODULES, "plan"))
def test_webassembly_has_the_commands_of_python(name, tmp_path):
    """Two thousand cycles with faults: statuses, and commands to 1e-9 of their size; exp and the like are the module's."""
    device = of_case(name, tmp_path)
    said = node(tmp_path / "replay.mjs")
    assert "2000 cycles" in said
    found = {int(s): int(n) for s, n in re.findall(r"(\d+) \((\d+) cycles\)", said)}
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


TRY = """
import { readFileSync } from "node:fs";
import { layout, load } from "./arm.mjs";
const bytes = readFileSync(new URL("arm.wasm", import.meta.url));
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
"""


@pytest.mark.slow
@pytest.mark.usefixtures("tools")
def test_the_wrapper_checks_what_it_is_told(tmp_path):
    """Settings by name with their bounds, samples by their number, several controllers side by side, a reset."""
    device = of_case("torque", tmp_path)
    (tmp_path / "try.mjs").write_text(TRY)
    said = json.loads(node(tmp_path / "try.mjs"))
    errors = ["no live setting 'gain'; there are: deformation.gain, limits.inputs.Q1.0, limits.inputs.Q1.1"]
    errors.append("a sample has 7 numbers, those of layout.inputs; got 2")
    expected = {"wrong": [False, False, False], "right": True, "errors": errors, "apart": True, "again": True}
    assert said == expected | {"gain": -0.25, "memory": device.stepper.memory.size}
