"""A gain matrix: what it does to coupled responses, what is refused, and that every part of a review knows it."""

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.contracts import Deformation
from fpirhc.errors import InvalidValue, NotContractive

GAINS = np.array([[0.8, 0.3], [-0.5, 0.4]])


def coupled(form: Deformation) -> tuple[fp.Problem, fp.ComputedTorque]:
    """Two masses whose exact gains are coupled and whose model has none of it, under computed torque."""
    names = ("q", "p")
    entries = {f"b{i}{j}": fp.Parameter(float(i == j), float(GAINS[i, j]), "1") for i, j in np.ndindex(2, 2)}

    def response(q, v, u, p):
        return {name: p[f"b{i}0"] * u.u + p[f"b{i}1"] * u.w - 0.5 * v[name] for i, name in enumerate(names)}

    plant = fp.Plant(dict.fromkeys(names, "m"), {"u": "m/s^2", "w": "m/s^2"}, entries, response)
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"q": ca.sin(2 * t), "p": ca.cos(3 * t)}),
        start={"q": 0.0, "p": 1.0, "q'": 2.0},
        period=1e-2,
        duration=3.0,
        measure_from=1.0,
    )
    return problem, fp.ComputedTorque(fp.Exponential(rate=3.0), form)


def error(form: Deformation) -> float:
    problem, controller = coupled(form)
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    return float(np.linalg.norm([*fp.measure(problem, run).rms_error.values()]))


INVERSE = tuple(map(tuple, np.linalg.inv(GAINS).round(3).tolist()))


@pytest.mark.parametrize("weights", [(1.0, 1.0), (2.0, 0.5), ((1.0, 0.2), (-0.3, 2.0))])
def test_the_step_is_the_matrix_times_the_error(weights):
    """r+ = r + A_c / 2 W (f - d), also where W is given by its diagonal."""
    one = fp.Affine(gain=-0.6, weights=weights)
    matrix = np.array(weights) if isinstance(weights[0], tuple) else np.diag(weights)
    r, f, d = np.array([1.0, 2.0]), np.array([0.3, -0.7]), np.array([0.1, 0.5])
    after, memory = one.step(ca.SX(r), ca.SX(f), ca.SX(d), {})
    assert np.asarray(ca.evalf(ca.SX(after))).ravel() == pytest.approx(r - 0.3 * matrix @ (f - d), abs=1e-15)
    assert memory == {}


def test_the_inverse_of_the_gains_is_deadbeat():
    """With A_c = -2 and W the inverse of the gains an error is gone after one cycle; one number for both leaves more."""
    best = min(error(fp.Affine(gain=g)) for g in (-0.8, -1.6, -2.4, -2.8))
    weighted = fp.Affine(gain=-2.0, weights=INVERSE)
    assert error(weighted) < 0.75 * best
    problem, controller = coupled(weighted)
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    metrics = fp.measure(problem, run)
    assert metrics["contraction.predicted"][""] < 2e-3
    assert metrics["contraction.measured"][""] < 0.05


def test_a_gain_that_converges_with_its_weights_alone_is_not_refused():
    """The limit is that of the eigenvalues of J W: a sign turned by the weights is right, and refused without them."""
    problem, controller = coupled(fp.Affine(gain=0.5, weights=(-1.0, -1.0)))
    assert fp.simulate(problem, controller, seed=0, compiled=False).stop is None
    with pytest.raises(NotContractive, match="wrong sign"):
        fp.simulate(problem, replace(controller, deformation=fp.Affine(gain=0.5)), seed=0, compiled=False)
    large = fp.Affine(gain=-0.9, weights=(1.0, 19.0))
    with pytest.raises(NotContractive, match=r"use 0 < \|gain\| < 0\.559, where"):
        fp.simulate(problem, replace(controller, deformation=large), seed=0, compiled=False)


@pytest.mark.parametrize("weights", [(), (1.0, 0.0), (math.inf, 1.0), ((1.0, 2.0), (2.0, 4.0)), ((1.0, 2.0),)])
def test_weights_that_are_no_regular_matrix_are_refused(weights):
    with pytest.raises(InvalidValue, match="expected a tuple with a finite number other than zero"):
        fp.Affine(gain=-0.5, weights=weights)
