"""Realities and signals that are wrong, at the command line: what, where, what was expected, and what helps."""

from __future__ import annotations

from pathlib import Path

import pytest

from fpirhc.cli.main import main

OUTSIDE = '''
"""A cart outside."""
import threading
import numpy as np
import casadi as ca
import fpirhc as fp

class Cart:
    def reset(self, seed):
        self.x, self.v, self.n = 0.0, 2.0, 0
        {reset}
        return [self.x, self.v, 0.0]
    def step(self, t, command):
        a = command[0]
        self.x, self.v, self.n = self.x + 1e-3 * self.v + 0.5e-6 * a, self.v + 1e-3 * a, self.n + 1
        if self.n > 20:
            {step}
        return [self.x, self.v, a]

plant = fp.Plant({{"x": "m"}}, {{"u": "N"}}, {{"m": fp.Parameter(1.5, 1.0, "kg")}}, lambda q, v, u, p: {{"x": u.u / p.m}})
problem = fp.Problem(
    plant=plant,
    reality=fp.ExternalPlant(Cart(), {{"x": "m", "x'": "m/s", "x''": "m/s^2"}}, deadline=0.2),
    reference=fp.Trajectory(lambda t: {{"x": ca.sin(2 * t)}}),
    start={{"x": 0.0, "x'": 2.0}},
    period=1e-3,
    duration=0.04,
)
law = fp.Exponential(rate=6.0)
controllers = {{"CTC": fp.ComputedTorque(law), "FPI": fp.ComputedTorque(law, fp.Affine(-0.5))}}
headline = ("CTC", "FPI")
'''

ANSWERS = {
    "raises": ('raise RuntimeError("port\\nclosed")', "raised RuntimeError: port closed"),
    "leaves": ("raise SystemExit(3)", "raised SystemExit: 3"),
    "nothing": ("return None", "returned None, expected 3 numbers: x, x', x''"),
    "blocks": ("threading.Event().wait()", "did not return within 0.2 s, its deadline; it was given up"),
}


def written(folder: Path, text: str, **parts: str) -> str:
    path = folder / "mine.py"
    path.write_text(text.format(**parts).replace("{{", "{").replace("}}", "}"))
    return str(path)


def flat(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.parametrize("kind", ANSWERS)
def test_a_bad_answer_ends_the_run_with_its_reason(kind, tmp_path, monkeypatch, capsys):
    """Code 4, one sentence with the method, the answer, the time and the remedy, and a file with the cycles before it."""
    monkeypatch.chdir(tmp_path)
    step, message = ANSWERS[kind]
    code = main(["run", written(tmp_path, OUTSIDE, reset="pass", step=step), "CTC", "--no-compile"])
    shown = flat(capsys.readouterr().out)
    assert code == 4
    assert f"ended early: step of Cart {message}" in shown
    assert (
        "at t = 0.021 s (cycle 21); the run keeps the cycles before it; ExternalPlant(holds=1) bridges a bad answer"
        in shown
    )
    assert list(tmp_path.rglob("*.npz"))


def test_a_bad_first_answer_is_bad_input(tmp_path, monkeypatch, capsys):
    """There is no run to keep."""
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, OUTSIDE, reset='raise OSError("no port")', step="pass")
    assert main(["run", path, "CTC", "--no-compile"]) == 2
    assert "reality: reset of Cart raised OSError: no port" in capsys.readouterr().err


def test_a_comparison_says_why_runs_ended(tmp_path, monkeypatch, capsys):
    """The reason stands under the table, beside the word 'ended early'."""
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, OUTSIDE, reset="pass", step='raise RuntimeError("port closed")')
    assert main(["compare", path, "--no-compile"]) == 0
    shown = flat(capsys.readouterr().out)
    for name in ("CTC", "FPI"):
        assert f"{name} ended early: step of Cart raised RuntimeError: port closed at t = 0.021 s" in shown


MODEL = '''
"""A mass in the wind, and an actuator."""
import casadi as ca
import fpirhc as fp

def lagged(tau, unit="m", name="x"):
    return fp.Plant(
        {{name: unit, "F": "N"}},
        {{"u": "N"}},
        {{"m": fp.Parameter(1.5, 1.0, "kg")}},
        lambda q, v, u, p: {{name: q.F / p.m, "F": (u.u - q.F) / tau}},
        order={{name: 2, "F": 1}},
        {more}
    )

wind = {{"wind": fp.outside(nominal=0.0, unit="N")}} if {windy} else {{}}
plant = fp.Plant(
    {{"x": "m"}},
    {{"u": "N"}},
    {{"m": fp.Parameter(1.5, 1.0, "kg"), **wind}},
    lambda q, v, u, p: {{"x": (u.u + (p.wind if wind else 0)) / p.m}},
    {outputs}
)
problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {{"{followed}": ca.sin(2 * t)}}),
    start={{"x": 0.0, "x'": 2.0}},
    period=1e-3,
    duration=0.04,
    {world}
)
controllers = {{"CTC": fp.ComputedTorque(fp.Exponential(rate=6.0))}}
'''

OUTPUT = 'outputs={{"y": fp.Output("m", lambda q, v, p: 2 * q.x)}},'
WORLDS = {
    "no values": (
        {"windy": "True", "world": ""},
        "signals: 'wind' [N] has no values; add signals={'wind': Known(Samples(times, values))}, or Unknown",
    ),
    "values that end": (
        {"windy": "True", "world": 'signals={{"wind": fp.Known(fp.Samples([0, 0.01], [0, 1], hold="linear"))}},'},
        "problem: signals: values of 'wind' are stated from 0 to 0.01, the run is from 0 to 0.04; add samples",
    ),
    "values that are none": (
        {"windy": "True", "world": 'signals={{"wind": fp.Known(lambda t: 1 / (t - 0.02))}},'},
        "problem: signals: values of 'wind' are not finite at t = 0.02",
    ),
    "stiff": (
        {"world": "reality=fp.Reality(lagged(1e-4)),"},
        "a mode decays with the pole -1e+04 1/s, which times the period of 0.001 s is 10, and RungeKutta4(substeps=1) makes it "
        "grow by 291 per cycle; use Reality(..., integrator=RungeKutta4(substeps=5))",
    ),
    "too stiff": (
        {"world": "reality=fp.Reality(lagged(1e-8)),"},
        "RungeKutta4 would need 50000 sub-steps; use Reality(..., integrator=Cvodes())",
    ),
    "other unit": (
        {"world": 'reality=fp.Reality(lagged(0.1, "mm")),'},
        "its coordinate 'x' is in mm, the model's 'x' in m; write both in one unit",
    ),
    "no coordinate": (
        {"world": 'reality=fp.Reality(lagged(0.1, name="z")),'},
        "it has no coordinate 'x', which the model has and the controller is given; add it, or name the one that is measured in "
        "its place: Reality(seen={'x': ...}). Its coordinates: z, F",
    ),
    "no output": (
        {"outputs": OUTPUT, "followed": "y", "world": "reality=fp.Reality(lagged(0.1)),"},
        "it has no output 'y', which the model has and which is judged; give its plant this output too. Its coordinates and "
        "outputs: x, F",
    ),
    "other unit of an output": (
        {
            "outputs": OUTPUT,
            "followed": "y",
            "more": OUTPUT.replace('"m"', '"mm"'),
            "world": "reality=fp.Reality(lagged(0.1)),",
        },
        "its 'y' is in mm, the model's in m; write both in one unit",
    ),
}


@pytest.mark.parametrize("kind", WORLDS)
def test_a_wrong_world_is_bad_input_with_its_line(kind, tmp_path, capsys):
    """Code 2, the file and line of the problem, and one sentence."""
    parts, message = WORLDS[kind]
    path = written(tmp_path, MODEL, **{"windy": "False", "more": "", "outputs": "", "followed": "x", **parts})
    assert main(["run", path, "CTC", "--no-compile"]) == 2
    shown = flat(capsys.readouterr().err)
    assert "mine.py, line" in shown
    assert message in shown
    assert "2 mistakes" not in shown
