"""The exponential tracking law: gains, decay, bumpless start, digital limit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import chain

import fpirhc as fp
from fpirhc.errors import InvalidValue


def _run(order, tracking, *, start, period=1e-3, duration=3.0, limits=None):
    problem = fp.Problem(
        plant=chain(order),
        reference=fp.Trajectory(lambda t: {"y": 0 * t}),
        start=start,
        period=period,
        duration=duration,
        limits=limits or fp.Limits(),
    )
    return fp.simulate(problem, fp.ComputedTorque(tracking), seed=0, compiled=False)


@pytest.mark.parametrize(("order", "gains"), [(1, (36, 12)), (2, (216, 108, 18)), (4, (7776, 6480, 2160, 360, 30))])
def test_gains_are_binomials(order, gains):
    """(d/dt + 6)^(n+1) e_int expanded."""
    assert fp.Exponential(rate=6.0).gains(order) == pytest.approx(gains)


@settings(deadline=None, derandomize=True, max_examples=30)
@given(order=st.integers(1, 6), rate=st.floats(0.1, 30), integral=st.booleans())
def test_all_error_modes_are_at_minus_rate(order, rate, integral):
    """The characteristic polynomial is (s + rate)^degree, whatever the order."""
    gains = fp.Exponential(rate=rate, integral=integral).gains(order)
    degree = len(gains)
    expected = [math.comb(degree, k) * rate ** (degree - k) for k in range(degree)]
    assert gains == pytest.approx(expected, rel=1e-12)


def test_bumpless_start_asks_for_the_nominal_response():
    """With a first error of 1 m the first desired acceleration is the nominal one, zero; without, it is 3 rate^2."""
    bumpless = _run(2, fp.Exponential(6.0), start={"y": -1.0}, duration=0.01)
    plain = _run(2, fp.Exponential(6.0, bumpless=False), start={"y": -1.0}, duration=0.01)
    assert bumpless["desired.y"][0] == pytest.approx(0.0, abs=1e-12)
    assert plain["desired.y"][0] == pytest.approx(108.0)


def test_digital_limit():
    """With integral and n = 2 the sampled loop is stable below rate x period = 0.667 and unstable above."""
    period = 0.01
    stable = _run(2, fp.Exponential(0.60 / period), start={"y": -1e-3}, period=period)
    unstable = _run(2, fp.Exponential(0.72 / period), start={"y": -1e-3}, period=period)
    assert np.abs(stable["error.y"][-20:]).max() < 1e-6
    assert np.abs(unstable["error.y"][-20:]).max() > 1.0


def test_rate_must_be_positive():
    """A rate of zero would never track."""
    with pytest.raises(InvalidValue, match="above 0"):
        fp.Exponential(rate=0.0)
