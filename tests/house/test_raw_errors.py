"""Calls with values that nobody expected raise an error of the library, which says what is wrong, and no raw one."""

from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.errors import InvalidField, InvalidName

brief = cache(lambda: replace(tasks.two_mass.problem, duration=0.02, measure_from=0.0))
adaptive = cache(lambda: tasks.two_mass.controllers["CTC+FPI (eq 6)"])
HUGE = 10**400  # a whole number that is no float


@pytest.fixture(scope="module")
def run():
    """A short run."""
    return fp.simulate(brief(), adaptive(), seed=0, compiled=False)


@pytest.mark.parametrize("name", [0, None, 1.5, ["error"], slice(0, 2), np.array([1]), ("error", "q1"), "eror"])
def test_signals_and_metrics_are_found_by_names(name, run):
    """A number, a list or a range of rows is told as an unknown name is."""
    metrics = fp.measure(brief(), run)
    steps: list[Any] = [run.__getitem__, run.unit, run.layout.__getitem__, run.layout.slice, metrics.__getitem__]
    for find in steps:
        with pytest.raises(InvalidName, match="Valid: "):
            find(name)
    assert name not in run.layout


def test_the_rows_of_a_run_are_offered(run):
    """Who wants a cycle by its number is told where it is; a near name is offered."""
    with pytest.raises(InvalidName, match=r"run\.log has its cycles by number"):
        run[0]
    with pytest.raises(InvalidName, match=r"Did you mean 'error'\?"):
        run["eror"]


def pendulum(value):
    """A pendulum whose mass has this value in model and plant."""
    return fp.Plant(
        coordinates={"angle": "rad"},
        inputs={"torque": "N m"},
        order=2,
        response=lambda q, v, u, p: {"angle": u.torque / p.mass - 9.81 * ca.sin(q.angle)},
        parameters={"mass": fp.Parameter(approximate=value, exact=value, unit="kg")},
    )


@pytest.mark.parametrize("value", [HUGE, np.timedelta64(1, "s"), np.bool_(True), "1", None, 1j])
def test_what_is_no_number_is_no_parameter(value):
    with pytest.raises(InvalidField, match=r"(?s)approximate: expected a finite number.*exact: expected"):
        pendulum(value)


FILTERS = [
    lambda d: fp.KalmanFilter(measured={"angle": d}, noise={"angle": 1.0}),
    lambda d: fp.KalmanFilter(measured={"angle": 1.0}, noise={"angle": d}),
    lambda d: fp.KalmanFilter(measured={"angle": 1.0}, noise={"angle": 1.0}, start={"angle": d}),
    lambda d: fp.DisturbanceKalman(drift={"angle": d}, measured={"angle": 1.0}),
    lambda d: fp.DisturbanceKalman(drift={"angle": 1.0}, measured={"angle": d}),
    lambda d: fp.RecursiveLeastSquares({"mass": fp.Uncertain(1.0, 3.0, 0.1)}, {"angle": d}, time=1.0),
    lambda d: fp.Uncertain(1.0, 3.0, d),
]


@pytest.mark.parametrize("make", FILTERS, ids=range(len(FILTERS)))
@pytest.mark.parametrize("deviation", [1e200, 1e-200, 0.0, -1.0, float("inf"), HUGE])
def test_deviations_whose_square_is_no_number_are_refused(make, deviation):
    """Filters are made of variances: 1e200 squared overflows, 1e-200 squared is zero."""
    make(0.5)
    with pytest.raises(InvalidField, match="expected a positive number from 1e-100 to 1e100"):
        make(deviation)


def test_names_of_the_inner_modules_are_offered_as_those_of_the_package():
    """A misspelt rival or figure has the error of a misspelt name of the package; tools may ask for private names."""
    for module, name, meant in ((fp.rivals, "SldingMode", "SlidingMode"), (fp.figures, "overshot", "Overshoot")):
        with pytest.raises(InvalidName, match=f"Did you mean '{meant}'"):
            getattr(module, name)
        assert not hasattr(module, "_no_such_name")
