"""Disturbances: what they are at which time."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidValue

TIMES = np.linspace(0, 2, 21)


def _values(disturbance, seed=0):
    return disturbance.values(TIMES, np.random.default_rng(seed))


def test_step_pulse_and_sine():
    """Edges are where they were asked for."""
    assert _values(fp.Step(at=1.0, size=3.0)).tolist() == [0.0] * 10 + [3.0] * 11
    assert _values(fp.Pulse(at=0.5, duration=0.5, size=2.0)).sum() == pytest.approx(10.0)
    np.testing.assert_allclose(_values(fp.Sine(2.0, 0.25)), 2 * np.sin(np.pi / 2 * TIMES), equal_nan=False)


def test_noise_is_drawn_from_the_seed():
    """The same seed gives the same noise, another seed another."""
    assert np.array_equal(_values(fp.Noise(1.0), 4), _values(fp.Noise(1.0), 4))
    assert not np.array_equal(_values(fp.Noise(1.0), 4), _values(fp.Noise(1.0), 5))


def test_formula_must_be_finite():
    """An expression that is not finite says when."""
    np.testing.assert_allclose(_values(fp.Formula(lambda t: ca.exp(-t))), np.exp(-TIMES), equal_nan=False)
    with pytest.raises(InvalidValue, match="t = 0 s"):
        _values(fp.Formula(lambda t: 1 / t))
