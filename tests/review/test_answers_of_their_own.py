"""Results that a review keeps belong to one controller."""

import fpirhc as fp
from fpirhc.describe import describe, identity


def test_controllers_that_differ_in_a_formula_alone_have_answers_of_their_own():
    """The weight of a cost that a user wrote as a function is no setting that a description shows."""
    task = fp.load_problem("two_mass")
    planner = task.controllers["RHC"].planner
    assert planner is not None

    def weighed(weight):
        def terms(v):
            error = (v.state.q1 - v.reference.q1) ** 2 + (v.state.q2 - v.reference.q2) ** 2
            return {"error": weight * error, "effort": 1e-6 * (v.input.Q1**2 + v.input.Q2**2)}

        return fp.CustomCost(terms=terms)

    one, other = (fp.RecedingHorizon(planner.optimiser, cost=weighed(w)) for w in (1e4, 1e2))
    assert describe(one) == describe(other)
    assert identity(one) != identity(other)
    assert identity(one) == identity(fp.RecedingHorizon(planner.optimiser, cost=one.cost))
    answers = fp.review(task.problem, {"one": one, "other": other}, mismatch=0.0, seed=0).controllers
    margins = [next(a for a in answers[name] if "margin" in a.question) for name in answers]
    assert margins[0].numbers != margins[1].numbers
