"""What a mismatch of P percent means, with a spread and without one: studies draw from the range that reviews cover."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from scipy import stats

import fpirhc as fp
from fpirhc.errors import InvalidProblem, InvalidValue
from fpirhc.plant.parameter import EXAMPLES, TAILS, Spread
from fpirhc.plant.plant import exact_ranges


def plant(**parameters: fp.Parameter) -> fp.Plant:
    """A mass on a line that ignores its further parameters."""
    return fp.Plant(
        {"y": "m"}, {"u": "N"}, {"b": fp.Parameter(1.0, 1.0, "1/kg"), **parameters}, lambda q, v, u, p: {"y": p.b * u.u}
    )


def parameter(exact: float, spread: Spread, **changes) -> fp.Parameter:
    return fp.Parameter(approximate=exact, exact=exact, unit="1", spread=spread, **changes)


@pytest.mark.parametrize("spread", EXAMPLES, ids=repr)
@pytest.mark.parametrize("exact", [3.0, -2.0])
def test_laws_of_spreads(spread, exact):
    """Quantiles rise, are finite at both ends, have the exact value as median, and stand still at share zero."""
    shares = np.linspace(0.0, 1.0, 21)
    values = np.array([spread.quantile(exact, 0.7, s) for s in shares])
    assert np.isfinite(values).all()
    assert (np.diff(values) > 0).all()
    assert values[10] == pytest.approx(exact)
    assert (values[0], values[-1]) == spread.interval(exact, 0.7)
    assert [spread.quantile(exact, 0.0, s) for s in (0.0, 0.3, 1.0)] == [exact] * 3


def test_distributions_are_those_of_scipy():
    """Quantiles of the uniform, and of the normal and log-normal cut off at two standard deviations."""
    shares = np.linspace(0.02, 0.98, 15)
    cut = stats.truncnorm(-TAILS, TAILS)
    for spread, known in (
        (fp.Uniform(absolute=0.4), stats.uniform(2.6, 0.8).ppf(shares)),
        (fp.Normal(relative=0.1), 3.0 + 0.3 * cut.ppf(shares)),
        (fp.LogNormal(factor=1.3), 3.0 * np.exp(math.log(1.3) * cut.ppf(shares))),
    ):
        assert [spread.quantile(3.0, 1.0, s) for s in shares] == pytest.approx(known)


def test_the_option_scales_spreads_and_keeps_its_meaning_elsewhere():
    """50 %: half of an absolute width of 4, the square root of a factor at two deviations, and 50 % of what has no spread."""
    parameters = {"a": parameter(300.0, fp.Uniform(absolute=4.0)), "k": parameter(-5.0, fp.LogNormal(factor=1.2))}
    ranges = exact_ranges(plant(**parameters), 50.0)
    assert ranges["a"] == (298.0, 302.0)
    assert ranges["k"] == pytest.approx((-5.0 * 1.2, -5.0 / 1.2))
    assert ranges["b"] == (0.5, 1.5)


def test_the_whole_spread_needs_spreads_everywhere():
    """100 % and more have no meaning for a parameter that could change its sign; with spreads everywhere they have."""
    some = plant(a=parameter(2.0, fp.Uniform(absolute=0.1)))
    with pytest.raises(InvalidValue, match="below 100"):
        exact_ranges(some, 100.0)
    every = fp.Plant(
        {"y": "m"}, {"u": "N"}, {"b": parameter(1.0, fp.Uniform(absolute=0.1))}, lambda q, v, u, p: {"y": p.b * u.u}
    )
    assert exact_ranges(every, 150.0)["b"] == pytest.approx((0.85, 1.15))
    with pytest.raises(InvalidValue, match="at least 0"):
        exact_ranges(every, -1.0)


def test_a_range_beyond_the_bounds_is_refused_with_the_largest_inside():
    """0.5 -+ 0.3 leaves (0.35, 1): half of the spread stays inside."""
    tight = plant(c=parameter(0.5, fp.Uniform(absolute=0.3), bounds=(0.35, 1.0)))
    with pytest.raises(InvalidProblem, match=r"parameter 'c'.*at most 50 % stay inside"):
        exact_ranges(tight, 60.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fp.Uniform(), "absolute=.* or relative="),
        (lambda: fp.Normal(absolute=1.0, relative=0.1), "one positive number"),
        (lambda: fp.Uniform(absolute=-1.0), "one positive number"),
        (lambda: fp.LogNormal(factor=0.9), "a number above 1"),
        (lambda: plant(z=parameter(0.0, fp.Uniform(relative=0.3))), "parameter 'z': spread: it has the value 0"),
        (lambda: plant(z=parameter(0.0, fp.LogNormal(factor=2.0))), "use Uniform or Normal with absolute"),
        (lambda: plant(z=fp.Parameter(1.0, 1.0, "1", spread=0.3)), "expected a Spread or None, got 0.3"),  # type: ignore[arg-type]
    ],
)
def test_wrong_spreads_are_refused(make, message):
    with pytest.raises(fp.FpirhcError, match=message):
        make()


# A mismatch of P percent is the same range of the exact parameters in a review and in a study of scenarios


# The approximate values are the exact ones, so that the box of a review is the range alone; one is negative, one bounded.
VALUES = {"b": 1.6, "k": -5.0, "c": 0.5, "zero": 0.0}
BOUNDS = {"c": (0.3, 1.0)}
EVERYWHERE = (-float("inf"), float("inf"))


@pytest.fixture
def problem() -> fp.Problem:
    """A mass on a line."""
    parameters = {n: fp.Parameter(v, v, "1", BOUNDS.get(n, EVERYWHERE)) for n, v in VALUES.items()}
    plant = fp.Plant(
        {"y": "m"}, {"u": "N"}, parameters, lambda q, v, u, p: {"y": p.b * u.u - p.k * q.y - p.c * v.y + p.zero}
    )
    reference = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    return fp.Problem(plant=plant, reference=reference, start={"y": 0.0}, period=0.01, duration=1.0)


def test_the_range_by_value(problem):
    """20 % of 1.6 is 0.32; a parameter keeps its sign, and zero stays zero."""
    ranges = exact_ranges(problem.plant, 20.0)
    assert ranges["b"] == pytest.approx((1.28, 1.92))
    assert ranges["k"] == pytest.approx((-6.0, -4.0))
    assert ranges["zero"] == (0.0, 0.0)


def test_a_review_refuses_what_scenarios_refuse(problem):
    """The parameter c = 0.5 may shrink by 40 % to its bound of 0.3; both say so in the same words."""
    controllers = {"CTC": fp.ComputedTorque(fp.Exponential(rate=6.0))}
    assert fp.review(problem, controllers, mismatch=39.0, seed=0).mismatch == 39.0
    with pytest.raises(InvalidProblem, match=r"parameter 'c'.*at most 40 % stay inside"):
        fp.review(problem, controllers, mismatch=41.0, seed=0)
    for wrong, words in (
        (100.0, "at least 0 and below 100"),
        (-1.0, "at least 0 and below 100"),
        (math.nan, "a number, got nan"),
    ):
        with pytest.raises(InvalidValue, match=words):
            fp.review(problem, controllers, mismatch=wrong, seed=0)
