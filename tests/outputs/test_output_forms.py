"""The three forms of the iteration on outputs, and a rival, are those of loops in numpy."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.of_outputs import ARM, arm, circle
from helpers.plants import simulated

import fpirhc as fp
from fpirhc.contracts import Deformation

FORMS: dict[str, Deformation] = {
    "plain": fp.Affine(-0.6),
    "increment": fp.Increment(fp.Affine(-0.6), cycles=0, uncertainty=0),
    "model-referenced": fp.ModelReferenced(fp.Affine(-0.6)),
}


def by_hand(problem: fp.Problem, form: str) -> tuple[np.ndarray, np.ndarray]:
    """Angles and torques of computed torque on the hand: J q'' + J' q' = r, by numpy alone."""
    l1, l2 = ARM.values()
    period, mass, believed = problem.period, 1.0, 1.4
    damping, inertia = np.array([0.2, 0.1]), np.array([1.0, 0.5])
    motion = problem.reference.function(problem.plant)

    def kinematics(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        s1, c1, s12, c12 = np.sin(q[0]), np.cos(q[0]), np.sin(q.sum()), np.cos(q.sum())
        hand = np.array([l1 * c1 + l2 * c12, l1 * s1 + l2 * s12])
        jacobian = np.array([[-l1 * s1 - l2 * s12, -l2 * s12], [l1 * c1 + l2 * c12, l2 * c12]])
        w = v.sum()
        bias = np.array([-l1 * c1 * v[0] ** 2 - l2 * c12 * w**2, -l1 * s1 * v[0] ** 2 - l2 * s12 * w**2])
        return hand, jacobian @ v, jacobian, bias

    def rates(x: np.ndarray, torque: np.ndarray) -> np.ndarray:
        return np.concatenate([x[2:], (torque - damping * x[2:]) / (inertia * mass)])

    x, torque, request = problem.start_state.copy(), np.zeros(2), np.zeros(2)
    states, torques, delta, before = [], [], np.zeros(2), np.zeros(2)
    rate, share = 6.0, 0.3  # of the law, and the effective gain
    for k in range(problem.cycles):
        q, v = x[:2], x[2:]
        hand, speed, jacobian, bias = kinematics(q, v)
        nominal, wanted = (np.asarray(m.full()).ravel() for m in motion(k * period))
        error, slope = nominal[:2] - hand, nominal[2:] - speed
        desired = wanted + rate**2 * error + 2 * rate * slope
        measured = jacobian @ ((torque - damping * v) / (inertia * mass)) + bias
        modelled = jacobian @ ((torque - damping * v) / (inertia * believed)) + bias
        if k == 0:
            request = desired
        elif form == "plain":
            request = request - share * (measured - desired)
        elif form == "increment":
            request = desired + (request - before) - share * (measured - before)
        elif form == "model-referenced":
            asked = modelled - delta
            delta = delta - share * (measured - asked)
            request = desired + delta
        else:
            request = desired
        before = desired
        torque = inertia * believed * np.linalg.solve(jacobian, request - bias) + damping * v
        states.append(x)
        torques.append(torque)
        k1 = rates(x, torque)
        k2 = rates(x + period / 2 * k1, torque)
        k3 = rates(x + period / 2 * k2, torque)
        x = x + period / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + period * k3, torque))
    return np.array(states), np.array(torques)


@pytest.mark.parametrize("form", ["none", *FORMS])
def test_computed_torque_on_the_hand_is_inverse_kinematics_by_hand(form: str) -> None:
    problem = replace(circle(arm()), duration=1.0, measure_from=0.0)
    run = simulated(problem, fp.ComputedTorque(fp.Exponential(6.0, integral=False), FORMS.get(form, fp.Identity())))
    states, torques = by_hand(problem, form)
    assert np.abs(run["state"] - states).max() < 1e-12
    assert np.abs(run["command"] - torques).max() < 1e-10


# Rivals on plants with outputs: those whose idea is about errors follow outputs; the others say why they do not


def test_an_increment_by_hand_on_the_hand_of_an_arm() -> None:
    """The first request after a step of the model: its response to the last command plus the change, less its own drift."""
    problem = replace(circle(arm()), duration=0.1, measure_from=0.0)
    run = simulated(problem, fp.rivals.ResolvedAccelerationRate(rate=6.0))
    plant, k, p, size = problem.plant, 20, [1.4], 1e-6
    respond, x, u = plant.equations.controlled_response, run["state"][k], run["command"][k - 1]
    moved = plant.equations.rate(x, u, p).full().ravel()
    ends = [respond(x + s * size * moved, u, p).full().ravel() for s in (1, -1)]
    drift = (ends[0] - ends[1]) / (2 * size)
    change = run["desired"][k] - run["realised"][k]
    request = respond(x, u, p).full().ravel() + change - problem.period * drift
    assert np.allclose(run["command"][k], plant.equations.inverse(x, request, p).full().ravel(), atol=1e-6)
