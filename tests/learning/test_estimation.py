"""Learning the model: estimates equal batch formulas, also late; they remove offsets, keep bounds, and act in every cycle."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from helpers.plants import linear
from helpers.plants import simulated as run

import fpirhc as fp
from fpirhc.errors import InvalidProblem, NotSupported

PERIOD = 1e-2


def spring(k: float = 3.0, b: float = 1.0, believed: tuple[float, float] = (2.0, 1.5)) -> fp.Plant:
    """Y'' = b u - k y, linear in its parameters."""
    return fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"k": fp.Parameter(believed[0], k, "1/s^2"), "b": fp.Parameter(believed[1], b, "1/kg")},
        response=lambda q, v, u, p: {"y": p.b * u.u - p.k * q.y},
    )


def task(plant: fp.Plant, **changes) -> fp.Problem:
    """Follow two sines (or what `changes` say) with a short horizon."""
    name, force = plant.names[0], next(iter(plant.inputs))
    settings: dict[str, Any] = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {name: 0.3 * ca.sin(2 * t) + 0.1 * ca.sin(5 * t)}),
        "start": {name: 0.05},
        "period": PERIOD,
        "duration": 2.0,
        "limits": fp.Limits(inputs={force: (-20.0, 20.0)}),
        "horizon": fp.Horizon(stages=10, step=2 * PERIOD),
        "cost": fp.Quadratic(states={name: 1e2, f"{name}'": 1.0}, deviation={force: 0.1}),
    }
    return fp.Problem(**(settings | changes))


RHC = fp.RecedingHorizon(fp.FixedPointSolver(iterations=2, tolerance=1e-6))
SPRING = {"k": fp.Uncertain(0.0, 10.0, 1.0), "b": fp.Uncertain(0.1, 5.0, 0.5)}
NOISE = {"y": 0.1}


def offset_free(at_once: bool) -> fp.Estimating:
    return fp.Estimating(RHC, fp.DisturbanceKalman({"y": 20.0}, {"y": 1e-4, "y'": 1e-3}), at_once=at_once)


def test_a_constant_disturbance_leaves_no_offset():
    """The disturbance model leaves nothing and finds w."""
    push = 1.5
    rest = task(
        linear(1.0, 1.0),
        reference=fp.Trajectory(lambda t: {"y": 0 * t}),
        disturbances={"y": fp.Step(0.0, push)},
        duration=5.0,
        start={"y": 0.0},
    )
    plain, free = (run(rest, controller) for controller in (RHC, offset_free(at_once=False)))
    assert abs(plain["state.y"][-1]) > 0.02
    assert abs(free["state.y"][-1]) < 1e-6
    assert free["estimate"][-1, 0] == pytest.approx(push, rel=1e-6)


class Fed:
    """An estimator stepped over given pairs by hand."""

    def __init__(self, problem: fp.Problem, estimator):
        layout, plant = estimator.memory(problem), problem.plant
        symbols = [ca.MX.sym(n, k) for n, k in (("x", 2), ("u", 1), ("f", 1), ("valid", 1), ("m", layout.size))]
        x, u, f, valid, memory = symbols
        known = {"parameters": ca.MX(ca.DM(plant.approximate)), "followed": None, "output": None}
        values: Any = SimpleNamespace(state=x, command=u, response=f, valid=valid, **known)
        parameter_change, next_memory = estimator.step(problem)(values, layout.split(memory))
        self.function = ca.Function("fed", symbols, [parameter_change, layout.join(next_memory)])
        self.memory = layout.start()

    def __call__(self, x, u, f):
        """The parameter_change after one more pair."""
        parameter_change, self.memory = self.function(x, u, f, 1, self.memory)
        return parameter_change.full().ravel()


def pairs(count: int, plant: fp.Plant, seed: int = 3):
    """Random states and inputs, and the plant's responses with noise."""
    random = np.random.default_rng(seed)
    for _ in range(count):
        x, u = random.normal(size=2), random.normal(size=1)
        f = plant.equations.response(x, u, plant.exact).full().ravel()
        yield x, u, f + 0.1 * random.normal(size=1)


def batch(plant, data, weights, prior):
    """The regularised weighted least squares of corrections of (k, b), by the normal equations."""
    scale = np.array([known.deviation for known in SPRING.values()])
    rows = np.array([[-x[0], u[0]] for x, u, _ in data]) * scale / NOISE["y"]
    right = np.array([f[0] - plant.equations.response(x, u, plant.approximate).full()[0, 0] for x, u, f in data])
    right = right / NOISE["y"]
    z = np.linalg.solve(prior * np.eye(2) + rows.T @ (weights[:, None] * rows), rows.T @ (weights * right))
    return scale * z, rows, right


@pytest.mark.parametrize("time", [math.inf, 0.5])
def test_recursive_least_squares_are_the_batch_ones(time):
    """After every pair, with and without forgetting."""
    plant = spring()
    problem, factor = task(plant), math.exp(-PERIOD / time)
    fed, data = Fed(problem, fp.RecursiveLeastSquares(SPRING, NOISE, time)), list(pairs(60, plant))
    for k, pair in enumerate(data, 1):
        estimates = fed(*pair)
        expected, *_ = batch(plant, data[:k], factor ** np.arange(k - 1, -1, -1), factor**k)
        np.testing.assert_allclose(estimates, expected, rtol=1e-7, atol=1e-10)


def test_bounds_are_kept():
    """Whatever the pairs say; and without excitation nothing winds up."""
    plant = spring(k=30.0, b=0.01)
    fed = Fed(task(plant), fp.RecursiveLeastSquares(SPRING, NOISE, 0.1))
    for pair in pairs(50, plant):
        k, b = fed(*pair) + plant.approximate
        assert 0.0 <= k <= 10.0
        assert 0.1 <= b <= 5.0
    for _ in range(2000):
        fed(np.zeros(2), np.zeros(1), np.zeros(1))
    assert np.abs(np.asarray(fed.memory)).max() < 1e6


TWO_TASK = fp.Problem(
    plant=fp.Plant(
        coordinates={"a": "m", "b": "m"},
        inputs={"u": "N"},
        parameters={"k": fp.Parameter(1.0, 1.0, "1/s^2")},
        controlled=("a",),
        response=lambda q, v, u, p: {"a": u.u - p.k * q.a, "b": p.k * q.a - p.k * q.b},
    ),
    reference=fp.Trajectory(lambda t: {"a": 0 * t, "b": 0 * t}),
    start={"a": 0.0, "b": 0.0},
    period=PERIOD,
    duration=1.0,
    horizon=fp.Horizon(stages=5, step=PERIOD),
    cost=fp.Quadratic(states={"b": 1.0}, effort={"u": 1.0}),
)


@pytest.mark.parametrize(
    ("problem", "estimator", "error", "message"),
    [
        (TWO_TASK, fp.DisturbanceKalman({"a": 1.0, "b": 1.0}, {"b": 1.0}), InvalidProblem, "2 disturbances"),
        # What moves only b says nothing about itself in a.
        (
            TWO_TASK,
            fp.DisturbanceKalman({"b": 1.0}, {"a": 1.0}, {"a": 1.0}),
            NotSupported,
            r"w_b cannot be determined from a",
        ),
        (TWO_TASK, fp.DisturbanceKalman({"a": 1.0}, {"a": 1.0, "z": 1.0}), InvalidProblem, "'z' is unknown"),
        (TWO_TASK, fp.DisturbanceKalman({"z": 1.0}, {"a": 1.0}), InvalidProblem, "'z' is unknown"),
        # Nothing is said to disturb the undamped mass a, so its filter would never forget the first error.
        (TWO_TASK, fp.DisturbanceKalman({"b": 1.0}, {"a": 1.0, "b": 1.0}), NotSupported, r"give noise=\{'a'"),
        (task(spring()), fp.RecursiveLeastSquares({"q": SPRING["k"]}, NOISE, 1.0), InvalidProblem, "'q' is unknown"),
        (task(spring()), fp.RecursiveLeastSquares(SPRING, {}, 1.0), InvalidProblem, "add 'y'"),
        (
            task(spring()),
            fp.DisturbanceKalman({"y": 1.0}, {"y'''": 1.0}),
            InvalidProblem,
            "state, output or response.*Valid: y, y', y''",
        ),
    ],
)
def test_estimators_that_do_not_fit_are_refused(problem, estimator, error, message):
    with pytest.raises(error, match=message):
        fp.Estimating(RHC, estimator).check(problem)


TRACK = fp.ComputedTorque(fp.Exponential(rate=2.0))
LATE = {
    "input": fp.DeadTime(inputs={"u": 0.05}),
    "measurement": fp.DeadTime(measurement=0.05),
    "both": fp.DeadTime(inputs={"u": 0.03}, measurement=0.02),
}


# Late pairs


@pytest.mark.parametrize("late", LATE)
def test_parameters_are_found_behind_dead_time(late):
    """To 1e-3, where pairs that ignore the dead time leave errors a hundred times as large."""
    problem, errors = task(spring(), duration=4.0, dead_time=LATE[late]), []
    learner = fp.RecursiveLeastSquares(SPRING, NOISE, 5.0)
    for believed in (None, fp.DeadTime()):
        result = run(problem, fp.Estimating(TRACK, learner, dead_time=believed))
        errors.append(np.abs(result["estimate"][-1] - [3.0, 1.0]).max())
        if believed is None:  # a late sample shows the start for so many cycles, and teaches nothing
            assert np.ptp(result["estimate"][: 1 + round(LATE[late].measurement / PERIOD)], axis=0).max() == 0
    assert errors[0] < 1e-3
    assert errors[1] > 100 * errors[0]


# The filter of disturbances


def test_the_gain_of_a_measured_response_is_that_of_the_stationary_filter():
    """A double integrator with y and y'' = b u + w measured: the Riccati equation written out by hand, solved by scipy."""
    problem = task(linear(1.0, 1.0))
    filter = fp.DisturbanceKalman({"y": 2.0}, {"y": 1e-3, "y''": 0.3}, noise={"y": 0.5})
    h = PERIOD
    a = np.array([[1, h, h**2 / 2], [0, 1, h], [0, 0, 1]])
    b, c = np.array([[h**2 / 2], [h], [0]]), np.array([[1.0, 0, 0], [0, 0, 1.0]])
    q, r = 0.5**2 * b @ b.T + np.diag([0, 0, 4 * h]), np.diag([1e-6, 0.09])
    p = scipy.linalg.solve_discrete_are(a.T, c.T, q, r)
    expected = p @ c.T @ np.linalg.inv(c @ p @ c.T + r)
    np.testing.assert_allclose(filter.gain(replace(problem, plant=filter.model(problem.plant))), expected, rtol=1e-7)


def test_a_new_estimate_changes_the_command_between_plans():
    """Y'' = b u + w: the command is the plan's input minus what w has changed since the plan, over b."""
    waves = fp.Formula(lambda t: ca.sin(2 * np.pi * 3.0 * t))
    problem = task(linear(1.0, 0.8), horizon=fp.Horizon(stages=10, step=10 * PERIOD), disturbances={"y": waves})
    result = run(problem, offset_free(at_once=True))
    command, planned, w = result["command"][:, 0], result["planned"][:, 0], result["estimate"][:, 0]
    since = w - np.repeat(w[::10], 10)[: w.size]
    np.testing.assert_allclose(command, planned - since / 0.8, atol=1e-9)
    assert np.abs(since).max() > 0.1
    held = run(problem, offset_free(at_once=False))
    np.testing.assert_allclose(held["command"], held["planned"], atol=1e-9)
