"""Horizons of one stage, down to one state and one input: every optimiser finds the optimum, which is a clipped quadratic's."""

from math import factorial

import numpy as np
import pytest

import fpirhc as fp

STEP, WEIGHT = 0.1, 0.1
OPTIMISERS = {
    "fixed point": fp.FixedPoint(iterations=3, tolerance=1e-7),
    "gradient": fp.GradientFixedPoint(iterations=60, tolerance=1e-6),
    "reduced gradient": fp.ReducedGradient(iterations=60, tolerance=1e-6),
    "full space": fp.FullSpaceFixedPoint(iterations=150, tolerance=1e-6, scaled=True),
    "IPOPT": fp.Ipopt(tolerance=1e-5),
    "fatrop": fp.Fatrop(tolerance=1e-5),
    "SQP": fp.SequentialQuadratic(tolerance=1e-5),
}
LIMITS = {
    "none": fp.Limits(),
    "input": fp.Limits(inputs={"u": (-2.0, 0.3)}),
    "state": fp.Limits(inputs={"u": (-2.0, 2.0)}, states={"x": (-1.0, 0.04)}),
}


def problem(limits):
    """X' = -x + u; the next state is to be .5."""
    plant = fp.Plant(
        coordinates={"x": "m"},
        inputs={"u": "m/s"},
        order=1,
        response=lambda q, u, p: {"x": -p.rate * q.x + u.u},
        parameters={"rate": fp.Parameter(1.0, 1.0, "1/s")},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"x": 0.5 + 0 * t}),
        start={"x": 0.0},
        period=STEP,
        duration=5 * STEP,
        limits=limits,
        horizon=fp.Horizon(stages=1, step=STEP),
        cost=fp.Quadratic(states={"x": 1.0}, effort={"u": WEIGHT}, terminal=None),
    )


KEPT = {
    "gradient": ("none", "input"),
    "reduced gradient": ("none", "input"),
    "full space": ("none",),
}  # of the baselines


@pytest.mark.parametrize(("name", "limits"), [(n, k) for n in OPTIMISERS for k in KEPT.get(n, LIMITS)])
def test_a_loop_of_one_stage_plans_the_optimum(name, limits):
    p = problem(LIMITS[limits])
    run = fp.simulate(p, fp.RecedingHorizon(OPTIMISERS[name]), seed=0, compiled=False)
    assert set(fp.measure(p, run).statuses) == {"OK"}
    np.testing.assert_allclose(run["planned"].ravel(), optimum(run["state"].ravel(), p.limits), atol=1e-5)


def optimum(x, limits):
    """Minimiser of .1 u^2 + (F x + G u - .5)^2 with F = exp(-.1) by Runge and Kutta and G = 1 - F, inside the limits."""
    f = sum((-STEP) ** k / factorial(k) for k in range(5))
    g = 1 - f
    best = g * (0.5 - f * x) / (WEIGHT + g**2)
    lower, upper = limits.inputs.get("u", (-np.inf, np.inf))
    most = (limits.states["x"][1] - f * x) / g if limits.states else np.inf
    return np.clip(best, lower, np.minimum(upper, most))
