"""The closed loop: laws of adaptation, clipping, finiteness, disturbances, and running in several ways."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import linear, pendulum, swing

import fpirhc as fp
from fpirhc import simulator
from fpirhc.errors import InvalidName, InvalidProblem
from fpirhc.simulation.path import SHORT
from fpirhc.symbolic.evaluate import Evaluator

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


def test_exact_model_needs_no_deformation():
    """When model and plant agree the request is realised, so nothing is deformed beyond the drift within one cycle."""
    problem = swing(pendulum(mass=1.4, believed=1.4))
    exact = replace(
        problem.plant, parameters={n: replace(p, exact=p.approximate) for n, p in problem.plant.parameters.items()}
    )
    result = run(replace(problem, plant=exact), fp.Sigmoid(gain=-0.5, scale=10.0))
    difference = np.abs(result["deformed.angle"] - result["desired.angle"])
    slew = np.abs(np.diff(result["desired.angle"])).max()
    assert difference.max() < 20 * slew
    assert np.abs(result["error.angle"][-1000:]).max() < 1e-3


def test_adaptation_waits_for_a_valid_pair():
    """In the first cycle nothing has been realised yet, so the request is the desired response."""
    result = run(swing(), fp.Sigmoid(gain=-0.5, scale=10.0))
    assert result["deformed.angle"][0] == result["desired.angle"][0]
    assert result["deformed.angle"][5] != result["desired.angle"][5]


@pytest.mark.parametrize("seed", range(3))
def test_in_loop_contraction_equals_prediction(seed):
    """On a linear plant with constant desired response, |h| shrinks by |1 - a lambda| per cycle."""
    gain = np.random.default_rng(seed).uniform(0.5, 1.8)
    deformation = fp.Sigmoid(gain=-0.5, scale=1e6)
    still = fp.Exponential(rate=1e-3, integral=False)
    result = fp.simulate(line(gain, 1.0, duration=0.05), fp.ComputedTorque(still, deformation), seed=0, compiled=False)
    error = result["realised.y"][1:] - result["desired.y"][1:]
    ratios = error[5:15] / error[4:14]
    np.testing.assert_allclose(ratios, 1 - deformation.effective_gain() * gain, atol=1e-3, equal_nan=False)


def test_anti_windup_settles_where_windup_would_not():
    """A step of 2 m with |u| <= 20: the request stays within the reachable set and the plant settles."""
    problem = line(1.0, 1.3, reference=fp.Trajectory(lambda t: {"y": 2 + 0 * t}), duration=4.0)
    problem = replace(problem, limits=fp.Limits(inputs={"u": (-20.0, 20.0)}))
    controller = fp.ComputedTorque(fp.Exponential(6.0, bumpless=False), fp.Sigmoid(gain=-0.5, scale=10.0))
    result = fp.simulate(problem, controller, seed=0, compiled=False)
    assert np.abs(result["deformed.y"]).max() <= 26.0 + 1e-9
    assert -result["error.y"].min() < 1.5
    assert np.abs(result["error.y"][-200:]).max() < 0.02


def test_disturbances_act_by_name():
    """A force step of 1 N on y'' = 2 u shows as 2 m/s^2 in the realised response, one cycle later."""
    quiet = run(line(2.0, 2.0))
    pushed = run(line(2.0, 2.0, disturbances={"u": fp.Step(at=0.1, size=1.0), "y": fp.Step(at=0.3, size=-3.0)}))
    difference = pushed["realised.y"] - quiet["realised.y"]
    assert np.all(difference[:101] == 0)
    assert difference[101] == pytest.approx(2.0)
    before, after = pushed["realised.y"][300], pushed["realised.y"][301]
    assert after - before == pytest.approx(-3.0, abs=0.2)


def test_noise_follows_the_seed():
    noisy = swing(disturbances={"torque": fp.Noise(0.1)}, duration=1.5)
    first, again, other = run(noisy, seed=1), run(noisy, seed=1), run(noisy, seed=2)
    assert np.array_equal(first.log, again.log)
    assert not np.array_equal(first.log, other.log)


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


@pytest.mark.parametrize("fails", ["raises", "sets its flag"])
def test_run_stops_where_a_solver_fails(fails, monkeypatch):
    """The run keeps the cycles before, and the reason is the solver's."""
    ready = simulator(swing(), fp.ComputedTorque(TRACK), compiled=False)
    evaluate, calls = ready.evaluator.evaluate, []

    def broken() -> object:
        calls.append(1)
        if len(calls) > 2 and fails == "raises":
            raise RuntimeError("first line\nOSQP failed")
        return evaluate()

    monkeypatch.setattr(ready.evaluator, "evaluate", broken)
    if fails != "raises":
        monkeypatch.setattr(Evaluator, "failed", property(lambda self: len(calls) > 2))
    run = ready.run(seed=0)
    assert run.cycles == 2 * SHORT
    assert run.stop is not None
    assert ("OSQP failed" if fails == "raises" else "compiled code failed") in run.stop


def test_save_and_load(tmp_path):
    result = run(swing(duration=0.1, measure_from=0.0))
    result.save(tmp_path / "run.npz")
    again = fp.load_run(tmp_path / "run.npz")
    assert np.array_equal(again.log, result.log)
    assert again.layout.columns == result.layout.columns
    settings: Any = again.settings
    assert settings["controller"]["is"] == "ComputedTorque"
    (tmp_path / "bad.npz").write_bytes((tmp_path / "run.npz").read_bytes()[:200])
    with pytest.raises(fp.FpirhcError, match="cannot read"):
        fp.load_run(tmp_path / "bad.npz")
    with pytest.raises(fp.FpirhcError, match="cannot write"):
        result.save(tmp_path / "no" / "run.npz")


def test_signals_by_name():
    """By signal, by column, as a table; a misspelt name gets the nearest."""
    result = run(swing(duration=0.1, measure_from=0.0))
    assert result["state"].shape == (100, 2)
    assert result["state.angle'"].shape == (100,)
    assert "error.angle" in result.to_dataframe().columns
    with pytest.raises(InvalidName, match="Did you mean 'desired'"):
        result["desird"]


BAD: dict[str, dict[str, Any]] = {
    "'angel' is unknown. Did you mean 'angle'": {"start": {"angel": 0.0}},
    "coordinate 'angle' has no first value": {"start": {}},
    "expected a finite number, got inf": {"start": {"angle": float("inf")}},
    "Problem.period: expected a number from 1e-12": {"period": 0.0},
    "lower 2.0 above upper 1.0": {"limits": fp.Limits(inputs={"torque": (2.0, 1.0)})},
    "input 'torqe' is unknown": {"limits": fp.Limits(inputs={"torqe": (0.0, 1.0)})},
    "has no nominal motion": {"reference": fp.Trajectory(lambda t: {})},
    "shorter than one period": {"duration": 1e-4},
    "disturbances: input or coordinate 'x' is unknown": {"disturbances": {"x": fp.Noise(1.0)}},
}


@pytest.mark.parametrize("message", BAD)
def test_mistakes_of_a_problem(message):
    with pytest.raises(InvalidProblem, match=message):
        swing(**BAD[message])


def test_response_not_invertible_at_the_start():
    weak = fp.Plant({"y": "m"}, {"u": "N"}, {}, lambda q, v, u, p: {"y": q.y * u.u})
    with pytest.raises(InvalidProblem, match=r"(?s)not invertible at the start \(y = 0, y' = 0\).*'u'"):
        line(1.0, 1.0, plant=weak)
    assert line(1.0, 1.0, plant=weak, start={"y": 1.0}).cycles == 500


def test_eigenvalues_of_both_signs_are_refused():
    """Two inputs of which the model has one sign wrong: no gain converges, and the error says what to check."""
    parameters = {"a": fp.Parameter(1.0, 1.0, "1"), "b": fp.Parameter(1.0, -1.0, "1")}
    crossed = fp.Plant(
        {"y": "m", "z": "m"}, {"u": "N", "w": "N"}, parameters, lambda q, v, u, p: {"y": p.a * u.u, "z": p.b * u.w}
    )
    reference = fp.Trajectory(lambda t: {"y": 0 * t, "z": 0 * t})
    problem = line(1.0, 1.0, plant=crossed, reference=reference, start={"y": 0.0, "z": 0.0})
    with pytest.raises(fp.FpirhcError, match="both signs"):
        run(problem, fp.Sigmoid(gain=-0.5, scale=1.0))
