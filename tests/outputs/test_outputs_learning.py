"""Learners on plants with outputs: offset-free control, disturbances of outputs and responses, learned parameters."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from helpers.of_outputs import arm, circle, hill, planned, sedated
from helpers.plants import simulated

import fpirhc as fp
from fpirhc.contracts import Controller

LAW = fp.ComputedTorque(fp.Exponential(rate=1.0))
STATES = {"C": 0.01, "E": 0.01}
SLOW = {"C": 1e-3, "E": 1e-3}
ANSWER = fp.DisturbanceKalman({"depth''": 100.0}, {"depth''": 0.1, **STATES}, noise=SLOW)
SHIFT = fp.DisturbanceKalman({"depth": 1.0}, {"depth": 0.01, **STATES}, noise=SLOW)
PLAN = fp.RecedingHorizon(fp.FixedPointSolver(iterations=3, tolerance=1e-2))


def test_the_filter_on_the_hand_of_an_arm_is_the_recursion_by_hand() -> None:
    """Angles, hand and the hand's acceleration are measured; a joint and the hand's acceleration are disturbed."""
    drift, noise = {"a": 2.0, "x''": 3.0}, {"b": 0.1}
    measured = {"a": 0.01, "b": 0.01, "x": 0.02, "y'": 0.05, "x''": 0.5}
    problem = replace(circle(arm()), duration=0.3, measure_from=0.0)
    filter = fp.DisturbanceKalman(drift, measured, noise)
    run = simulated(problem, fp.Estimating(fp.ComputedTorque(fp.Exponential(6.0)), filter))

    plant, mass, period = problem.plant, 1.4, problem.period
    rate = plant.equations.forced_rate

    def moved(x: np.ndarray, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        def f(s: np.ndarray) -> np.ndarray:
            return rate(s, u, [mass], w).full().ravel()

        k1 = f(x)
        k2 = f(x + period / 2 * k1)
        k3 = f(x + period / 2 * k2)
        return x + period / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + period * k3))

    def shown(x: np.ndarray, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        """The second w adds to the hand's acceleration alone."""
        forcing = np.array([w[0], 0.0])
        y = plant.equations.output(x, u, [mass], forcing).full().ravel()
        step = 1e-4  # of a central difference of the hand's speed along the motion
        xdot = rate(x, u, [mass], forcing).full().ravel()
        ends = tuple(plant.equations.output(x + s * step * xdot, u, [mass], forcing).full().ravel()[2] for s in (1, -1))
        back = (ends[0] - ends[1]) / (2 * step)
        return np.array([x[0], x[1], y[0], y[3], back + w[1]])

    def slopes(of: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
        return np.column_stack([(of(at + e) - of(at - e)) / 2e-5 for e in 1e-5 * np.eye(at.size)])

    # The operating point: the reference at t = 0 and the input that the model needs for its response there.
    first = problem.start_state
    response = np.asarray(problem.reference.function(plant)(0.0)[1].full()).ravel()
    u0 = plant.equations.inverse(first, response, [mass]).full().ravel()
    a_x = slopes(lambda x: moved(x, u0, np.zeros(2)), first)
    b_w = slopes(lambda w: moved(first, u0, w), np.zeros(2))
    a = np.block([[a_x, b_w[:, :1], np.zeros((4, 1))], [np.zeros((2, 4)), np.eye(2)]])
    c = np.hstack(
        [slopes(lambda x: shown(x, u0, np.zeros(2)), first), slopes(lambda w: shown(first, u0, w), np.zeros(2))]
    )
    q = scipy.linalg.block_diag(np.outer(b_w[:, 1], b_w[:, 1]) * 0.1**2, np.diag([period * 4.0, period * 9.0]))
    r = np.diag(np.array(list(measured.values())) ** 2)
    p = scipy.linalg.solve_discrete_are(a.T, c.T, q, r)
    gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + r)

    x, w = run["state"][0], np.zeros(2)
    for k in range(1, run.cycles):
        u = run["command"][k - 1]
        ahead = moved(x, u, np.array([w[0], 0.0]))
        seen = np.array([*run["state"][k][:2], run["output.x"][k], run["output.y'"][k], run["realised.x"][k]])
        z = np.concatenate([ahead, w]) + gain @ (seen - shown(ahead, u, w))
        x, w = z[:4], z[4:]
        assert np.allclose(run["estimate"][k], w, rtol=1e-3, atol=1e-4)
    assert np.ptp(run["estimate"], axis=0).min() > 0.05


def test_a_disturbance_of_an_output_is_the_distance_of_the_curves() -> None:
    """At rest the estimate is the measured depth less that of the model."""
    problem = sedated(hill(5.5))
    run = simulated(problem, fp.Estimating(LAW, SHIFT))
    model = problem.plant.equations.output(run["state"][-1], run["command"][-1], [5.5], np.zeros(2)).full().ravel()
    assert run["estimate.w_depth"][-1] == pytest.approx(run["output.depth"][-1] - model[0], rel=0.01)
    assert abs(run["estimate.w_depth"][-1]) > 5
    for inner in (LAW, PLAN):
        [note] = fp.Estimating(inner, SHIFT).notes(planned())
        assert note.endswith("w_depth, and the offset of an output is taken from the measurement; name states: C, E")
        assert fp.Estimating(inner, ANSWER).notes(planned()) == ()
    commands = [simulated(planned(), one)["command"] for one in (PLAN, fp.Estimating(PLAN, SHIFT))]
    assert commands[0] == pytest.approx(commands[1], rel=1e-6)


def estimating(inner: Controller, *numbers: Mapping[str, float]) -> Callable[[], object]:
    return lambda: simulated(sedated(hill(5.5)), fp.Estimating(inner, fp.DisturbanceKalman(*numbers)))


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "a measured name": (estimating(LAW, {"C": 1.0}, {"depth'''": 1.0}), "measured: state, output or response"),
    "a name": (estimating(LAW, {"deep": 1.0}, STATES), "mean 'depth'"),
    "too little": (estimating(LAW, {"C": 1.0, "E": 1.0, "depth": 1.0}, STATES), "need as many measured quantities"),
    "no use of the model": (estimating(fp.PID({"depth": -1.0}), {"C": 1.0}, STATES), "PID uses none of them"),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_a_mistake_is_named(mistake: str) -> None:
    make, words = WRONG[mistake]
    with pytest.raises(fp.FpirhcError, match=words):
        make()
