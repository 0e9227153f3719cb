"""References and disturbances: derivatives by differentiation, and what acts at which time."""

import casadi as ca
import numpy as np
import pytest
from helpers.plants import chain

import fpirhc as fp
from fpirhc.contracts import Disturbance
from fpirhc.errors import InvalidProblem, InvalidValue


def test_derivatives_up_to_the_order():
    """For y = sin 2t the k-th derivative is 2^k sin(2t + k pi/2)."""
    state, response = fp.Trajectory(lambda t: {"y": ca.sin(2 * t)}).function(chain(4))(0.3)
    result = np.append(state.full().ravel(), float(response))
    expected = [2**k * np.sin(0.6 + k * np.pi / 2) for k in range(5)]
    np.testing.assert_allclose(result, expected, rtol=1e-12, equal_nan=False)


def test_missing_and_unknown_coordinates():
    with pytest.raises(InvalidProblem, match=r"(?s)'z' is unknown.*'y' has no nominal motion"):
        fp.Trajectory(lambda t: {"z": t}).function(chain(2))


# Disturbances: what they are at which time


TIMES = np.linspace(0, 2, 21)


def _values(disturbance, seed=0):
    return disturbance.values(TIMES, np.random.default_rng(seed))


def test_step_and_pulse():
    """Edges are where they were asked for."""
    assert _values(fp.Step(at=1.0, size=3.0)).tolist() == [0.0] * 10 + [3.0] * 11
    assert _values(fp.Step(at=0.5, duration=0.5, size=2.0)).sum() == pytest.approx(10.0)


def test_noise_is_drawn_from_the_seed():
    assert np.array_equal(_values(fp.Noise(1.0), 4), _values(fp.Noise(1.0), 4))
    assert not np.array_equal(_values(fp.Noise(1.0), 4), _values(fp.Noise(1.0), 5))


def test_formula_must_be_finite():
    np.testing.assert_allclose(_values(fp.Formula(lambda t: ca.exp(-t))), np.exp(-TIMES), equal_nan=False)
    with pytest.raises(InvalidValue, match="not finite at t = 0"):
        _values(fp.Formula(lambda t: 1 / t))


def test_a_disturbance_of_a_users_own_acts_with_its_values():
    """A sawtooth on the response of y'' = 0: the speed is its integral, cycle by cycle."""

    class Sawtooth(Disturbance):
        def values(self, times, random):  # noqa: ARG002
            return 3.0 * np.mod(times + 1e-12, 0.5)

    reference = fp.Trajectory(lambda t: {"y": 0 * t})
    problem = fp.Problem(chain(2), reference, {"y": 0.0}, 0.1, 2.0, disturbances={"y": Sawtooth()})
    still = fp.ComputedTorque(fp.Exponential(rate=1e-9, integral=False))
    speed = fp.simulate(problem, still, seed=0, compiled=False)["state.y'"]
    acting = 3.0 * np.mod(0.1 * np.arange(20) + 1e-12, 0.5)
    np.testing.assert_allclose(speed, 0.1 * np.concatenate([[0.0], np.cumsum(acting)[:-1]]), atol=1e-7)
