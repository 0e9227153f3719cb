"""A recording replayed: the controller that made it gives its commands, bit by bit; every wrong file is named."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import tasks

import fpirhc as fp
from fpirhc.probing.recording import replay


def recorded(
    path: Path, *, name: str = "RHC+FPI", without: tuple[str, ...] = (), rows: int = 60
) -> dict[str, np.ndarray]:
    """Write what a controller was given and sent in its first cycles, and return it."""
    problem, controller = tasks.two_mass.problem, tasks.two_mass.controllers[name]
    stepper = fp.Stepper(problem, controller, compiled=False)
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    state, realised = run["state"][:rows], run["realised"][:rows]
    values = np.column_stack([np.arange(rows) * problem.period, state, realised, run["command"][:rows]])
    names = ("time", *stepper.measures, *problem.plant.inputs)
    columns = {n: values[:, k] for k, n in enumerate(names) if n not in without}
    write(path, columns)
    return columns


def write(path: Path, columns: dict[str, np.ndarray]) -> None:
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        table.writerows(
            ["" if np.isnan(v) else repr(float(v)) for v in row] for row in zip(*columns.values(), strict=True)
        )


@pytest.mark.parametrize("name", ["CTC+FPI (eq 6)", "RHC+FPI", "RHC+FPI, model-referenced"])
def test_its_own_record_gives_its_own_commands(tmp_path, name):
    """To rounding, with its deformation, plan and integral."""
    columns = recorded(tmp_path / "run.csv", name=name)
    answer = replay(tasks.two_mass.problem, tasks.two_mass.controllers[name], tmp_path / "run.csv")
    sent = np.column_stack([columns[n] for n in tasks.two_mass.problem.plant.inputs])
    assert answer.commands == pytest.approx(sent, rel=1e-9, abs=1e-9)
    assert all(rms < 1e-8 for rms, _, _ in answer.differences().values())
    assert sum(answer.statuses.values()) == 60


def test_a_model_referenced_form_answers_to_the_commands_that_were_sent(tmp_path):
    """On a record of another controller its deformation is bounded by the model's error, and does not wind up."""
    columns = recorded(tmp_path / "run.csv", name="RHC", rows=200)
    form = tasks.two_mass.controllers["RHC+FPI, model-referenced"]
    told = replay(tasks.two_mass.problem, form, tmp_path / "run.csv")
    write(tmp_path / "blind.csv", {n: c for n, c in columns.items() if n not in tasks.two_mass.problem.plant.inputs})
    blind = replay(tasks.two_mass.problem, form, tmp_path / "blind.csv")
    assert blind.recorded is None
    assert blind.differences() == {}
    sent = np.column_stack([columns[n] for n in tasks.two_mass.problem.plant.inputs])
    assert np.abs(told.commands - sent).max() < np.abs(blind.commands - sent).max()


MASS = fp.Plant({"q": "m"}, {"u": "N"}, {"m": fp.Parameter(1.2, 1.0, "kg")}, lambda q, v, u, p: {"q": u.u / p.m})
MOTION = fp.Problem(MASS, fp.Trajectory(lambda t: {"q": ca.sin(t)}), {"q": 0.0, "q'": 1.0}, period=0.01, duration=2.0)
CTC = fp.ComputedTorque(fp.Exponential(rate=3.0))
KALMAN = fp.Sensing(measured=["q", "q''"], observer=fp.KalmanFilter(measured={"q": 1e-3}, noise={"q": 1.0}))
BELIEVERS = {
    "estimator": (MOTION, fp.Estimating(CTC, fp.DisturbanceKalman({"q": 3.0}, {"q": 1e-3, "q'": 1e-3}))),
    "predictor": (replace(MOTION, dead_time=fp.DeadTime(inputs={"u": 0.02})), fp.Predicted(CTC, inputs=0.02)),
    "observer": (replace(MOTION, sensing=KALMAN), CTC),
}


@pytest.mark.parametrize("name", BELIEVERS)
def test_what_believes_a_command_believes_the_recorded_one(tmp_path, name):
    """Two records that differ in their commands alone: whatever predicts or estimates from commands answers to the difference."""
    columns = {"time": np.arange(20) * 0.01, **{n: np.zeros(20) for n in ("q", "q'", "q''")}}
    write(tmp_path / "still.csv", {**columns, "u": np.zeros(20)})
    write(tmp_path / "pushed.csv", {**columns, "u": np.full(20, 3.0)})
    still, pushed = (replay(*BELIEVERS[name], tmp_path / file) for file in ("still.csv", "pushed.csv"))
    assert abs(pushed.commands - still.commands)[-1, 0] > 0.1


def test_an_estimator_does_not_wind_up_on_the_record_of_another_law(tmp_path):
    """A stiff law holds a load of 2 N: the estimator finds it from the recorded commands, and winds up by its own."""
    loaded = replace(MOTION, disturbances={"u": fp.Step(at=0.0, size=2.0)})
    run = fp.simulate(loaded, fp.ComputedTorque(fp.Exponential(rate=15.0)), seed=0, compiled=False)
    seen = {"q": run["state.q"], "q'": run["state.q'"], "q''": run["realised.q"]}
    write(tmp_path / "run.csv", {"time": run.time, "u": run["command.u"], **seen})
    rms, _, _ = replay(*BELIEVERS["estimator"], tmp_path / "run.csv").differences()["u"]
    assert rms < 0.15


def test_a_skipped_cycle_repeats_the_recorded_command(tmp_path):
    columns = {"time": np.arange(5) * 0.01, "u": np.full(5, 7.0), **{n: np.zeros(5) for n in ("q", "q'", "q''")}}
    columns["q"][3] = np.nan
    write(tmp_path / "run.csv", columns)
    assert replay(MOTION, CTC, tmp_path / "run.csv").commands[3, 0] == 7.0


def test_an_empty_column_of_commands_is_no_record(tmp_path):
    columns = {"time": np.arange(5) * 0.01, "u": np.full(5, np.nan), **{n: np.zeros(5) for n in ("q", "q'", "q''")}}
    write(tmp_path / "run.csv", columns)
    assert replay(MOTION, CTC, tmp_path / "run.csv").differences() == {}


def test_a_lost_sample_skips_its_cycle(tmp_path):
    columns = recorded(tmp_path / "run.csv")
    columns["q1"][20] = np.nan
    write(tmp_path / "run.csv", columns)
    answer = replay(tasks.two_mass.problem, tasks.two_mass.controllers["RHC+FPI"], tmp_path / "run.csv")
    assert answer.statuses["BAD_SAMPLE"] == 1
    assert np.isfinite(answer.commands).all()


def test_a_response_without_a_column_is_a_difference(tmp_path):
    columns = recorded(tmp_path / "run.csv", without=("q1''", "q2''"))
    assert "q1''" not in columns
    answer = replay(tasks.two_mass.problem, tasks.two_mass.controllers["RHC+FPI"], tmp_path / "run.csv")
    assert np.isfinite(answer.commands).all()


TIMES = np.arange(5) * 1e-3  # the period of two_mass
GOOD = {n: np.zeros(5) for n in ("q1", "q2", "q1'", "q2'", "q1''", "q2''")}
INPUT = "Q1"


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"time": TIMES}, "it lacks columns for q1, q2, q1', q2'"),
        ({"time": TIMES, **{n: c for n, c in GOOD.items() if "1" in n}}, "lacks columns for q2, q2'"),
        (GOOD, "it lacks a column for time"),
        ({"time": 2 * TIMES, **GOOD}, "its times are not"),
        ({"time": TIMES[:1], **{n: c[:1] for n, c in GOOD.items()}}, "it has fewer than two rows"),
        ({"time": TIMES[::-1], **GOOD}, "its times are not"),
        ({"time": np.where(TIMES > 0, TIMES, np.nan), **GOOD}, "its times are not"),
        ({"time": TIMES, **GOOD, INPUT: np.zeros(5)}, f"it has the commands of {INPUT} alone; expected those of"),
    ],
)
def test_a_wrong_table_is_named(tmp_path, columns, words):
    """All mistakes of a file together, each with what was expected."""
    write(tmp_path / "run.csv", columns)
    with pytest.raises(fp.FpirhcError) as error:
        replay(tasks.two_mass.problem, tasks.two_mass.controllers["RHC"], tmp_path / "run.csv")
    assert words in str(error.value)
    assert "recording run.csv" in str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read: No such file or directory"),
        ("", "is empty; expected a line of names"),
        ("time,q1\n0,one\n", "line 2 is not made of numbers: 0, one"),
        ("time,q1\n0\n", "line 2 has 1 entries, the line of names 2"),
    ],
)
def test_a_file_that_is_no_table_is_named(tmp_path, text, words):
    if text is not None:
        (tmp_path / "run.csv").write_text(text)
    with pytest.raises(fp.FpirhcError) as error:
        replay(tasks.two_mass.problem, tasks.two_mass.controllers["RHC"], tmp_path / "run.csv")
    assert words in str(error.value)
