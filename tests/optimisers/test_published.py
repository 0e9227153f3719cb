"""The published fixed-point optimiser and its reduced form: what they promise, and why the default is another one."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import horizon_of, linear_problem, pendulum_problem, repeated

import fpirhc as fp
from fpirhc.contracts import reduced_gradient
from fpirhc.errors import NotContractive, NotSupported

FIRST = np.array([0.5, -0.5])


@pytest.mark.parametrize("high", [100.0, 1.0])
def test_the_reduced_form_finds_the_same_optimum(high):
    """Slower than the default, and the same plan, bounds active or not."""
    ocp, data = pendulum_problem(limits=fp.Limits(inputs={"torque": (-high, high)}))
    plan = fp.solve(ocp, fp.GradientFixedPoint(iterations=400, tolerance=1e-7), FIRST, data)
    best = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-8), FIRST, data)
    assert plan.status == fp.Status.OK
    np.testing.assert_allclose(plan.inputs, best.inputs, atol=1e-5)


@pytest.mark.parametrize("scaled", [False, True])
def test_the_full_space_form_finds_the_optimum_of_a_small_problem(scaled):
    """States, inputs and multipliers together end at IPOPT's plan, costs of the last state included."""
    plant = fp.Plant({"y": "m"}, {"u": "m/s"}, {}, lambda q, u, p: {"y": u.u - 0.5 * q.y - 0.2 * q.y**3}, order=1)
    cost = fp.Quadratic(states={"y": 1.0}, effort={"u": 1.0}, terminal={"y": 2.0})
    sine = fp.Trajectory(lambda t: {"y": 0.3 * ca.sin(t)})
    ocp, data = horizon_of(plant, sine, fp.Horizon(stages=3, step=0.5), cost)
    plan = fp.solve(ocp, fp.FullSpaceFixedPoint(iterations=3000, tolerance=1e-7, scaled=scaled), FIRST[:1], data)
    np.testing.assert_allclose(plan.inputs, fp.solve(ocp, fp.Ipopt(accuracy=1e-10), FIRST[:1], data).inputs, atol=1e-6)


def test_rate_of_the_reduced_form():
    """On a linear-quadratic problem errors shrink by the largest |1 - a eig(D V'')|."""
    ocp, data, first = linear_problem()
    inputs = ca.MX.sym("U", 1, ocp.stages)
    slope = reduced_gradient(ocp)(first, inputs, data, np.zeros((2, ocp.stages)))[1]
    hessian = ca.Function("h", [inputs], [ca.jacobian(ca.vec(slope), ca.vec(inputs))])(np.zeros((1, 10))).full()
    values = float(1 / (ocp.step * ocp.curvature[0])) * np.linalg.eigvalsh(hessian)
    gain = 2 / (values.min() + values.max())
    predicted = np.abs(1 - gain * values).max()
    optimiser = fp.GradientFixedPoint(iterations=1, tolerance=1e-12, map=fp.Affine(gain=-2 * gain))
    assert rate(optimiser, ocp, data, first) == pytest.approx(predicted, abs=1e-3)
    replace(optimiser, map=fp.Affine(gain=-3.6 / values.max())).check(ocp)
    with pytest.raises(NotContractive):
        replace(optimiser, map=fp.Affine(gain=-4.0 / values.max())).check(ocp)


def rate(optimiser, ocp, data, first, iterations=25):
    best = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-11), first, data).inputs
    distances = [np.linalg.norm(plan - best) for plan, _ in repeated(optimiser, ocp, data, first, iterations)]
    return (distances[-1] / distances[-11]) ** 0.1


@pytest.mark.parametrize("kind", [fp.FullSpaceFixedPoint, fp.GradientFixedPoint])
def test_a_call_goes_on_where_the_one_before_ended(kind):
    """Two calls are one with twice the iterations, however small the states are."""
    (*_, two), (one,) = (repeated(kind(k, 1e-6), *pendulum_problem(), FIRST / 10, 40 // k) for k in (20, 40))
    np.testing.assert_array_equal(two[0], one[0])


def test_the_baseline_is_orders_of_magnitude_slower_and_scaling_helps():
    """After the same 2000 iterations: plain, scaled; the default needs seven."""
    ocp, data = pendulum_problem()
    kinds = [fp.FullSpaceFixedPoint(iterations=2000, tolerance=1e-6, scaled=scaled) for scaled in (False, True)]
    left = [fp.solve(ocp, one, FIRST, data, calls=1).stationarity or 0.0 for one in kinds]
    assert left[0] > left[1] > 1e-6
    assert fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-6), FIRST, data).iterations < 10


def test_what_the_baselines_do_not_serve_is_refused():
    """Each says who can."""
    ocp, data = pendulum_problem(limits=fp.Limits(inputs={"torque": (-1.0, 1.0)}))
    with pytest.raises(NotSupported, match="for limits use FixedPointSolver"):
        fp.solve(ocp, fp.FullSpaceFixedPoint(iterations=1, tolerance=1e-6), FIRST, data)
    ocp, data = pendulum_problem(limits=fp.Limits(states={"angle": (-1.0, 1.0)}))
    with pytest.raises(NotSupported, match="FixedPointSolver"):
        fp.solve(ocp, fp.GradientFixedPoint(iterations=1, tolerance=1e-6), FIRST, data)
    ocp, data = pendulum_problem()
    with pytest.raises(NotContractive, match="outside"):
        fp.solve(ocp, fp.FullSpaceFixedPoint(iterations=1, tolerance=1e-6, map=fp.Affine(gain=-1.0)), FIRST, data)
