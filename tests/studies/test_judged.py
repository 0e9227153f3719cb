"""Which errors a verdict is about: what is controlled, and what the cost weighs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import pytest

import fpirhc as fp

MASSES = 0.6, 0.2, 0.2  # kg: cart, lower, upper
LENGTHS = 0.5, 0.5  # m


def response(q, v, u, p):
    """A cart with two point masses on rods, angles from the vertical; A. Bogdanov, OGI School, report CSE-04-006, 2004."""
    (lower, upper), (l1, l2) = MASSES[1:], LENGTHS
    both, s = lower + upper, ca.sin(q.th1 - q.th2)
    inertia = ca.vertcat(
        ca.horzcat(p.cart + both, both * l1 * ca.cos(q.th1), upper * l2 * ca.cos(q.th2)),
        ca.horzcat(both * l1 * ca.cos(q.th1), both * l1**2, upper * l1 * l2 * ca.cos(q.th1 - q.th2)),
        ca.horzcat(upper * l2 * ca.cos(q.th2), upper * l1 * l2 * ca.cos(q.th1 - q.th2), upper * l2**2),
    )
    forces = ca.vertcat(
        u.F + both * l1 * ca.sin(q.th1) * v.th1**2 + upper * l2 * ca.sin(q.th2) * v.th2**2,
        9.81 * both * l1 * ca.sin(q.th1) - upper * l1 * l2 * s * v.th2**2,
        9.81 * upper * l2 * ca.sin(q.th2) + upper * l1 * l2 * s * v.th1**2,
    )
    q2 = ca.solve(inertia, forces)
    return {"pos": q2[0], "th1": q2[1], "th2": q2[2]}


def pendulum(**changes) -> fp.Problem:
    """Its balance is weighed tenfold; the force is made for the cart."""
    plant = fp.Plant(
        coordinates={"pos": "m", "th1": "rad", "th2": "rad"},
        inputs={"F": "N"},
        response=response,
        controlled=("pos",),
        parameters={"cart": fp.Parameter(approximate=0.8, exact=MASSES[0], unit="kg")},
    )
    usual: dict[str, Any] = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {"pos": 0.1 * ca.sin(t), "th1": 0 * t, "th2": 0 * t}),
        "start": {"pos": 0.0, "th1": 0.0, "th2": 0.0},
        "period": 5e-3,
        "duration": 4.0,
        "measure_from": 2.0,
        "horizon": fp.Horizon(stages=10, step=0.05),
        "cost": fp.Quadratic(states={"pos": 1.0, "th1": 10.0, "th2": 10.0, "pos'": 0.1}, deviation={"F": 1e-2}),
    }
    return fp.Problem(**(usual | changes))


def test_what_the_cost_weighs_is_judged():
    """Beside what is controlled; a weight on a derivative alone asks for no position, and what is stated stays."""
    one = pendulum()
    assert one.judged_names == ("pos", "th1", "th2")
    assert replace(one, cost=fp.Quadratic(states={"th1'": 1.0, "th2": 0.0}, deviation={"F": 1e-2})).judged_names == (
        "pos",
    )
    assert replace(one, judged=("th2",)).judged_names == ("th2",)
    assert replace(one, cost=None).judged_names == ("pos",)


@pytest.mark.parametrize(
    ("name", "judged"), [("cart_pole", ("cart", "angle")), ("chain_of_masses", ("xe", "ye", "ze"))]
)
def test_shipped_problems_judge_what_they_weigh(name, judged):
    """The chain weighs speeds of its inner masses and no positions."""
    assert fp.load_problem(name).problem.judged_names == judged


def test_a_live_weight_is_judged_by_the_number_of_the_build():
    """No branch on it is needed while the loop is built."""
    plan = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=0.1))
    loop = fp.simulator(pendulum(duration=0.05, measure_from=0.0), plan, compiled=False, live=["cost.states.th1"])
    assert loop.run(seed=0).layout["error"].elements == ("pos", "th1", "th2")
