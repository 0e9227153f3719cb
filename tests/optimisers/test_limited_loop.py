"""Loops with limits of states: every call ends where its plan is solved, or says what is the matter within its most iterations."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from foreign import FOREIGN

import fpirhc as fp
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.bounds import scales
from fpirhc.symbolic.native import find_compiler, native

OPTIMISER = fp.FixedPoint(iterations=1, tolerance=1e-3)


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
    ocp = transcribe(case.plant, case.reference, case.horizon, case.cost, case.limits)
    data = np.asarray(
        stage_data(case.plant, case.reference, case.horizon, case.cost)(0.0, case.plant.approximate).full()
    )
    first = case.first(ocp, np.array([case.start.get(e, 0.0) for e in case.plant.state.elements]))
    return ocp, first, data, OPTIMISER.first_memory(ocp, first, data)


def called(function, ocp, first, data, memory):
    return [np.asarray(v.full()) for v in function(first, data, ocp.input_lower, ocp.input_upper, memory)]


def priced(inputs, ocp, first, data):
    """Cost of a plan, rolled out by the horizon's own stages, with the price of its violations."""
    state, cost, price = first, 0.0, np.zeros(ocp.state.size)
    price[list(scales(ocp).bounded)] = scales(ocp).capacity
    for i in range(ocp.stages):
        cost += float(ocp.stage_cost(state, inputs[:, i], data[:, i])[0])
        state = np.asarray(ocp.dynamics(state, inputs[:, i], data[:, i]).full()).ravel()
        cost += float(price @ np.maximum(0, np.maximum(state - ocp.state_upper, ocp.state_lower - state)))
    return cost + float(ocp.terminal_cost(state, data[:, -1]))


@pytest.mark.parametrize("iterations", [1, 3])
def test_every_plan_of_a_loop_with_a_wrong_model_is_converged(iterations):
    """The quadrotor, 13 % lighter than its model: what `iterations` says without limits of states does not matter with them."""
    p = problem_of("quadrotor", duration=3.0)
    run = fp.simulate(p, fp.RecedingHorizon(fp.FixedPoint(iterations, tolerance=1e-4)), seed=0)
    assert run.stop is None
    assert set(fp.measure(p, run).statuses) == {"OK"}
    lower, upper = p.limits.state_bounds(p.plant)
    half = 0.5 * (upper - lower)
    beyond = np.maximum(run["state"] - upper, lower - run["state"]) / np.where(np.isfinite(half), half, 1.0)
    assert beyond.max() <= 0.2


def test_a_remembered_plan_of_a_state_that_moved_beyond_its_limit_is_told_in_few_iterations():
    """Jumps of the temperature by up to 6 K, and back: the plan and the verdict are those from nothing, INFEASIBLE above 3 K."""
    ocp, first, data, memory = warm("reactor")
    step, verdicts = native(OPTIMISER.step(ocp)).function, []
    for jump in (3.0, 5.0, -3.0, 6.0, 0.0, 4.0, -5.0):
        moved = first + np.array([0.0, jump, 0.0])
        _, diagnostics, memory = called(step, ocp, moved, data, memory)
        fresh = called(step, ocp, moved, data, OPTIMISER.memory(ocp).start())[1]
        assert diagnostics[4, 0] == fresh[4, 0]
        assert diagnostics[3, 0] < 40
        verdicts.append(int(diagnostics[4, 0]) == fp.Status.INFEASIBLE)
        assert diagnostics[0, 0] == pytest.approx(fresh[0, 0], rel=1e-4)
    assert verdicts == [False, True, False, True, False, True, False]


@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
def test_a_call_that_uses_all_its_iterations_keeps_the_plan_in_force_where_that_is_better():
    """Two iterations after a disturbance are not enough: the better plan, in C and as a graph, and no verdict on the limits."""
    ocp, first, data, memory = warm("quadrotor")
    graph = replace(OPTIMISER, most_iterations=2).step(ocp)
    compiled, remembered, random, kept = (
        native(graph).function,
        OPTIMISER.memory(ocp).unpack(memory),
        np.random.default_rng(0),
        [],
    )
    for _ in range(6):
        moved = first + 0.1 * scales(ocp).states * random.standard_normal(first.size)
        (inputs, diagnostics, _), other = (called(f, ocp, moved, data, memory) for f in (compiled, graph))
        np.testing.assert_allclose(inputs, other[0], atol=1e-5)
        np.testing.assert_array_equal(diagnostics[3:], other[1][3:])
        assert int(diagnostics[4, 0]) in (fp.Status.OK, fp.Status.NOT_CONVERGED)
        force = in_force(remembered, ocp, moved, data)
        kept.append(np.allclose(inputs, force, atol=1e-9))
        assert priced(inputs, ocp, moved, data) <= priced(force, ocp, moved, data) * (1 + 1e-9)
    assert {True, False} == set(kept)


def in_force(remembered, ocp, first, data):
    """The remembered inputs rolled out with their feedback from another first state."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    inputs, gains = remembered["plan_inputs"].reshape(n, nu), remembered["plan_gains"].reshape(n, ns, nu)
    states = np.vstack([first, remembered["plan_states"].reshape(n, ns)])
    state, rows = first, []
    for i in range(n):
        rows.append(np.clip(inputs[i] + (state - states[i]) @ gains[i], ocp.input_lower, ocp.input_upper))
        state = np.asarray(ocp.dynamics(state, rows[-1], data[:, i]).full()).ravel()
    return np.array(rows).T
