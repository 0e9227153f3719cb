"""Physical ranges of states: a run ends by name where its plant leaves one."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from test_foreign import MEASURES, Wrapped
from test_reality import lagged, run, task

import fpirhc as fp
from fpirhc.describe import describe
from fpirhc.errors import InvalidProblem


def tank(**ranges) -> fp.Plant:
    """A tank with a leak; its level is in m."""
    return fp.Plant(
        {"level": "m"},
        {"pump": "m^3/s"},
        {"leak": fp.Parameter(0.1, 0.2, "m^2/s")},
        lambda q, u, p: {"level": u.pump - p.leak * q.level},
        order=1,
        ranges=ranges,
    )


def emptying(plant: fp.Plant, cycles: int = 1000) -> fp.Problem:
    """A tank that is asked to go below its floor: level = 0.2 - t."""
    reference = fp.Trajectory(lambda t: {"level": 0.2 - t + 0 * ca.sin(t)})
    return fp.Problem(plant, reference, {"level": 0.2}, 1e-3, cycles * 1e-3)


def test_run_ends_where_the_level_is_below_zero():
    """The run without the range is the same up to the last cycle with a level of at least zero, and the reason names it."""
    free, checked = run(emptying(tank())), run(emptying(tank(level=(0.0, np.inf))))
    first = int(np.argmax(free["state.level"] < 0))
    assert 100 < first < 500
    assert checked.cycles == first
    assert np.array_equal(checked["state.level"], free["state.level"][:first])
    assert checked.stop is not None
    assert checked.stop.startswith("state 'level' is -")
    assert f"outside its physical range of 0 to inf m at t = {first * 1e-3:g} s (cycle {first})" in checked.stop
    assert free.stop is None


def test_range_in_a_later_chunk_of_cycles():
    """Cycles are computed 500 at a time; a range that is left in the second chunk ends the run at its own cycle."""
    free, checked = run(emptying(tank())), run(emptying(tank(level=(-0.5, 1.0))))
    first = int(np.argmax(free["state.level"] < -0.5))
    assert first > 500
    assert checked.cycles == first


def test_state_of_a_reality_and_of_a_body_outside():
    """The state that counts is that of what moves: the reality's force, the measured coordinate of an object."""
    real = fp.Reality(replace(lagged(), ranges={"F": (-5.0, 0.5)}), start={"F": 0.0})
    result = run(task(reality=real))
    assert "state 'F' is " in str(result.stop)
    assert np.all(result["reality_state.F"] <= 0.5)
    problem = task(plant=replace(task().plant, ranges={"y'": (-1.0, 1.0)}))
    outside = run(replace(problem, reality=fp.ExternalPlant(Wrapped(problem), MEASURES)))
    assert outside.stop == run(problem).stop
    assert '"y\'"' in str(outside.stop) or "y'" in str(outside.stop)


def test_noisy_sensor_does_not_end_a_run():
    """The range is that of the level and not of its measurement."""
    noisy = fp.Sensing(sensors={"level": fp.Sensor(noise=fp.Noise(0.5))})
    reference = fp.Trajectory(lambda t: {"level": 0.2 + 0 * t})
    calm = replace(emptying(tank(level=(0.0, 1.0)), 200), reference=reference, sensing=noisy)
    result = run(calm, fp.ComputedTorque(fp.Exponential(rate=1.0)))
    assert result["state.level"].min() < 0
    assert result.stop is None


def test_mistakes_are_named():
    with pytest.raises(InvalidProblem, match="Did you mean 'level'"):
        tank(levels=(0.0, 1.0))
    with pytest.raises(InvalidProblem, match=r"\(lowest, highest\), got \(1.0, 0.0\)"):
        tank(level=(1.0, 0.0))
    with pytest.raises(InvalidProblem, match=r"'level' is 0\.2, outside its physical range of 0.5 to 1"):
        emptying(tank(level=(0.5, 1.0)))
    assert "ranges" not in describe(tank())
