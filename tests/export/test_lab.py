"""The lab: a page has the numbers of the one loop, and a slider that would need Python is left out with its reason."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.contraction.spectrum import factors_along, response_jacobians
from fpirhc.contracts import Controller
from fpirhc.errors import InvalidValue, NotSupported
from fpirhc.export.lab import lab as module
from fpirhc.export.lab.lab import Lab, make_lab, page
from fpirhc.export.lab.loop import LabLoop
from fpirhc.symbolic.paths import changed_at

CASES = {
    "two_mass": ("RHC", "RHC+FPI"),
    "crane_slots": ("slots", "slots+FPI"),
    "noisy_motor": ("RHC", "RHC+FPI"),
    "turbojet": ("RHC", "RHC+FPI"),
}
DRIVER = """
const asked = JSON.parse(require("fs").readFileSync(process.argv[2]));
globalThis.postMessage = (said) => { if (said.ready) return onmessage({ data: { ...asked, loops: undefined, number: 1 } });
  console.log(JSON.stringify(said, (_, v) => (v instanceof Float64Array ? [...v] : v))); };
"""


def made(name: str, duration: float | None = None, controllers: Sequence[str] = (), live: Sequence[str] = ()) -> Lab:
    task = fp.load_problem(name)
    problem = task.problem if duration is None else replace(task.problem, duration=duration, measure_from=0.0)
    chosen = {n: task.controllers[n] for n in controllers or CASES[name]}
    return make_lab(name, task.title, name, problem, chosen, live, pictures=task.pictures)


def answers(lab: Lab, moved: dict[str, float], folder: Path) -> Any:
    """What the page's worker says of the loops, with some sliders moved."""
    text = page(lab)
    data = json.loads(text[text.index("const DATA=") + 11 : text.index(";\n", text.index("const DATA="))])
    numbers = [
        [
            {"place": place, "value": moved[s["path"]]}
            for s in data["sliders"]
            if s["path"] in moved
            for place in s["places"][k]
        ]
        for k in range(len(lab.loops))
    ]
    (folder / "asked.json").write_text(json.dumps({"loops": data["loops"], "numbers": numbers}))
    end = "\nonmessage({ data: { loops: asked.loops } });\n"
    (folder / "worker.cjs").write_text(data["worker"].replace("onmessage =", "globalThis.onmessage =") + DRIVER + end)
    done = subprocess.run(
        [str(shutil.which("node")), str(folder / "worker.cjs"), str(folder / "asked.json")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["answers"]


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_page_has_the_numbers_of_the_loop(name, tmp_path):
    """Every curve and the sums of squares, with parameters of plant and model and a gain moved: 1e-12 of the largest."""
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[compiler]'")
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    lab = made(name)
    paths = {s.path: s for s in lab.sliders}
    moved = {}
    for ends, ratio in ((("exact.", ""), 1.1), (("approximate.", ""), 0.95), (("", "gain"), 0.9)):
        path = next(p for p in paths if p.startswith(ends[0]) and p.endswith(ends[1]))
        moved[path] = ratio * paths[path].value
    exact, approximate, gain = moved
    said = answers(lab, moved, tmp_path)
    for loop, one in zip(lab.loops, said, strict=True):
        problem = variant = loop.ready.problem
        for path in (exact, approximate):
            side, _, key = path.partition(".")
            variant = changed_at(variant, f"plant.parameters.{key}.{side}", moved[path])
        changes = {0.0: {gain: moved[gain]}} if gain in loop.ready.live.paths else {}
        run = loop.ready.run(seed=0, variant=variant, changes=changes, deployed=True)
        assert one["cycles"] == problem.cycles
        for column, values in zip(loop.shown, one["columns"], strict=True):
            wanted = np.ravel(run[column])[:: loop.every]
            assert np.abs(np.array(values) - wanted).max() <= 1e-12 * max(1.0, np.abs(wanted).max()), column
        assert (loop.picture is not None) == (name in ("two_mass", "crane_slots"))
        if loop.picture:
            followed = np.array([run[c][:: loop.frame] for c in loop.picture.columns(run.layout)])
            wanted = np.array(loop.drawn(followed, variant.plant.exact)).T.ravel()
            assert np.abs(np.array(one["frames"]) - wanted).max() <= 1e-12 * np.abs(wanted).max()
        error = np.reshape(run[loop.error], (problem.cycles, -1))
        counted = error[int(np.ceil(problem.measure_from / problem.period - 1e-9)) :]
        assert np.allclose(one["squares"], (counted**2).sum(axis=0), rtol=1e-9, atol=0)
        assert (one["factors"] is not None) == (problem.name != "crane_slots" and loop.name == "RHC+FPI")
        if one["factors"]:
            assert np.allclose(one["factors"], contraction(loop, run, variant, {gain: moved[gain]}), rtol=1e-9, atol=0)


def contraction(loop: LabLoop, run: fp.Run, variant: Any, settings: dict[str, float]) -> np.ndarray:
    """Python's factors in the cycles of the page's frames, with the gain in force."""
    rows, plant = np.arange(0, run.cycles, loop.frame), loop.ready.problem.plant
    states, deformed = (np.reshape(run[name], (run.cycles, -1))[rows] for name in ("state", "deformed"))
    exact = np.tile(variant.plant.exact, (len(rows), 1))
    jacobians = response_jacobians(plant, states, deformed, exact, variant.plant.approximate)
    return factors_along(
        len(rows), lambda at: jacobians[at], float(loop.ready.live.changed(settings)[1].deformation.effective_gain())
    )


def test_a_slider_that_needs_python_is_left_out_and_says_why(monkeypatch):
    """The step of a reference model follows from its rate and must not be old; a zero has no scale."""
    monkeypatch.setattr(module, "package", lambda *_: None)
    lab = made("noisy_motor", duration=0.5, controllers=["RHC"])
    paths = {s.path for s in lab.sliders}
    assert {"exact.k", "approximate.k"} & paths or len(paths) > 5
    law = made("mrac_pendulum", duration=0.5, controllers=["Lyapunov MRAC"])
    assert "follows from it and must not be outdated" in law.without["rate"]
    assert lab.without["approximate.coulomb"] == "it is zero: nothing says how far a slider would go"
    assert not paths & set(lab.without)
    people = {s.path: s for s in made("anaesthesia_people", controllers=["pump alone"]).sliders}
    assert people["approximate.E0"].high == 100  # the parameter's own bound


def test_a_slider_writes_what_a_device_does(monkeypatch):
    """Scales and the first plan stay those of the build: a cycle after the other, the run of a device has the same bits."""
    monkeypatch.setattr(module, "package", lambda *_: None)
    path, number = "reference.scale", 3.88
    lab = made("fishery", controllers=["RHC"], live=[path, "limits.inputs.effort"])
    assert {"limits.inputs.effort.0", "limits.inputs.effort.1"} <= {
        s.path for s in lab.sliders
    }  # first plans follow from them
    [loop], [places] = lab.loops, [s.places[0] for s in lab.sliders if s.path == path]
    memory, trace = loop.start.copy(), loop.ready.loop.trace
    memory[places] = number
    device, python = (
        loop.ready.run(seed=0, changes={0.0: {path: number}}, deployed=d)["command"] for d in (True, False)
    )
    for k in range(20):
        said = loop.ready.loop.function(memory, *(table[k] for table in loop.tables))
        memory, row = (one.full().ravel() for one in said)
        assert row[trace.slice("command")] == device[k], k
    assert not np.array_equal(device, python)


@pytest.fixture(scope="module")
def short() -> Lab:
    """Half a second of two masses, without WebAssembly."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "package", lambda *_: None)
        return made("two_mass", duration=0.5, controllers=["CTC+FPI (eq 6)"])


def test_a_slider_stays_inside_the_bounds_of_its_setting(short):
    for slider in short.sliders:
        assert slider.low < slider.value < slider.high or slider.value in (slider.low, slider.high)
        if not slider.path.startswith(("exact.", "approximate.")):
            for live in (loop.ready.live for loop in short.loops if slider.path in loop.ready.live.paths):
                for end in (slider.low, slider.high):
                    live.changed({slider.path: end})  # is not refused
                low, high = live.bounds(slider.path)
                assert low - 1e-6 * abs(low) <= slider.low
                assert slider.high <= high + 1e-6 * abs(high)


def test_a_slider_of_two_loops_with_other_numbers_is_accepted_by_both(monkeypatch):
    """The first one may go to -3.36 and would be shown to -3.6; the second one, which begins at -0.1, ends at -2.67."""
    monkeypatch.setattr(module, "package", lambda *_: None)
    task, law = fp.load_problem("two_mass"), fp.Exponential(rate=6.0)
    maps = {"steep": fp.Sigmoid(gain=-0.9, shift=0.3, scale=50.0), "slow": fp.Affine(gain=-0.1)}
    controllers: dict[str, Controller] = {name: fp.ComputedTorque(law, one) for name, one in maps.items()}
    problem = replace(task.problem, duration=0.3, measure_from=0.0)
    lab = make_lab("pair", "", "two_mass", problem, controllers, live=["deformation.gain"])
    [slider] = [s for s in lab.sliders if s.path == "deformation.gain"]
    assert slider.low == pytest.approx(-8 / 3, rel=1e-5)
    for loop in lab.loops:
        for end in (slider.low, slider.high):
            loop.ready.live.changed({slider.path: end})  # is not refused


def test_what_has_no_lab(monkeypatch):
    task = fp.load_problem("two_mass")
    chosen = {n: task.controllers[n] for n in CASES["two_mass"]}
    monkeypatch.setitem(__import__("sys").modules, "ziglang", None)
    with pytest.raises(NotSupported, match=r"a lab needs ziglang.*fpirhc\[compiler\]"):
        make_lab("t", "", "two_mass", task.problem, chosen)
    monkeypatch.setattr(module, "package", lambda *_: None)
    with pytest.raises(InvalidValue, match=r"no controller of the lab can have 'deformation.gian' live.*Did you mean"):
        make_lab("t", "", "two_mass", task.problem, chosen, ["deformation.gian"])
    outside = fp.ExternalPlant(_Body(), measures=dict(zip(_QUANTITIES, _UNITS, strict=True)))
    with pytest.raises(NotSupported, match="a plant outside Python's equations has none"):
        make_lab("t", "", "two_mass", replace(task.problem, reality=outside), chosen)


_QUANTITIES, _UNITS = ("q1", "q2", "q1'", "q2'", "q1''", "q2''"), ("m", "m", "m/s", "m/s", "m/s^2", "m/s^2")


class _Body:
    def reset(self, seed: int) -> np.ndarray:
        return np.full(6, float(seed))

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        return np.full(6, time + command[0])


def test_a_page_runs_its_own_scripts_and_webassembly_alone(short, monkeypatch):
    """The policy names hashes, and nothing of a title or a reason is markup."""
    monkeypatch.setattr(LabLoop, "module", b"")
    lab = replace(short, title="<b>&", without={"a": "</script><b>"})
    text = page(lab)
    policy = text.partition('content="')[2].partition('"')[0]
    assert "default-src 'none'" in policy
    assert "'wasm-unsafe-eval'; worker-src blob:;" in policy
    assert "<title>&lt;b&gt;&amp;: lab</title>" in text
    assert text.count("</script>") == 4
    assert "@" not in resources.files("fpirhc.export.lab").joinpath("lab.js").read_text()


def test_every_loop_has_a_colour_however_many_there_are(short, monkeypatch):
    """UPlot draws no line without one; there are ten colours."""
    monkeypatch.setattr(LabLoop, "module", b"")
    text = page(replace(short, loops=short.loops[:1] * 12))
    [listed] = re.findall(r'"colors":(\[[^]]*\])', text)
    colours = json.loads(listed)
    assert colours[10:] == colours[:2]


@pytest.mark.slow
def test_a_wheel_has_all_that_the_package_reads(tmp_path):
    """Every file of the package and nothing else beside the problems; a lab is written with the wheel's files alone."""
    builders = pytest.importorskip(
        "hatchling.builders.wheel", reason="hatchling is not installed: pip install hatchling"
    )
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[compiler]'")
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
    text = (tmp_path / "crane_slots-lab.html").read_text(encoding="utf-8")
    for part in ("lab/lab.js", "lab/lab.css"):
        assert resources.files("fpirhc.export").joinpath(part).read_text(encoding="utf-8").strip() in text
    assert (
        resources.files("fpirhc.simulation.pictures").joinpath("planar.css").read_text(encoding="utf-8").strip() in text
    )
