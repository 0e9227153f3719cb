"""Loops with limits of states: every call ends where its plan is solved, or says what is the matter within its most iterations."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from foreign import FOREIGN
from helpers.horizons import called, horizon_of

import fpirhc as fp
from fpirhc.conformance import compiled

OPTIMISER = fp.FixedPointSolver(iterations=1, tolerance=1e-3)


def problem_of(name, duration, **limits):
    case = FOREIGN[name]()
    return fp.Problem(
        plant=case.plant,
        reference=case.reference,
        start=dict.fromkeys(case.plant.coordinates, 0.0)
        | {k: v for k, v in case.start.items() if k in case.plant.coordinates},
        period=case.horizon.step,
        duration=duration,
        limits=replace(case.limits, **limits),
        horizon=case.horizon,
        cost=case.cost,
    )


@cache
def warm(name):
    """A horizon, its first state and data, and the optimiser's memory of its plan."""
    case = FOREIGN[name]()
    ocp, data = horizon_of(case.plant, case.reference, case.horizon, case.cost, case.limits)
    first = case.first(ocp, np.array([case.start.get(e, 0.0) for e in case.plant.state.elements]))
    call = first, data, ocp.input_lower, ocp.input_upper, OPTIMISER.memory(ocp).start()
    return ocp, first, data, OPTIMISER.improve(ocp, call)[2].ravel()


@pytest.mark.parametrize("iterations", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_every_plan_of_a_loop_with_a_wrong_model_is_converged(iterations):
    """The quadrotor, 13 % lighter than its model: what `iterations` says without limits of states does not matter with them."""
    p = problem_of("quadrotor", duration=3.0)
    run = fp.simulate(p, fp.RecedingHorizon(fp.FixedPointSolver(iterations, tolerance=1e-4)), seed=0)
    assert run.stop is None
    assert set(fp.measure(p, run).statuses) == {"OK"}
    lower, upper = p.limits.state_bounds(p.plant)
    half = 0.5 * (upper - lower)
    beyond = np.maximum(run["state"] - upper, lower - run["state"]) / np.where(np.isfinite(half), half, 1.0)
    assert beyond.max() <= 0.2


def test_a_remembered_plan_of_a_state_that_moved_beyond_its_limit_is_told_in_few_iterations():
    """Jumps of the temperature by up to 6 K, and back: the plan and the verdict are those from nothing, INFEASIBLE above 3 K."""
    ocp, first, data, memory = warm("reactor")
    step, bounds, verdicts = compiled(OPTIMISER.step(ocp)), (ocp.input_lower, ocp.input_upper), []
    for jump in (3.0, 5.0, -3.0, 6.0, 0.0, 4.0, -5.0):
        moved = first + np.array([0.0, jump, 0.0])
        _, diagnostics, memory = called(step, moved, data, *bounds, memory)
        fresh = called(step, moved, data, *bounds, OPTIMISER.memory(ocp).start())[1]
        assert diagnostics[4, 0] == fresh[4, 0]
        assert diagnostics[3, 0] < 40
        verdicts.append(int(diagnostics[4, 0]) == fp.Status.INFEASIBLE)
        assert diagnostics[0, 0] == pytest.approx(fresh[0, 0], rel=1e-4)
    assert verdicts == [False, True, False, True, False, True, False]
