"""What a mismatch of P percent means, with a spread and without one: studies draw from the range that reviews cover."""

import math
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.tasks import made
from scipy import stats

import fpirhc as fp


def plant(**parameters: fp.Parameter) -> fp.Plant:
    """A mass on a line that ignores its further parameters."""
    return fp.Plant(
        {"y": "m"}, {"u": "N"}, {"b": fp.Parameter(1.0, 1.0, "1/kg"), **parameters}, lambda q, v, u, p: {"y": p.b * u.u}
    )


def parameter(exact: float, spread: Any, **changes) -> fp.Parameter:
    return fp.Parameter(approximate=exact, exact=exact, unit="1", spread=spread, **changes)


def test_distributions_are_those_of_scipy():
    """Quantiles of the uniform, and of the normal and log-normal cut off at two standard deviations."""
    shares, cut = np.linspace(0.02, 0.98, 15), stats.truncnorm(-2.0, 2.0)
    for spread, known in (
        (fp.Uniform(absolute=0.4), stats.uniform(2.6, 0.8).ppf(shares)),
        (fp.Normal(absolute=0.3), 3.0 + 0.3 * cut.ppf(shares)),
        (fp.LogNormal(factor=1.3), 3.0 * np.exp(math.log(1.3) * cut.ppf(shares))),
    ):
        assert [spread.quantile(3.0, 1.0, s) for s in shares] == pytest.approx(known)


def drawn(one: fp.Plant, percent: float) -> np.ndarray:
    """Exact parameters of 200 plants that a study draws, shape (200, parameters)."""
    reference = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    problem = fp.Problem(plant=one, reference=reference, start={"y": 0.0}, period=0.01, duration=1.0)
    task = made(problem, {"CTC": fp.ComputedTorque(fp.Exponential(rate=6.0))})
    return np.array([v.problem.real_plant.exact for v in fp.Draws(200, percent, 1).of(task)])


def fills(values: np.ndarray, low: float, high: float) -> bool:
    """Whether the values stay within an interval and come near both of its ends."""
    near = 0.1 * (high - low)
    return bool(low <= values.min() <= low + near and high - near <= values.max() <= high)


def test_the_option_scales_spreads_and_keeps_its_meaning_elsewhere():
    """50 %: half of an absolute width of 4, the square root of a factor at two deviations, and 50 % of what has no spread."""
    zero = fp.Parameter(0.0, 0.0, "1")
    parameters = {
        "a": parameter(300.0, fp.Uniform(absolute=4.0)),
        "k": parameter(-5.0, fp.LogNormal(factor=1.2)),
        "zero": zero,
    }
    b, a, k, none = drawn(plant(**parameters), 50.0).T
    assert fills(b, 0.5, 1.5)
    assert fills(a, 298.0, 302.0)
    assert fills(k, -5.0 * 1.2, -5.0 / 1.2)
    assert not none.any()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fp.Uniform(absolute=-1.0), "absolute: expected a finite number above 0, got -1.0"),
        (lambda: fp.LogNormal(factor=0.9), "a number above 1"),
        (
            lambda: plant(z=parameter(0.0, fp.LogNormal(factor=2.0))),
            "parameter 'z': spread: it has the value 0.*use Uniform or Normal",
        ),
        (lambda: plant(z=fp.Parameter(1.0, 1.0, "1", spread=0.3)), "expected a Spread or None, got 0.3"),  # type: ignore[arg-type]
        # 100 % has no meaning for a parameter that could change its sign; with spreads everywhere it has.
        (lambda: drawn(plant(a=parameter(2.0, fp.Uniform(absolute=0.1))), 100.0), "less than 100"),
        (lambda: drawn(plant(), -1.0), "at least 0"),
        # 0.5 -+ 0.3 leaves (0.35, 1): half of the spread stays inside.
        (
            lambda: drawn(plant(c=parameter(0.5, fp.Uniform(absolute=0.3), bounds=(0.35, 1.0))), 60.0),
            r"parameter 'c'.*at most 50 % stay inside",
        ),
    ],
)
def test_wrong_spreads_are_refused(make, message):
    with pytest.raises(fp.FpirhcError, match=message):
        make()
