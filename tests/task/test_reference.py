"""References: derivatives by differentiation, tables by splines, one interface."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from plants import chain

import fpirhc as fp
from fpirhc.errors import InvalidProblem, InvalidShape, InvalidValue


def test_derivatives_up_to_the_order():
    """For y = sin 2t the k-th derivative is 2^k sin(2t + k pi/2)."""
    state, response = fp.Trajectory(lambda t: {"y": ca.sin(2 * t)}).function(chain(4))(0.3)
    result = np.append(state.full().ravel(), float(response))
    expected = [2**k * np.sin(0.6 + k * np.pi / 2) for k in range(5)]
    np.testing.assert_allclose(result, expected, rtol=1e-12, equal_nan=False)


def test_table_agrees_with_the_expression_it_samples():
    """A quintic spline through samples of a smooth motion follows its first two derivatives."""
    times = np.linspace(0, 3, 301)
    table = fp.Table(times, {"y": np.sin(2 * times)}).function(chain(2))
    exact = fp.Trajectory(lambda t: {"y": ca.sin(2 * t)}).function(chain(2))
    for t in (0.5, 1.234, 2.5):
        for result, expected in zip(table(t), exact(t), strict=True):
            np.testing.assert_allclose(result.full(), expected.full(), atol=1e-6, equal_nan=False)


def test_table_is_held_outside():
    """Beyond its last sample a table stands still."""
    times = np.linspace(0, 1, 11)
    state, response = fp.Table(times, {"y": times**2}).function(chain(2))(5.0)
    np.testing.assert_allclose(state.full().ravel(), [1.0, 0.0], atol=1e-9, equal_nan=False)
    assert float(response) == 0.0


def test_missing_and_unknown_coordinates():
    with pytest.raises(InvalidProblem, match=r"(?s)'z' is unknown.*'y' has no nominal motion"):
        fp.Trajectory(lambda t: {"z": t}).function(chain(2))


@pytest.mark.parametrize(
    ("times", "values", "error"),
    [
        ([0, 1, 1, 2, 3, 4], [0] * 6, InvalidValue),
        ([0, 1, 2, 3, 4, 5], [0] * 5, InvalidShape),
        ([0, 1, 2], [0] * 3, InvalidShape),
        ([0, 1, 2, 3, 4, 5], [0, 1, float("nan"), 1, 1, 1], InvalidValue),
    ],
)
def test_bad_tables(times, values, error):
    """Times must increase, lengths must agree, values must be finite."""
    with pytest.raises(error):
        fp.Table(times, {"y": values})
