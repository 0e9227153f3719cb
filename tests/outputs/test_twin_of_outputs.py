"""Twins of plants with outputs: a model-referenced form behind estimators and dead time of outputs."""

from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp

LAW, MAP = fp.Exponential(rate=8.0), fp.Sigmoid(gain=-0.3, scale=60.0)
PLAIN = fp.ComputedTorque(LAW)
REFERENCED = fp.ComputedTorque(LAW, fp.ModelReferenced(MAP))
QUANTUM = {"y": fp.Sensor(quantum=1e-5)}
ESTIMATORS = (fp.VelocityDifference(), fp.PositionDifference(), fp.SavitzkyGolay(window=5, degree=3))
WAITS = {
    "none": fp.DeadTime(),
    "inputs": fp.DeadTime(inputs={"u": 3e-3}),
    "both": fp.DeadTime(inputs={"u": 2e-3}, measurement=2e-3),
}


def arm(*, exact: bool = False) -> fp.Plant:
    """An arm whose hand is an expression of its angle; inertia and length are wrong in the model, or right."""
    return fp.Plant(
        {"q": "rad"},
        {"u": "N m"},
        {"J": fp.Parameter(1.3, 1.3 if exact else 1.0, "kg m^2"), "L": fp.Parameter(1.0, 1.0 if exact else 1.1, "m")},
        lambda q, v, u, p: {"q": (u.u - 5 * ca.sin(q.q)) / p.J},
        outputs={"y": fp.Output("m", lambda q, v, p: p.L * ca.sin(q.q) + 0.1 * q.q)},
    )


def task(estimator: Any, *, exact: bool = False, **changes: Any) -> fp.Problem:
    """The hand along a sine."""
    settings: dict[str, Any] = {
        "plant": arm(exact=exact),
        "reference": fp.Trajectory(lambda t: {"y": 0.5 * ca.sin(2 * t)}),
        "start": {"q": 0.0, "q'": 1.0},
        "period": 1e-3,
        "duration": 0.15,
        "limits": fp.Limits(inputs={"u": (-60.0, 60.0)}),
        "sensing": fp.Sensing(estimator=estimator),
    }
    return fp.Problem(**(settings | changes))


def run(problem: fp.Problem, controller: Any) -> fp.Run:
    result = fp.simulate(problem, controller, seed=0, compiled=False)
    assert result.stop is None
    return result


@pytest.mark.parametrize("wait", WAITS)
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=repr)
def test_an_exact_model_is_left_alone(estimator, wait):
    """Late, rounded and smoothed alike, the two responses are the same number, to rounding."""
    quanta = QUANTUM if isinstance(estimator, fp.PositionDifference) else {}
    problem = task(estimator, exact=True, dead_time=WAITS[wait], sensing=fp.Sensing(quanta, estimator))
    one, other = run(problem, PLAIN), run(problem, REFERENCED)
    np.testing.assert_allclose(other["plant_output"], one["plant_output"], atol=1e-9)


def test_under_a_prediction_the_twin_sees_what_is_measured():
    """The controller acts on outputs ahead, the twin compares those of the samples: an exact model is left alone."""
    late = WAITS["both"]
    problem = task(fp.PositionDifference(), exact=True, dead_time=late)
    one, other = (run(problem, fp.Predicted(c, inputs=2e-3, measurement=2e-3)) for c in (PLAIN, REFERENCED))
    np.testing.assert_allclose(other["plant_output"], one["plant_output"], atol=1e-9)
