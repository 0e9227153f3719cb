"""Questions of a review that are files of their own: wrong parameters that nothing corrects, limits that the reference leaves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import abroad
import casadi as ca
import numpy as np
import pytest
from kinds import slow_but
from plants import heavy
from reviewed import answer

import fpirhc as fp
from fpirhc.controllers.contract import resolved
from fpirhc.deformation.base import Deformation, with_inner
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import ideal_loops
from fpirhc.review.questions.slew import slew_enough

# Parameters


def servo() -> fp.Problem:
    """A motor that turns a load over a shaft; load and friction are wrong in the model, and the motor is controlled."""
    return abroad.load("flexible_servo").problem


ADAPTIVE = fp.ComputedTorque(fp.Exponential(rate=2.0), fp.Sigmoid(gain=-0.5, scale=50.0))


def test_parameters_out_of_reach_are_named():
    """The motor's response has neither the load's inertia nor its friction: a no that names both."""
    one = answer(servo(), ADAPTIVE, "reach the wrong parameters")
    assert (one.verdict, one.numbers["reached"]) == ("no", 0.0)
    assert one.evidence == "the response does not depend on J_L, b_L"
    assert "nothing to correct" in one.change


def test_parameters_in_reach_have_their_effect():
    """A stiffness 10 % wrong as well: 128.02 N m/rad of the twist / 20 / 0.5 kg m2 are felt, the load is not."""
    problem = servo()
    stiffness = fp.Parameter(approximate=0.9 * 1280.2, exact=1280.2, unit="N m/rad")
    plant = replace(problem.plant, parameters={**problem.plant.parameters, "k": stiffness})
    problem = replace(problem, plant=plant, reference=fp.Trajectory(lambda t: {"load": 0.1 * t, "motor": 2 * t + 1.0}))
    one = answer(replace(problem, judged=("motor", "load")), ADAPTIVE, "reach the wrong parameters")
    assert one.verdict == "caution"
    assert one.numbers["effect_k"] == pytest.approx(128.02 / 20 * (1.0 / 20) / 0.5)
    assert one.evidence.endswith("the response does not depend on J_L, b_L")


def test_a_right_model_has_nothing_out_of_reach():
    """The exact model with the same deformation; without a deformation the question has no meaning."""
    words = "reach the wrong parameters"
    exact = answer(servo(), fp.ExactModel(ADAPTIVE), words)
    assert (exact.verdict, exact.numbers["wrong"]) == ("yes", 0.0)
    assert answer(servo(), replace(ADAPTIVE, deformation=fp.Identity()), words) is None


# Limits


def mass(amplitude: float = 0.5, **limits: Any) -> fp.Problem:
    """2 kg along A sin t with a plan; the force that this needs is -2 A sin t."""
    return fp.Problem(
        heavy(2.0, 2.0),
        fp.Trajectory(lambda t: {"q": amplitude * ca.sin(t)}),
        start={"q": 0.0, "q'": amplitude},
        period=0.1,
        duration=10.0,
        limits=fp.Limits(**limits),
        horizon=fp.Horizon(stages=10, step=0.1),
        cost=fp.Quadratic(states={"q": 1.0}, effort={"u": 1e-3}),
    )


POWER = fp.PathConstraint(lambda view: view.input.u * view.state["q'"], lower=-0.2, upper=0.2, unit="W")
KEEPS = "keep the limits of states"


@pytest.mark.parametrize(
    ("limits", "verdict"),
    [
        ({"states": {"q": (-0.6, 0.6)}}, "yes"),
        ({"states": {"q": (-0.4, 0.6)}}, "no"),
        ({"states": {"q": (-0.4, 0.6)}, "soft": {"q": 10.0}}, "caution"),
        ({"states": {"q": (-0.4, 0.6)}, "prices": {"q": 10.0}}, "caution"),
        ({"rates": {"u": (-1.2, 1.2)}}, "yes"),
        ({"rates": {"u": (-0.8, 0.8)}}, "no"),
        ({"paths": {"power": replace(POWER, lower=-0.3, upper=0.3)}}, "yes"),
        ({"paths": {"power": POWER}}, "no"),
    ],
)
def test_limits_that_the_reference_leaves(limits, verdict):
    """The position reaches 0.5 m, the force changes by 1 N/s, the power by 0.25 W: -2 A^2 sin t cos t."""
    one = answer(mass(**limits), None, KEEPS)
    assert one.verdict == verdict
    assert bool(one.change) == (verdict != "yes")


def test_no_limit_is_left_where_nobody_is_drawn_to_the_reference():
    """An economic cost has no reference in it: what it would need is no question; with the error in the cost it is one."""
    for weight, count in ((0.0, 0), (1.0, 1)):

        def cost(v, weight=weight):
            return {"effort": v.input.u**2, "error": weight * (v.state.q - v.reference.q) ** 2}

        problem = replace(mass(states={"q": (-0.4, 0.6)}), cost=fp.CustomCost(cost))
        asked = fp.review(problem, {}, mismatch=0.0, seed=0).answers
        assert sum(KEEPS in one.question for one in asked) == count


def test_small_lengths_leave_a_limit_like_large_ones():
    """A thousandth of a micrometre along, with a limit to one side at four fifths of the way."""
    one = answer(mass(1e-9, states={"q": (-np.inf, 0.8e-9)}), None, KEEPS)
    assert one.verdict == "no"
    assert one.numbers["room_q"] == pytest.approx(-0.2, abs=0.01)


def test_limits_that_are_touched_are_not_covered():
    """At rest on the limit: the linear loop leaves it out, which is no yes."""
    one = answer(mass(0.0, states={"q": (0.0, 1.0)}), None, KEEPS)
    assert (one.verdict, one.numbers["room_q"]) == ("caution", 0.0)


def test_limits_inside_leave_the_linear_loop_known():
    """State, rate and path limits that do not bind: no answer is unknown for their sake."""
    limits: dict[str, Any] = {
        "states": {"q": (-1.0, 1.0)},
        "rates": {"u": (-9.0, 9.0)},
        "paths": {"power": replace(POWER, lower=-9.0, upper=9.0)},
    }
    plain = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3))
    for words in ("sampling fast enough", "margin", "horizon long", KEEPS):
        one = answer(mass(**limits), plain, words)
        assert "known" not in one.evidence
        assert one.verdict != "unknown" or words == "horizon long"


def test_without_such_limits_the_question_is_not_asked():
    assert answer(mass(inputs={"u": (-2.0, 2.0)}), None, KEEPS) is None


# Reasons


def test_a_learning_controller_has_the_loop_of_its_first_model():
    """Its poles are those of inverse dynamics with that model, and decide nothing, because it learns another one."""
    task = fp.load_problem("planar_arm")
    learning = task.controllers["AID"]
    assert isinstance(learning, fp.rivals.AdaptiveInverseDynamics)
    plain = fp.ComputedTorque(learning.tracking)
    one, other = (answer(task.problem, c, "margin") for c in (learning, plain))
    assert one.numbers["radius"] == pytest.approx(other.numbers["radius"], rel=1e-4)
    assert (one.verdict, one.numbers["radius"] > 1) == ("unknown", True)


def test_advice_for_a_controller_without_a_map_names_no_gain():
    """A plan with small margins has no gain of a map that could be lowered."""
    task = fp.load_problem("delayed_tanks")
    one = answer(task.problem, task.controllers["RHC"], "margin")
    assert (one.verdict, one.change) == ("caution", "Weigh the inputs more.")


@pytest.mark.parametrize("name", slow_but(["delayed_mass", "two_link_arm"], "two_link_arm"))
def test_a_map_has_all_cycles_between_two_plans_for_a_jump_of_the_plan(name: str):
    """Plans every 20 and 10 cycles move the request by more than a step of the map; no run without that bound is better."""
    task = fp.load_problem(name)
    controller, grid = resolved(task.problem, task.controllers["RHC+FPI"]), review_grid(task.problem, 0.0, 0)
    deformation, believed = controller.deformation, controller.plant_model(grid.problem).parameters(grid.problem.plant)
    [ideal] = ideal_loops(grid, controller, 1)
    assert slew_enough(grid, deformation, believed, ideal).verdict == "yes"
    errors = [
        fp.simulate(task.problem, c, seed=0, compiled=False)["error"]
        for c in (controller, controller.with_deformation(unbounded(deformation)))
    ]
    assert np.linalg.norm(errors[0]) < 1.02 * np.linalg.norm(errors[1])


def unbounded(deformation: Deformation) -> Deformation:
    """The map with an affine one inside, of the same gain."""
    if deformation.inner is None:
        return fp.Affine(gain=-2 * deformation.effective_gain())
    return with_inner(deformation, unbounded(deformation.inner))
