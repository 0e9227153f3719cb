"""The closed loop: laws of adaptation, clipping, finiteness, disturbances, harm that is warned of, and saved runs."""

import io
import json
import os
import pickle
import re
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.faults import Failing
from helpers.plants import heavy, linear, simulated, swing

import fpirhc as fp
from fpirhc.errors import OutputError

TRACK = fp.Exponential(rate=6.0)


def line(gain, believed, **changes) -> fp.Problem:
    """A linear plant that holds still."""
    settings = {
        "plant": linear(gain, believed),
        "reference": fp.Trajectory(lambda t: {"y": 1 + 0 * t}),
        "start": {"y": 0.0},
        "period": 1e-3,
        "duration": 0.5,
    }
    return fp.Problem(**{**settings, **changes})


def run(problem, deformation=None, *, seed=0, compiled=False):
    """Computed torque in the virtual machine."""
    controller = fp.ComputedTorque(TRACK, deformation or fp.Identity())
    return fp.simulate(problem, controller, seed=seed, compiled=compiled)


def test_adaptation_waits_for_a_valid_pair():
    """In the first cycle nothing has been realised yet, so the request is the desired response."""
    result = run(swing(), fp.Sigmoid(gain=-0.5, scale=10.0))
    assert result["deformed.angle"][0] == result["desired.angle"][0]
    assert result["deformed.angle"][5] != result["desired.angle"][5]


def test_disturbances_act_by_name():
    """A force step of 1 N on y'' = 2 u shows as 2 m/s^2 in the realised response, one cycle later."""
    quiet = run(line(2.0, 2.0))
    pushed = run(line(2.0, 2.0, disturbances={"u": fp.Step(at=0.1, size=1.0), "y": fp.Step(at=0.3, size=-3.0)}))
    difference = pushed["realised.y"] - quiet["realised.y"]
    assert np.all(difference[:101] == 0)
    assert difference[101] == pytest.approx(2.0)
    before, after = pushed["realised.y"][300], pushed["realised.y"][301]
    assert after - before == pytest.approx(-3.0, abs=0.2)


def test_run_stops_where_a_signal_is_not_finite():
    """The run keeps its finite part and names the signal and the time."""
    bomb = fp.Plant(
        {"y": "m"},
        {"u": "N"},
        {},
        lambda q, v, u, p: {"y": u.u + 1e-9 * ca.sqrt(1 - q.y)},
        inverse=lambda q, v, r, p: {"u": r.y},
    )
    problem = line(1.0, 1.0, plant=bomb, reference=fp.Trajectory(lambda t: {"y": 3 * t}), duration=2.0)
    result = run(problem)
    assert result.stop is not None
    assert "not finite at t = 0." in result.stop
    assert 0 < result.cycles < problem.cycles
    assert np.isfinite(result.log).all()
    metrics = fp.measure(problem, result)
    assert metrics.worst_status == "NON_FINITE"
    assert np.isnan(metrics.rms_error["y"])


def test_run_stops_where_a_solver_fails():
    """The run keeps the cycles before, and the reason is the solver's last line."""
    problem = swing(horizon=fp.Horizon(stages=4, step=0.02), cost=fp.Quadratic({"angle": 1.0}, effort={"torque": 1e-3}))
    whole, broken = (
        simulated(problem, fp.RecedingHorizon(Failing(iterations=1, tolerance=1e-3, at=at))) for at in (None, 30)
    )
    assert whole.stop is None
    assert "cycles, at the earliest" in str(broken.stop)
    assert "solver failed" in str(broken.stop)
    assert 0 < broken.cycles <= 30 * 20  # a plan every twentieth cycle
    np.testing.assert_array_equal(broken["command"], whole["command"][: broken.cycles])


def late_mass(late: float, amplitude: float = 0.2, duration: float = 60.0) -> fp.Problem:
    """A mass without limits behind a dead time that its law does not know."""
    reference, late_by = fp.Trajectory(lambda t: {"q": amplitude + 0 * t}), fp.DeadTime(inputs={"F": late})
    return fp.Problem(heavy(1.0, 1.0, u="F"), reference, {"q": 0.0}, 0.01, duration, dead_time=late_by)


@pytest.mark.parametrize(
    ("problem", "stops"),
    [(late_mass(0.5), True), (late_mass(0.5, duration=3.0), False), (late_mass(0.0, 0.0, 5.0), False)],
    ids=["runs away", "ends before", "a reference of zero has no million times"],
)
def test_a_loop_that_runs_away_stops_where_its_error_is_a_million_times_the_reference(problem, stops):
    run = simulated(problem, fp.ComputedTorque(TRACK))
    assert ("more than a million times the 0.2 m of its reference and start" in str(run.stop)) == stops
    assert (run.cycles < problem.cycles) == stops
    assert np.abs(run["error"]).max() <= 2e5


def test_a_short_run_is_not_compiled_unless_it_is_asked_for():
    """None chooses by cycles and stages; the run says why, and is that of the virtual machine."""
    chosen = fp.simulate(swing(duration=0.02, measure_from=0.0), fp.ComputedTorque(TRACK), seed=0, compiled=None)
    assert chosen.settings["why not compiled"] == "the run is short, and a compiler would take longer"
    ready = fp.simulator(swing(duration=200.0), fp.ComputedTorque(TRACK), compiled=None)
    assert ready.compiled or "short" not in ready.backend.reason


# Mistakes at the door
WEAK = fp.Plant({"y": "m"}, {"u": "N"}, {}, lambda q, v, u, p: {"y": q.y * u.u})
SIGNS = {"a": fp.Parameter(1.0, 1.0, "1"), "b": fp.Parameter(1.0, -1.0, "1")}
CROSSED = fp.Plant(
    {"y": "m", "z": "m"}, {"u": "N", "w": "N"}, SIGNS, lambda q, v, u, p: {"y": p.a * u.u, "z": p.b * u.w}
)
CROSSING = {"reference": fp.Trajectory(lambda t: {"y": 0 * t, "z": 0 * t}), "start": {"y": 0.0, "z": 0.0}}
BAD: dict[str, Callable[[], object]] = {
    "'angel' is unknown. Did you mean 'angle'": lambda: swing(start={"angel": 0.0}),
    "coordinate 'angle' has no first value": lambda: swing(start={}),
    "expected a finite number, got inf": lambda: swing(start={"angle": float("inf")}),
    "has no nominal motion": lambda: swing(reference=fp.Trajectory(lambda t: {})),
    "shorter than one period": lambda: swing(duration=1e-4),
    "disturbances: input, coordinate or output 'x' is unknown": lambda: swing(disturbances={"x": fp.Noise(1.0)}),
    r"(?s)not invertible at the start \(y = 0, y' = 0\).*'u'": lambda: line(1.0, 1.0, plant=WEAK),
    # Two inputs of which the model has one sign wrong: no gain converges.
    "both signs": lambda: run(line(1.0, 1.0, plant=CROSSED, **CROSSING), fp.Sigmoid(gain=-0.5, scale=1.0)),
}


@pytest.mark.parametrize("message", BAD)
def test_mistakes_of_a_problem(message):
    assert line(1.0, 1.0, plant=WEAK, start={"y": 1.0}).cycles == 500
    with pytest.raises(fp.FpirhcError, match=message):
        BAD[message]()


# A controller that does better without its adaptation is warned of once
PROBLEM = fp.Problem(
    linear(1.02, 1.0), fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}), {"y": 0.0, "y'": 3.0}, 5e-3, 4.0, measure_from=1.0
)
GENTLE = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain=-0.05))
TEXT = (
    r"ComputedTorque: adaptation does harm, by runs of 300 cycles: on the plant the rms error of y is (\S+) m without adaptation, "
    r"(\S+) m with it; on its own model, with nothing to adapt the rms error of y is (\S+) m without adaptation, (\S+) m with it\. "
)


def told(problem: fp.Problem, controller) -> list[str]:
    """Texts of the warnings of one stepper, which then steps."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stepper = fp.Stepper(problem, controller, compiled=False)
        memory = stepper.start()
        for k in range(3):
            _, memory = stepper.step(k * problem.period, problem.start_state, np.zeros(1), memory)
    assert all(one.category is fp.HarmfulAdaptation for one in caught)
    assert all(one.filename == __file__ for one in caught)
    return [str(one.message) for one in caught]


def test_a_gentle_plain_form_is_warned_of_once_with_its_numbers():
    """The numbers are those of runs of 300 cycles, half of which count."""
    [text] = told(PROBLEM, GENTLE)
    found = re.search(TEXT, text)
    assert found
    short = replace(PROBLEM, duration=1.5, measure_from=0.75)
    own = replace(short, plant=linear(1.02, 1.02))
    runs = [(p, c) for p in (short, own) for c in (GENTLE.with_deformation(fp.Identity()), GENTLE)]
    rms = [fp.measure(p, simulated(p, c)).rms_error["y"] for p, c in runs]
    assert [float(number) for number in found.groups()] == pytest.approx(rms, rel=6e-3)
    assert rms[1] > 2 * rms[0]
    assert rms[3] > rms[0]


@pytest.mark.parametrize("map_", [fp.ModelReferenced(fp.Affine(gain=-0.05)), fp.ModelReferenced(fp.Affine(gain=-0.8))])
def test_the_model_referenced_form_is_not_warned_of(map_):
    """It leaves an exact model alone, whatever its gain."""
    assert told(PROBLEM, replace(GENTLE, deformation=map_)) == []


def test_as_an_error_it_stops_the_build():
    """Who wants no such controller on a machine turns the warning into an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", fp.HarmfulAdaptation)
        with pytest.raises(fp.HarmfulAdaptation, match="adaptation does harm"):
            fp.Stepper(PROBLEM, GENTLE, compiled=False)


# Saved runs: written at once or not at all, and read with a schema whatever the file holds


@pytest.fixture(scope="module")
def saved() -> fp.Run:
    """A short run."""
    problem = swing(duration=0.05, measure_from=0.0)
    return simulated(problem, fp.ComputedTorque(fp.Exponential(rate=6.0)))


def npy(array: Any) -> bytes:
    """An array as numpy stores it."""
    content = io.BytesIO()
    np.lib.format.write_array(content, np.asarray(array), allow_pickle=True)
    return content.getvalue()


def write(path: Path, **parts: bytes) -> None:
    """A zip of named parts."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in parts.items():
            file.writestr(f"{name}.npy", content)


def facts_of(path: Path) -> dict[str, Any]:
    """The facts of a file."""
    with np.load(path) as stored:
        facts: dict[str, Any] = json.loads(str(stored["facts"]))
    return facts


HOSTILE = {
    "no zip": lambda log, facts: b"PK\x03\x04 nothing",
    "empty": lambda log, facts: b"",
    "format": lambda log, facts: {**facts, "format": 9},
    "no mapping": lambda log, facts: [1],
    "no period": lambda log, facts: {k: v for k, v in facts.items() if k != "period"},
    "signals of another size": lambda log, facts: {**facts, "signals": facts["signals"][:-1]},
    "same signal twice": lambda log, facts: {**facts, "signals": [*facts["signals"][:-1], facts["signals"][0]]},
    "flat log": lambda log, facts: log.ravel(),
    "log of texts": lambda log, facts: log.astype(str),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_file_is_refused_in_one_way(case, saved, tmp_path):
    good, bad = tmp_path / "good.npz", tmp_path / "bad.npz"
    saved.save(good)
    change = HOSTILE[case](saved.log, facts_of(good))
    if isinstance(change, bytes):
        bad.write_bytes(change)
    elif isinstance(change, np.ndarray):
        write(bad, log=npy(change), facts=npy(json.dumps(facts_of(good))))
    else:
        write(bad, log=npy(saved.log), facts=npy(json.dumps(change)))
    for path in (bad, tmp_path, tmp_path / "none.npz"):
        with pytest.raises(OutputError, match="cannot read a run from"):
            fp.load_run(path)


def test_a_file_runs_no_code(tmp_path, saved):
    """Pickles are refused, wherever they stand."""

    class Trap:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "ran"),))

    (tmp_path / "bad.npz").write_bytes(pickle.dumps(Trap()))
    write(tmp_path / "worse.npz", log=npy(np.array([Trap()], dtype=object)), facts=npy("{}"))
    for name in ("bad.npz", "worse.npz"):
        with pytest.raises(OutputError):
            fp.load_run(tmp_path / name)
    assert not (tmp_path / "ran").exists()


def test_a_write_that_fails_leaves_the_earlier_file(saved, tmp_path, monkeypatch):
    saved.save(tmp_path / "run.npz")
    before = (tmp_path / "run.npz").read_bytes()

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match=r"cannot write the run to .*No space left on device"):
        saved.save(tmp_path / "run.npz")
    assert (tmp_path / "run.npz").read_bytes() == before
    assert os.listdir(tmp_path) == ["run.npz"]
