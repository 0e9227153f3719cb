"""A problem with other exact parameters is the one that is built anew with them, whatever of the first one it shares."""

from dataclasses import replace

import numpy as np
import pytest

import fpirhc as fp

LOOPS = {"two_mass": "RHC+FPI", "tumour": "RHC+FPI", "crane_slots": "slots+FPI"}


@pytest.mark.parametrize("name", LOOPS)
def test_a_run_of_what_is_shared_is_that_of_the_problem_that_is_built_anew(name):
    """Of the plant that moves and of the model that becomes it, after the first problem has run."""
    task = fp.load_problem(name)
    problem = replace(task.problem.of_model, duration=15 * task.problem.period, measure_from=0.0)
    plain, known = task.controllers[LOOPS[name]], fp.ExactModel(task.controllers[LOOPS[name]])
    first = fp.simulate(problem, plain, seed=0, compiled=False)
    exact = problem.plant.exact * 1.05
    values = zip(problem.plant.parameters.items(), exact, strict=True)
    anew = replace(
        problem, plant=replace(problem.plant, parameters={n: replace(p, exact=float(v)) for (n, p), v in values})
    )
    for controller in (plain, known):
        one, other = (fp.simulate(p, controller, seed=0, compiled=False) for p in (problem.with_exact(exact), anew))
        np.testing.assert_array_equal(one.log, other.log)
        assert not np.array_equal(one["plant_state"], first["plant_state"])
    np.testing.assert_array_equal(fp.simulate(problem, plain, seed=0, compiled=False).log, first.log)
