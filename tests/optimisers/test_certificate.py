"""Certificates: the predicted contraction is the measured one, and no bound is ever below the true error."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.horizons import SWING, linear_problem, pendulum_problem, repeated, rolled
from helpers.kinds import slow_but

import fpirhc as fp
from fpirhc.conformance import posed

PROBLEMS = ("two_mass", "van_der_pol", "cart_pole", "two_link_arm", "chain_of_masses")


def iterates(ocp, data, first, count):
    """Plans after 1, 2, ... iterations from rest."""
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-13)
    best = fp.solve(ocp, replace(optimiser, tolerance=1e-9), first, data)
    for inputs, numbers in repeated(optimiser, ocp, data, first, count):
        yield replace(best, inputs=inputs, states=best.states, cost=float(numbers[0])), best


@pytest.mark.parametrize("name", slow_but(PROBLEMS, "two_mass", "cart_pole"))
def test_no_bound_is_below_the_true_error(name):
    """On early and late iterates of every shipped problem: distance to the optimum, error of any input, and suboptimality."""
    ocp, first, data = posed(fp.load_problem(name).problem)
    counted = 0
    for k, (plan, best) in enumerate(iterates(ocp, data, first, 14)):
        if k not in {0, 1, 2, 3, 5, 8, 13}:
            continue
        plan = replace(plan, states=rolled(ocp, first, plan.inputs, data).states)
        certificate = fp.certify(plan)
        if not np.isfinite(certificate.input_error):
            continue
        counted += 1
        slack = 1e-7 * (1 + np.abs(best.inputs).max())
        assert np.abs(plan.inputs - best.inputs).max() <= certificate.input_error + slack
        assert plan.cost - best.cost <= certificate.suboptimality + 1e-11 * (1 + abs(best.cost))
    assert counted >= 2


def test_factor_on_a_linear_quadratic_problem_is_zero():
    """The model is exact there, so one step is the optimum and the bound says so."""
    ocp, data, first = linear_problem()
    plan = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-6), first, data)
    certificate = fp.certify(plan)
    assert certificate.factor < 1e-8
    assert certificate.curvature == pytest.approx(1.0)


def test_factor_is_the_rate_of_the_iteration():
    """Errors in the M-norm shrink by K near the optimum."""
    ocp, data = pendulum_problem(SWING, horizon=fp.Horizon(stages=15, step=0.1))
    first = np.array([2.5, 0.0])
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-12)
    best = fp.solve(ocp, optimiser, first, data)
    plans = repeated(optimiser, ocp, data, first, 7, best.inputs + 1e-3)
    distances = [np.linalg.norm(inputs - best.inputs) for inputs, _ in plans]
    assert distances[-1] / distances[-2] == pytest.approx(fp.certify(best).factor, abs=0.01)


def test_bounds_hold_with_active_limits_of_states():
    """On plans near the optimum on a limit of the speed: no bound is below the true error; the limits are counted and priced."""
    limits = fp.Limits(inputs={"torque": (-8.0, 8.0)}, states={"angle'": (-0.3, 0.6)})
    ocp, data = pendulum_problem(limits=limits)
    first = np.array([0.6, 0.0])
    best = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-9), first, data)
    exact = fp.certify(best)
    assert exact.active == np.count_nonzero(best.state_multipliers) > 3
    assert exact.free == best.inputs.size - exact.active
    assert exact.factor < 1
    assert exact.input_error < 1e-6
    assert exact.complementarity < 1e-6
    rough = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-3), first, data)
    for plan in (rough, fp.solve(ocp, fp.Ipopt(accuracy=1e-5), first, data)):
        certificate = fp.certify(plan)
        assert np.abs(plan.inputs - best.inputs).max() <= certificate.input_error + 1e-8


def test_violated_limits_are_named_in_the_certificate():
    """A horizon that no input can keep: the limit, its stage, and by how much."""
    limits = fp.Limits(inputs={"torque": (-0.1, 0.1)}, states={"angle": (0.9, 1.0)})
    ocp, data = pendulum_problem(limits=limits)
    plan = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-6), np.array([0.6, 0.0]), data)
    assert plan.status == fp.Status.INFEASIBLE
    assert "below 0.9, at stage" in fp.certify(plan).broken[1]
