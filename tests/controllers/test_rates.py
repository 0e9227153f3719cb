"""Limits of rates are kept in the command of every controller, as limits of inputs are."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp

FASTEST = 20.0  # N/s
PROBLEM = fp.Problem(
    plant=fp.Plant(
        coordinates={"x": "m"},
        inputs={"F": "N"},
        order=2,
        response=lambda q, v, u, p: {"x": u.F / p.mass},
        parameters={"mass": fp.Parameter(1.0, 2.0, "kg")},
    ),
    reference=fp.Trajectory(lambda t: {"x": 1 - ca.cos(2 * t)}),
    start={"x": 0.5},
    period=0.01,
    duration=3.0,
    measure_from=1.0,
    limits=fp.Limits(inputs={"F": (-20.0, 20.0)}, rates={"F": (-FASTEST, FASTEST)}),
    horizon=fp.Horizon(stages=20, step=0.05),
    cost=fp.Quadratic(states={"x": 100.0, "x'": 1.0}, rate={"F": 1e-3}),
)
LAW = fp.Exponential(rate=5.0)
CONTROLLERS = {
    "RHC": fp.RecedingHorizon(fp.FixedPointSolver()),
    "RHC+FPI": fp.RecedingHorizon(fp.FixedPointSolver(), fp.ModelReferenced(fp.Affine(gain=-0.8))),
    "CTC+FPI": fp.ComputedTorque(LAW, fp.Affine(gain=-0.5)),
    "PID": fp.PID({"x": 50.0}, {"x": 40.0}, {"x": 14.0}),
    "ADRC": fp.rivals.ADRC(5.0, observer=50.0),
}


def fastest(run: fp.Run) -> float:
    """The fastest change of the command, in shares of the limit; the first one is from the input before the run."""
    sent = np.concatenate([[0.0], np.ravel(run["command"])])
    return float(np.abs(np.diff(sent)).max() / (PROBLEM.period * FASTEST))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_no_command_moves_faster_than_its_limit(name):
    """With an actuator that is no faster a plant twice as heavy is another task: the run says so, and at_limit counts it."""
    free = replace(PROBLEM, limits=replace(PROBLEM.limits, rates={}))
    run, faster = (fp.simulate(p, CONTROLLERS[name], seed=0, compiled=False) for p in (PROBLEM, free))
    assert fastest(faster) > 1.5
    assert fastest(run) <= 1 + 1e-9
    assert fp.measure(PROBLEM, run)["at_limit"][""] > 0.01


def test_a_rate_that_has_a_price_may_be_passed():
    soft = replace(PROBLEM, limits=replace(PROBLEM.limits, prices={"F": 1e-3}))
    assert fastest(fp.simulate(soft, CONTROLLERS["CTC+FPI"], seed=0, compiled=False)) > 1.5


def test_what_is_left_of_a_command_is_what_the_iteration_is_told():
    """A request that the rate cuts off does not wind the iteration up: where the motion is slow enough it comes back."""
    slow = replace(
        PROBLEM, reference=fp.Trajectory(lambda t: {"x": 0.5 + 0.2 * ca.sin(t)}), start={"x": 0.3}, duration=12.0
    )
    run = fp.simulate(slow, CONTROLLERS["CTC+FPI"], seed=0, compiled=False)
    assert fastest(run) <= 1 + 1e-9
    assert np.abs(np.asarray(run["true_error"])[-300:]).max() < 2e-2
