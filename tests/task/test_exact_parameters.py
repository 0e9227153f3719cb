"""A problem with other exact parameters is the one that is built anew with them, whatever of the first one it shares."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest

import fpirhc as fp
from fpirhc import Problem, Reality
from fpirhc.describe import describe
from fpirhc.errors import InvalidProblem
from fpirhc.plant.motion import with_exact_parameters

CACHED = sorted(name for name, one in vars(Problem).items() if isinstance(one, cached_property))
NAMES = ["two_mass", "tumour", "freeway", "crane_slots", "heat_exchanger"]


def said(problem: Problem, name: str) -> object:
    """A cached property as something that can be compared."""
    value = getattr(problem, name)
    if isinstance(value, Reality | Problem):
        return describe(value)
    return np.asarray(value(0.3)[0].full()).tolist() if callable(value) else np.asarray(value).tolist()


@pytest.mark.parametrize("name", NAMES)
def test_what_is_shared_does_not_depend_on_the_exact_parameters(name):
    """Every cached property, computed for the first problem before, has the value of the problem that is built anew."""
    problem = fp.load_problem(name).problem.of_model
    for one in CACHED:
        getattr(problem, one)
    exact = problem.plant.exact * 1.01
    shared = problem.with_exact(exact)
    anew = replace(problem, plant=with_exact_parameters(problem.plant, exact))
    assert describe(shared) == describe(anew)
    assert {one: said(shared, one) for one in CACHED} == {one: said(anew, one) for one in CACHED}
    np.testing.assert_array_equal(shared.of_equations.real_parameters, anew.real_parameters)
    assert np.array_equal(problem.real_parameters, problem.of_model.real_parameters)
    assert not np.array_equal(shared.real_parameters, problem.real_parameters)


def test_what_depends_on_them_is_checked_again():
    """An input without effect with these parameters, and a parameter outside its bounds."""
    plant = fp.Plant(
        coordinates={"q": "m"},
        inputs={"u": "N"},
        order=2,
        response=lambda q, v, u, p: {"q": p.b * u.u - p.k * q.q},
        parameters={"b": fp.Parameter(1.0, 1.2, "1/kg"), "k": fp.Parameter(1.0, 1.2, "1/s^2", (0.5, 2.0))},
    )
    reference = fp.Trajectory(lambda t: {"q": 0.1 * t})
    problem = fp.Problem(plant=plant, reference=reference, start={"q": 0.0}, period=0.01, duration=1.0)
    assert problem.with_exact(np.array([0.3, 1.9])).real_plant.exact.tolist() == [0.3, 1.9]
    with pytest.raises(InvalidProblem, match=r"\(exact parameters\) is not invertible at the start"):
        problem.with_exact(np.array([0.0, 1.0]))
    with pytest.raises(InvalidProblem, match="'k': exact is outside"):
        problem.with_exact(np.array([1.0, 3.0]))
