"""A review composes, plans and linearises no more often than its controllers differ; what it keeps belongs to one of them."""

import fpirhc as fp
from fpirhc.controllers import replanning
from fpirhc.describe import describe, identity
from fpirhc.simulation import loop
from fpirhc.simulation.linearise.asked_loop import AskedLoop
from fpirhc.simulation.linearise.linearisation import Linearisation
from fpirhc.simulation.linearise.slopes import Step
from fpirhc.symbolic import block


def counted(monkeypatch, owner, name):
    """Count the calls of a function from now on."""
    calls, original = [], getattr(owner, name)

    def count(*arguments, **named):
        calls.append(name)
        return original(*arguments, **named)

    monkeypatch.setattr(owner, name, count)
    return calls


def test_controllers_that_differ_in_their_deformation_share_what_a_review_builds(monkeypatch):
    task = fp.load_problem("two_mass")
    pair = {name: task.controllers[name] for name in ("RHC", "RHC+FPI")}
    loops = counted(monkeypatch, loop, "_closed")
    plans = counted(monkeypatch, replanning, "first_memory")
    asked = counted(monkeypatch, AskedLoop, "__init__")
    linear = counted(monkeypatch, Linearisation, "_among")
    steps = counted(monkeypatch, Step, "into")
    fp.review(task.problem, pair, mismatch=0.0, seed=0)
    assert len(plans) == 1  # exact parameters are numbers of the plant, and no other horizon
    assert len(asked) == 2  # without adaptation, and with a map of any gain
    assert (
        len(loops) <= 6
    )  # two that are asked, and one for all runs of each map: none, its own, and two that are tried
    assert len(linear) <= 32
    assert len(steps) <= 19_000


def test_only_steps_that_are_called_are_written_out_as_scalar_code(monkeypatch):
    """Those are the controller as it is where samples may be lost, and the loop."""
    task = fp.load_problem("two_mass")
    written = counted(monkeypatch, block, "scalar_code")
    assert loop.close_loop(task.problem, task.controllers["CTC"]).function.is_a("SXFunction")
    assert len(written) == 2


def test_plants_from_the_box_are_asked_of_controllers_that_adapt_alone(monkeypatch):
    """Without a deformation no question is about them: three points of the reference, and one with a right model."""
    task = fp.load_problem("two_mass")
    linear = counted(monkeypatch, Linearisation, "_among")
    fp.review(task.problem, {"RHC": task.controllers["RHC"]}, mismatch=20.0, seed=0)
    assert len(linear) == 4


# Results that a review keeps belong to one controller


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
