"""What a review states about plans that weigh the change of their inputs, or must meet an end, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from plants import heavy
from reviewed import about, answer

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import Points, loops_along, own_loops, points_of
from fpirhc.review.questions.horizon import horizon_long_enough, plan_gain
from fpirhc.simulation.linearise.asked_loop import AskedLoop

STEP = 0.05  # s


def oscillator(**settings: Any) -> fp.Problem:
    """M q'' = u - k q at rest; model and plant are the same."""
    usual: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {"q": 0 * t}),
        "start": {"q": 0.1},
        "period": STEP,
        "duration": 10.0,
        "horizon": fp.Horizon(stages=60, step=STEP),
        "cost": fp.Quadratic(states={"q": 1e2, "q'": 1.0}, rate={"u": 0.5}),
    }
    return fp.Problem(heavy(1.0, 1.0, (4.0, 4.0)), **(usual | settings))


def model_of_a_stage() -> tuple[np.ndarray, np.ndarray]:
    """A and B of the oscillator over one stage."""
    whole = scipy.linalg.expm(np.array([[0, 1, 0], [-4, 0, 1], [0, 0, 0]]) * STEP)
    return whole[:2, :2], whole[:2, 2:]


def rate_weighted_gain(weight: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stationary gain of the state and the input before, with the matrices of this augmented system."""
    a, b = model_of_a_stage()
    wide, entry = scipy.linalg.block_diag(a, 0.0), np.vstack([b, [[1.0]]])
    q, r, s = np.diag([1e2, 1.0, weight]), np.array([[weight]]), np.array([[0.0], [0.0], [-weight]])
    value = scipy.linalg.solve_discrete_are(wide, entry, q, r, s=s)
    gain = -np.linalg.solve(r + entry.T @ value @ entry, entry.T @ value @ wide + s.T)
    return gain, wide, entry


def answers(problem: fp.Problem, controller: Controller) -> dict[str, fp.Answer]:
    report = fp.review(problem, {"it": controller}, mismatch=0.0, seed=0)
    return {a.question: a for a in report.answers}


PLAIN = fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-3))


def test_rate_weights_make_the_input_before_part_of_the_feedback():
    """The gains of a long plan are those of the Riccati equation of state and input before."""
    problem = oscillator()
    assert problem.horizon is not None
    first = plan_gain(problem, problem.horizon)
    gain, _, _ = rate_weighted_gain()
    assert first == pytest.approx(gain, rel=1e-4)


def test_loop_of_a_rate_weighted_plan_has_the_poles_of_its_closed_form():
    """One cycle per stage: the poles of state and input before under the stationary gain."""
    problem = oscillator()
    [loop, *_] = loops_along(review_grid(problem, 0.0, 0), PLAIN).loops
    gain, wide, entry = rate_weighted_gain()
    expected = np.linalg.eigvals(wide + entry @ gain)
    for pole in expected:
        assert np.abs(loop.poles - pole).min() < 1e-3
    assert loop.radius == pytest.approx(np.abs(expected).max(), abs=1e-4)


def test_several_cycles_per_stage_change_the_input_as_slowly():
    """Ten cycles per stage: a slow plan settles in the same time, not in a tenth of it."""
    slow = fp.Quadratic(states={"q": 1e2, "q'": 1.0}, rate={"u": 1e4})
    rates = []
    for period in (STEP, STEP / 10):
        problem = oscillator(cost=slow, period=period)
        [loop, *_] = loops_along(review_grid(problem, 0.0, 0), PLAIN).loops
        rates.append(np.log(loop.radius) / period)
    assert rates[1] == pytest.approx(rates[0], rel=0.1)


def test_nothing_is_unknown_about_a_rate_weighted_plan():
    """Horizon, rates, zero dynamics, margins, convergence and box have answers of their own."""
    adaptive = replace(PLAIN, deformation=fp.ModelReferenced(fp.Sigmoid(gain=-0.5, scale=20.0)))
    every = answers(oscillator(), adaptive)
    for words in (
        "horizon long",
        "sampling fast enough",
        "zero dynamics",
        "margin",
        "deformation converge",
        "box of par",
    ):
        assert about(every, words).verdict == "yes", about(every, words)
    assert "radius" in about(every, "margin").numbers


def test_an_end_that_must_be_met_is_in_the_feedback():
    """Two stages that must reach rest from any state: the deadbeat feedback, whatever the weights are."""
    problem = oscillator(
        horizon=fp.Horizon(stages=2, step=STEP, terminal=("q", "q'")),
        cost=fp.Quadratic(states={"q": 1e2, "q'": 1.0}, effort={"u": 1e-3}),
    )
    assert problem.horizon is not None
    first = plan_gain(problem, problem.horizon)
    a, b = model_of_a_stage()
    deadbeat = -np.linalg.solve(np.hstack([a @ b, b]), a @ a)[:1]
    assert first[:, :2] == pytest.approx(deadbeat, rel=1e-4)


def test_an_end_that_must_be_met_with_weighted_rates():
    """Five stages against the solution of all stages at once, with the change of the input weighed from the one before."""
    stages, weight = 5, 0.5
    problem = oscillator(horizon=fp.Horizon(stages=stages, step=STEP, terminal=("q",)))
    assert problem.horizon is not None
    first = plan_gain(problem, problem.horizon)
    a, b = model_of_a_stage()
    u = ca.SX.sym("u", stages)
    for place, start in enumerate(np.eye(3)):
        x, before, cost = ca.SX(start[:2]), ca.SX(start[2]), ca.SX(0)
        for k in range(stages):
            cost += STEP * (1e2 * x[0] ** 2 + x[1] ** 2 + weight * (u[k] - before) ** 2)
            x, before = ca.DM(a) @ x + ca.DM(b) @ u[k], u[k]
        cost += STEP * (1e2 * x[0] ** 2 + x[1] ** 2)
        solver = ca.qpsol(
            "reference", "qrqp", {"x": u, "f": cost, "g": x[0]}, {"print_iter": False, "print_header": False}
        )
        solution = solver(lbg=0, ubg=0)["x"]
        assert first[0, place] == pytest.approx(float(solution[0]), rel=1e-3, abs=1e-6)


def test_blocks_have_a_feedback():
    """Held inputs: the plan that holds its input over the whole horizon reacts less than one that is free."""
    free = oscillator(cost=fp.Quadratic(states={"q": 1e2, "q'": 1.0}, effort={"u": 1e-3}))
    blocked = replace(free, horizon=fp.Horizon(stages=60, step=STEP, blocks=(60,)))
    assert answer(blocked, PLAIN, "horizon long").numbers["change"] > 0
    sizes = []
    for problem in (free, blocked):
        assert problem.horizon is not None
        first = plan_gain(problem, problem.horizon)
        sizes.append(np.linalg.norm(first))
    assert sizes[1] < 0.5 * sizes[0]


@pytest.mark.slow
def test_a_plan_that_also_begins_anew_is_linearised_where_it_is_solved():
    """`freeway_economic` takes the cheaper of two plans, and has none where the queue of its reference is too long.

    Near a solved plan its own step does what the linear loop says, with one start, and other points are left out.
    """
    task = fp.load_problem("freeway_economic")
    problem, controller = replace(task.problem, disturbances={}), task.controllers["RHC"]
    grid = review_grid(problem, 0.0, 0)
    points, found = points_of(grid, controller), own_loops(grid, controller)
    assert found.places == (0,)
    assert [points.asked.feasible(points.quiet(k)) for k in (0, 20, 40)] == [True, False, False]
    memory, linear, whole = points.quiet(0), points.at(0), AskedLoop(problem, controller)
    state = whole.loop.memory.slice("_state_before")
    sizes = 1e-5 * np.abs(memory[state])
    moved = [memory.copy(), memory.copy()]
    for one, sign in zip(moved, (1, -1), strict=True):
        one[state] += sign * sizes
    ahead, behind = (whole.run(one, 1).memories[1, state] for one in moved)
    expected = linear.cycles[0].state @ linear.dynamics @ linear.placed @ sizes
    assert (ahead - behind) / 2 == pytest.approx(expected, rel=1e-3, abs=1e-3 * np.abs(expected).max())


@pytest.mark.slow
def test_cycles_that_are_skipped_have_no_linear_loop():
    """Where the model asks for more than the road carries, the last command is held: that is no loop without feedback."""
    task = fp.load_problem("freeway_economic")
    grid, controller = review_grid(task.problem, 0.0, 0), task.controllers["RHC+FPI"]
    points = points_of(grid, controller)
    assert points.asked.skips(points.quiet(0))
    assert not points.asked.skips(points.quiet(20))
    assert not own_loops(grid, controller).loops


@pytest.mark.parametrize("limit", [2.0, 1.0])
def test_plans_that_keep_no_hard_limit_have_no_linear_loop(limit):
    """Held at 1.5 m, with forces that cannot be back in a stage: with a limit of 1 m no plan is feasible.

    The slope of what the optimiser leaves there means nothing.
    """
    held = fp.Trajectory(lambda t: {"q": 1.5 + 0 * t})
    problem = oscillator(
        reference=held, start={"q": 1.5}, limits=fp.Limits({"u": (-12.0, 12.0)}, {"q": (-limit, limit)})
    )
    found = own_loops(review_grid(problem, 0.0, 0), PLAIN)
    assert bool(found.loops) == (limit > 1.5)
    assert found.reason == ("" if found.loops else "no plan along the reference keeps its limits of states")
    margin = answer(problem, PLAIN, "margin")
    assert (margin.verdict == "unknown") == (not found.loops)


def test_a_plan_that_feeds_no_state_back_says_nothing_about_its_horizon():
    """A cost that is linear in the states has no second derivative by them; only the change of the input holds it."""
    tariff = fp.CustomCost(
        lambda v: {"change": (v.input.u - v.input_before.u) ** 2}, terminal=lambda v: v.state.q, rate=True
    )
    problem = oscillator(cost=tariff)
    assert problem.horizon is not None
    gain = plan_gain(problem, problem.horizon)
    np.testing.assert_allclose(gain, [[0.0, 0.0, 1.0]], atol=1e-12)
    found = answer(problem, PLAIN, "horizon long")
    assert found.verdict == "unknown"
    assert found.evidence == "3 s; near the reference the plan feeds no state back, whatever its length"


def test_a_loop_does_not_depend_on_what_was_asked_before():
    """On the reference the plan of a wrong model stands at a limit, where nothing has a size by which other points are scaled.

    The model's own loop at rest decays as its run does, by 0.96 a cycle, whether it is asked first or last.
    """
    task = fp.load_problem("diabetes")
    grid = review_grid(task.problem, 0.0, 0)
    first = Points(grid, task.controllers["RHC"]).ideal(0).radius
    found = loops_along(grid, task.controllers["RHC"])
    assert found.ideal is not None
    assert found.ideal.radius == pytest.approx(first, rel=1e-4)
    assert 0.95 < first < found.radii.max() < 0.99
    horizon = horizon_long_enough(grid)
    assert horizon is not None
    assert horizon.numbers["growth"] * task.problem.period == pytest.approx(np.log(first), abs=0.01)
