"""A run of a variant is a run of the problem that is built with it, also where plans know the exact parameters."""

from dataclasses import replace

import numpy as np
import pytest

import fpirhc as fp


@pytest.mark.parametrize(
    ("name", "iterations"), [("two_mass", None), ("cart_pole", None), ("two_link_arm", None), ("cart_pole", 5)]
)
def test_plans_with_the_exact_model_begin_with_the_parameters_of_their_run(name, iterations):
    """The first plan too: to the tolerance of plans that are solved, to the bit with five iterations, statuses equal."""
    task = fp.load_problem(name)
    problem = replace(task.problem, duration=50 * task.problem.period, measure_from=0.0)
    controller = fp.ExactModel(replace(task.controllers["RHC"], optimiser=fp.FixedPointSolver(iterations)))
    built, random = fp.simulator(problem, controller, compiled=False), np.random.default_rng(0)
    exact, close = np.ravel(problem.plant.exact), 0 if iterations else 1e-4
    tolerance = close * np.ptp(problem.limits.input_bounds(problem.plant)) / 2
    for factor in random.uniform(0.8, 1.25, (2, exact.size)):
        variant = problem.with_exact(exact * factor)
        one, other = built.run(variant=variant, seed=0), fp.simulate(variant, controller, seed=0, compiled=False)
        np.testing.assert_allclose(one["command"][0], other["command"][0], rtol=0, atol=1e-6 * tolerance)
        np.testing.assert_allclose(one["command"], other["command"], rtol=0, atol=tolerance)
        np.testing.assert_array_equal(one["status"], other["status"])
