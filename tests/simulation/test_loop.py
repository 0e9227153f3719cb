"""The closed loop: laws of adaptation, clipping, finiteness, disturbances, and running in several ways."""

from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.faults import Failing
from helpers.plants import heavy, linear, swing

import fpirhc as fp
from fpirhc.errors import InvalidProblem

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
        fp.simulate(problem, fp.RecedingHorizon(Failing(iterations=1, tolerance=1e-3, at=at)), seed=0, compiled=False)
        for at in (None, 30)
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
    run = fp.simulate(problem, fp.ComputedTorque(TRACK), seed=0, compiled=False)
    assert ("more than a million times the 0.2 m of its reference and start" in str(run.stop)) == stops
    assert (run.cycles < problem.cycles) == stops
    assert np.abs(run["error"]).max() <= 2e5


# Every kind of reference and integrator, compiled where it can be and where it is worth it


def test_a_short_run_is_not_compiled_unless_it_is_asked_for():
    """None chooses by cycles and stages; the run says why, and is that of the virtual machine."""
    chosen = fp.simulate(swing(duration=0.02, measure_from=0.0), fp.ComputedTorque(TRACK), seed=0, compiled=None)
    assert chosen.settings["why not compiled"] == "the run is short, and a compiler would take longer"
    ready = fp.simulator(swing(duration=200.0), fp.ComputedTorque(TRACK), compiled=None)
    assert ready.compiled or "short" not in ready.backend.reason


# Mistakes at the door


BAD: dict[str, dict[str, Any]] = {
    "'angel' is unknown. Did you mean 'angle'": {"start": {"angel": 0.0}},
    "coordinate 'angle' has no first value": {"start": {}},
    "expected a finite number, got inf": {"start": {"angle": float("inf")}},
    "has no nominal motion": {"reference": fp.Trajectory(lambda t: {})},
    "shorter than one period": {"duration": 1e-4},
    "disturbances: input, coordinate or output 'x' is unknown": {"disturbances": {"x": fp.Noise(1.0)}},
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
