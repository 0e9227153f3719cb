"""The published fixed-point optimiser and its reduced form: what they promise, and why the default is another one."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from test_fixed_point import linear_problem, pendulum_problem

import fpirhc as fp
from fpirhc.contracts import reduced_gradient
from fpirhc.errors import NotContractive, NotSupported
from fpirhc.horizon.problem import steepest_curvature
from fpirhc.optimisers.full_space import auxiliary_hessian

FIRST = np.array([0.5, -0.5])


@pytest.mark.parametrize("high", [100.0, 1.0])
def test_the_reduced_form_finds_the_same_optimum(high):
    """Slower than the default, and the same plan, bounds active or not."""
    ocp, data = pendulum_problem(limits=fp.Limits(inputs={"torque": (-high, high)}))
    slow = fp.GradientFixedPoint(iterations=400, tolerance=1e-7)
    plan = fp.solve(ocp, slow, FIRST, data)
    best = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=1e-8), FIRST, data)
    assert plan.status == fp.Status.OK
    np.testing.assert_allclose(plan.inputs, best.inputs, atol=1e-5)


def test_maps_of_the_control_loop_serve_the_optimiser():
    """Eq. (6) with the gain inside its sector converges; outside it is refused with the gain that would do."""
    ocp, data = pendulum_problem()
    gain = 0.5 * 2 / steepest_curvature(ocp.along, 1 / (ocp.step * ocp.curvature))
    sigmoid = fp.Sigmoid(gain=-1.0, scale=50.0).with_effective_gain(0.9 * gain)
    plan = fp.solve(ocp, fp.GradientFixedPoint(iterations=800, tolerance=1e-6, map=sigmoid), FIRST, data)
    assert plan.status == fp.Status.OK
    with pytest.raises(NotContractive, match="with_effective_gain"):
        fp.solve(ocp, fp.GradientFixedPoint(iterations=1, tolerance=1e-6, map=fp.Affine(gain=-20 * gain)), FIRST, data)
    with pytest.raises(NotContractive):
        fp.solve(ocp, fp.GradientFixedPoint(iterations=1, tolerance=1e-6, map=fp.Affine(gain=0.1 * gain)), FIRST, data)


def test_rate_of_the_reduced_form():
    """On a linear-quadratic problem errors shrink by the largest |1 - a eig(D V'')|."""
    ocp, data, first = linear_problem()
    scale = float(1 / (ocp.step * ocp.curvature[0]))
    inputs = ca.MX.sym("U", 1, ocp.stages)
    slope = reduced_gradient(ocp)(first, inputs, data, np.zeros((2, ocp.stages)))[1]
    hessian = ca.Function("h", [inputs], [ca.jacobian(ca.vec(slope), ca.vec(inputs))])(np.zeros((1, 10))).full()
    values = scale * np.linalg.eigvalsh(hessian)
    gain = 2 / (values.min() + values.max())
    predicted = np.abs(1 - gain * values).max()
    optimiser = fp.GradientFixedPoint(iterations=1, tolerance=1e-12, map=fp.Affine(gain=-2 * gain))
    assert rate(optimiser, ocp, data, first) == pytest.approx(predicted, abs=1e-3)


def rate(optimiser, ocp, data, first, iterations=25):
    best = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=1e-11), first, data).inputs
    step, memory = optimiser.step(ocp), optimiser.memory(ocp).start()
    distances = []
    for _ in range(iterations):
        inputs, _, memory = step(first, data, ocp.input_lower, ocp.input_upper, memory)
        distances.append(np.linalg.norm(inputs.full() - best))
    return (distances[-1] / distances[-11]) ** 0.1


def test_rate_of_the_full_space_form_is_set_by_the_condition_number_squared():
    """(kappa^2 - 1)/(kappa^2 + 1), measured on a linear-quadratic problem of three stages."""
    ocp, data, first = linear_problem()
    ocp, data = replace(ocp, stages=3, nodes=short(ocp.nodes)), data[:, :4]
    states, inputs, values = ocp.nodes
    hessian = auxiliary_hessian(ocp)(states[:, 1:], inputs, np.zeros((2, 3)), states[:, 0], values).full()
    singular = np.abs(np.linalg.eigvalsh(hessian))
    squared = (singular.max() / singular.min()) ** 2
    gain = 2 / (singular.min() ** 2 + singular.max() ** 2)
    optimiser = fp.FullSpaceFixedPoint(iterations=int(squared / 2), tolerance=1e-12, map=fp.Affine(gain=-2 * gain))
    measured = rate(optimiser, ocp, data, first, iterations=12) ** (1 / optimiser.iterations)
    slowest = (squared - 1) / (squared + 1)
    assert slowest == pytest.approx(1 - gain * singular.min() ** 2)
    # The error lies mostly along the three slowest directions, which are 8 % apart.
    third = 1 - gain * np.sort(singular)[2] ** 2
    assert third - 1e-6 <= measured <= slowest + 1e-6


def short(nodes):
    states, inputs, data = nodes
    return states[:, :4], inputs[:, :3], data[:, :4]


def test_the_baseline_is_orders_of_magnitude_slower_and_scaling_helps():
    """After the same 2000 iterations: plain, scaled; the default needs seven."""
    ocp, data = pendulum_problem()
    left = []
    for settings in ({}, {"scaled": True}):
        optimiser = fp.FullSpaceFixedPoint(iterations=2000, tolerance=1e-6, **settings)
        left.append(fp.solve(ocp, optimiser, FIRST, data, calls=1).stationarity or 0.0)
    assert left[0] > left[1] > 1e-6
    assert fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=1e-6), FIRST, data).iterations < 10


def test_what_the_baselines_do_not_serve_is_refused():
    """Each says who can."""
    ocp, data = pendulum_problem(limits=fp.Limits(inputs={"torque": (-1.0, 1.0)}))
    with pytest.raises(NotSupported, match="for limits use FixedPoint"):
        fp.solve(ocp, fp.FullSpaceFixedPoint(iterations=1, tolerance=1e-6), FIRST, data)
    ocp, data = pendulum_problem(limits=fp.Limits(states={"angle": (-1.0, 1.0)}))
    with pytest.raises(NotSupported, match="FixedPoint"):
        fp.solve(ocp, fp.GradientFixedPoint(iterations=1, tolerance=1e-6), FIRST, data)
    ocp, data = pendulum_problem()
    with pytest.raises(NotContractive, match="outside"):
        fp.solve(ocp, fp.FullSpaceFixedPoint(iterations=1, tolerance=1e-6, map=fp.Affine(gain=-1.0)), FIRST, data)


@pytest.mark.parametrize("kind", [fp.GradientFixedPoint, fp.FullSpaceFixedPoint])
def test_settings_are_checked(kind):
    for settings in ({"iterations": 0, "tolerance": 1.0}, {"iterations": 1, "tolerance": -1.0}):
        with pytest.raises(ValueError, match=r"expected a whole number from 1|expected a finite number above 0"):
            kind(**settings)


@pytest.mark.parametrize("kind", [fp.GradientFixedPoint, fp.FullSpaceFixedPoint])
def test_poison_is_told_and_forgotten(kind):
    """NaN in the memory or the data: never in the plan; then the good problem improves again."""
    ocp, data = pendulum_problem()
    optimiser = kind(iterations=50, tolerance=1e-6)
    memory, step = np.full(optimiser.memory(ocp).size, np.nan), optimiser.step(ocp)
    bounds = (ocp.input_lower, ocp.input_upper)
    inputs, diagnostics, memory = step(FIRST, data * np.nan, *bounds, memory)
    assert int(diagnostics[4]) == fp.Status.NON_FINITE
    assert np.isfinite(inputs.full()).all()
    for _ in range(3):
        _, diagnostics, memory = step(FIRST, data, *bounds, memory)
    assert int(diagnostics[4]) in (fp.Status.OK, fp.Status.NOT_CONVERGED)
    assert np.isfinite(memory.full()).all()
