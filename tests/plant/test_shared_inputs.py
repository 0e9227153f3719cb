"""More inputs than outputs, as docs/plants.md writes them: efforts that the equations share out by a weighted right inverse."""

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import fpirhc as fp

EFFECT = np.array([[1.0, 1.0, 1.0], [-0.5, 0.5, 0.2]])
DEARNESS = np.array([1.0, 1.0, 4.0])
SHARES = np.diag(1 / DEARNESS) @ EFFECT.T @ np.linalg.inv(EFFECT @ np.diag(1 / DEARNESS) @ EFFECT.T)
MASS, INERTIA, STRENGTH = (12.0, 10.0), (1.5, 2.0), (1.0, 0.8)  # approximate, exact
RATE, PERIOD = 3.0, 0.01


def test_the_shares_are_numpys_weighted_pseudo_inverse_and_the_cheapest():
    """Whatever is added from the null space of the effects has no effect and costs more."""
    root = np.diag(DEARNESS**-0.5)
    np.testing.assert_allclose(SHARES, root @ np.linalg.pinv(EFFECT @ root), rtol=1e-12)
    free, wanted = np.linalg.svd(EFFECT)[2][2], np.array([2.0, -0.7])
    np.testing.assert_allclose(EFFECT @ (SHARES @ wanted), wanted, rtol=1e-12)
    for more in (-0.3, 0.01, 0.5):
        assert DEARNESS @ (SHARES @ wanted + more * free) ** 2 > DEARNESS @ (SHARES @ wanted) ** 2


def ferry() -> fp.Problem:
    """Position and heading by three thrusters; their effect is weaker than the model has it."""

    def response(q, v, u, p):
        thrusts = [p.effect * (share[0] * u.force + share[1] * u.moment) for share in SHARES]
        force, moment = (sum(e * thrust for e, thrust in zip(row, thrusts, strict=True)) for row in EFFECT)
        return {"x": force / p.mass, "heading": moment / p.inertia}

    plant = fp.Plant(
        coordinates={"x": "m", "heading": "rad"},
        inputs={"force": "N", "moment": "N m"},
        order=2,
        response=response,
        parameters={
            "mass": fp.Parameter(*MASS, unit="kg"),
            "inertia": fp.Parameter(*INERTIA, unit="kg m^2"),
            "effect": fp.Parameter(*STRENGTH, unit="1"),
        },
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"x": ca.sin(t), "heading": 0.3 * ca.sin(2 * t)}),
        start={"x": 0.0, "heading": 0.1},
        period=PERIOD,
        duration=2.0,
    )


def test_the_loop_is_that_of_numpy_and_scipy():
    """Computed torque without integral; the plant's response is taken from the three thrusts, not from the efforts."""
    problem = ferry()
    run = fp.simulate(problem, fp.ComputedTorque(fp.Exponential(rate=RATE, integral=False)), seed=0)
    state, inertias = np.array([0.0, 0.1, 0.0, 0.0]), np.array([MASS, INERTIA])
    for k in range(problem.cycles):
        t = k * PERIOD
        wanted = np.array([np.sin(t), 0.3 * np.sin(2 * t)])
        slopes = np.array([np.cos(t), 0.6 * np.cos(2 * t)])
        bends = np.array([-np.sin(t), -1.2 * np.sin(2 * t)])
        desired = bends + 2 * RATE * (slopes - state[2:]) + RATE**2 * (wanted - state[:2])
        thrusts = SHARES @ (inertias[:, 0] * desired / STRENGTH[0])
        np.testing.assert_allclose(SHARES @ run["command"][k], thrusts, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(run["state"][k], state, rtol=1e-7, atol=1e-9)
        pushed = EFFECT @ (STRENGTH[1] * thrusts) / inertias[:, 1]
        state = solve_ivp(lambda _, x, a=pushed: [*x[2:], *a], (0, PERIOD), state, rtol=1e-10, atol=1e-12).y[:, -1]
