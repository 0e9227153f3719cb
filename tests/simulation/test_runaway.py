"""Runs that say what is the matter with them: a loop that runs away, and plans that did not converge."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.plants import heavy

import fpirhc as fp


def late_mass(late: float, amplitude: float = 0.2) -> fp.Problem:
    """A mass without limits behind a dead time that its law does not know."""
    return fp.Problem(
        heavy(1.0, 1.0, u="F"),
        fp.Trajectory(lambda t: {"q": amplitude + 0 * t}),
        start={"q": 0.0},
        period=0.01,
        duration=60.0,
        dead_time=fp.DeadTime(inputs={"F": late}),
    )


def test_a_loop_that_runs_away_stops_where_its_error_is_a_million_times_the_reference() -> None:
    run = fp.simulate(late_mass(0.5), fp.ComputedTorque(fp.Exponential(rate=6.0)), seed=0, compiled=False)
    assert run.stop is not None
    said = re.search(
        r"the error of 'q' is (\S+) m, more than a million times the 0\.2 m of its reference and start", run.stop
    )
    assert said is not None
    assert abs(float(said.group(1))) == pytest.approx(2e5, rel=0.5)
    errors = np.abs(run["error"])
    assert errors.max() <= 2e5
    assert run.cycles < late_mass(0.5).cycles


def test_a_reference_of_zero_has_no_million_times() -> None:
    """Nothing is known of sizes there, so nothing is judged."""
    run = fp.simulate(late_mass(0.0, 0.0), fp.ComputedTorque(fp.Exponential(rate=6.0)), seed=0, compiled=False)
    assert run.stop is None


def test_large_errors_that_are_no_million_times_do_not_stop_a_run() -> None:
    """The same loop ends before its error is large enough."""
    short = replace(late_mass(0.5), duration=3.0)
    run = fp.simulate(short, fp.ComputedTorque(fp.Exponential(rate=6.0)), seed=0, compiled=False)
    assert run.stop is None
    assert np.abs(run["error"]).max() > 1.0


# Runs whose plans did not converge say that they depend on rounding


def test_a_run_of_converged_plans_says_nothing():
    p = fp.load_problem("van_der_pol").problem
    p = replace(p, duration=0.4, measure_from=0.0)
    run = fp.simulate(p, fp.RecedingHorizon(fp.FixedPoint(iterations=5, tolerance=1e-2)), seed=0, compiled=False)
    assert run.depends_on_rounding == ""
    assert "rounding" not in repr(run)
