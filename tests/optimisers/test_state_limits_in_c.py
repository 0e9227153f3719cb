"""The loops in C with limits of states: whatever they are called with, after a few turns and at the end."""

import sys
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.loops_in_c import Pair, coupled, pair, ring, within_its_arrays
from helpers.machine import needs_compiler

import fpirhc as fp

pytestmark = needs_compiler
LIMITS = fp.Limits(inputs={"Ma": (-2.0, 2.5), "Mb": (-150.0, 120.0)}, states={"a": (-0.5, 0.6), "a'": (-np.inf, 1.2)})
RINGED = fp.Limits(
    inputs={"u0": (-1.0, 1.5), "u1": (-20.0, 10.0), "u2": (-0.3, 0.4)},
    states={"x0": (-0.5, 0.6), "x4": (-0.4, np.inf), "x5": (-np.inf, 0.3), "x9": (-0.4, 0.5)},
    prices={"x5": 3e-3},
)
END = 60  # more turns than any of these horizons needs


def loops(turns: int, *of: Any) -> Pair:
    """Loops that are cut off after so many turns."""
    limits, horizon = of or (LIMITS, coupled)
    return pair("step", fp.FixedPointSolver(iterations=1, tolerance=1e-7, most_iterations=turns), limits, 3, horizon)


def called(both: Pair, first: np.ndarray, memory: np.ndarray, bounds=None, data=None) -> tuple[np.ndarray, ...]:
    """What the plan gives: finite, and the same bits as a library and in a whole loop."""
    lower, upper = bounds or (both.ocp.input_lower, both.ocp.input_upper)
    one, other = both.both(first, both.data if data is None else data, lower, upper, memory)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)
    plan, diagnostics, after = other
    assert np.isfinite(np.concatenate([plan.ravel(), diagnostics.ravel()])).all()
    return plan, diagnostics[:, 0], after


WAYS = {
    1: (5956.1039412, 5027.5742198),
    3: (6256.4379354, 5075.5276399),
    8: (6855.8178224, 4988.9530624),
    END: (8131.6825142, 6356.3981943),
    400: (9880.2335543, 10426.6413867),
}


@pytest.mark.parametrize("turns", WAYS)
@pytest.mark.parametrize("place", [0, 1], ids=["two bodies", "ring"])
def test_calls_that_are_cut_off_after_every_turn(turns, place):
    """From nothing, a guess, a remembered plan of another state, and any memory, near and far: a solution hides the way to it.

    Far outside the limits the steps need damping, other first plans, and at last descents.
    """
    both = loops(turns, *((LIMITS, coupled), (RINGED, ring))[place])
    random, way = np.random.default_rng(0), 0.0
    half = 0.5 * (both.ocp.input_upper - both.ocp.input_lower)
    for size in (0.1, 0.4, 0.7, 1.0, 1.5, 2.5, 4.0, 6.0, 10.0):
        memory = np.zeros((both.size, 1))
        for guessed in (0, 0, both.size, 0, 3 * half.size):
            guess = 0.5 * random.normal(size=both.size)
            memory[:guessed, 0] = guess[:guessed]
            memory[guessed:, 0] *= guessed == 0
            plan, diagnostics, memory = called(both, size * random.normal(size=both.ocp.state.size), memory)
            way += diagnostics[3] + diagnostics[4] + np.abs(plan / half[:, None]).sum()
            way += np.log1p(np.abs(np.concatenate([diagnostics[:3], memory[:, 0]]))).sum()
    assert way == pytest.approx(WAYS[turns][place], rel=1e-7)


@cache
def linearised() -> ca.Function:
    """Function (s_0, U) -> states of all later nodes of the ring, and their derivatives."""
    ocp, data = ring(RINGED, 3)
    state = first = ca.MX.sym("s", ocp.state.size)
    inputs, states = ca.MX.sym("U", ocp.input.size, ocp.stages), []
    for k in range(ocp.stages):
        state = ocp.dynamics(state, inputs[:, k], data[:, k])
        states.append(state)
    rows = ca.vertcat(*states)
    return ca.Function("states", [first, inputs], [rows, ca.jacobian(rows, ca.vec(inputs))])


def least_violation(both: Pair, first: np.ndarray, plan: np.ndarray, multipliers: np.ndarray) -> float:
    """The least sum of hard violations times multipliers by any inputs, along the model linearised at a plan."""
    ocp, n = both.ocp, plan.shape[1]
    at, slopes = (v.full() for v in linearised()(first, plan))
    shares = np.zeros((2, n, ocp.state.size))
    limited = np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper)
    shares[:, :, limited] = np.maximum(multipliers.reshape(2, n, -1)[:, :, len(plan) :], 0)
    shares[:, :, ~ocp.hard] = 0
    limits = np.nan_to_num([[ocp.state_lower], [ocp.state_upper]], posinf=0, neginf=0)
    push = (shares[1] - shares[0]).ravel()
    slope = (push @ slopes).reshape(plan.shape, order="F")
    corners = (slope * (bound[:, None] - plan) for bound in (ocp.input_lower, ocp.input_upper))
    return float(push @ at[:, 0] + (shares * limits * [[[1]], [[-1]]]).sum() + np.minimum(*corners).sum())


def test_a_call_that_is_cut_off_calls_infeasible_what_its_multipliers_prove():
    """Farkas' lemma: where even the least of this sum is positive, no inputs keep all hard limits; a price proves nothing."""
    random, verdicts = np.random.default_rng(3), []
    for turns in (1, 3, 8):
        both = loops(turns, RINGED, ring)
        places = fp.FixedPointSolver().memory(both.ocp).slice("plan_multipliers")
        for size in (0.2, 0.3, 0.4, 0.6, 1.0) * 4:
            memory = np.zeros(both.size)
            for _ in range(3):
                first = size * random.normal(size=13)
                plan, diagnostics, memory = called(both, first, memory)
                if diagnostics[2] > 1e-5:
                    least = least_violation(both, first, plan, memory[places, 0])
                    verdicts.append((diagnostics[4] == fp.Status.INFEASIBLE, least > 0))
    assert {(True, True), (False, False)} == set(verdicts)


def test_a_solution_stays():
    """Called again with what it remembers a call ends before its first turn, and remembers the same."""
    both, first = loops(END), np.array([0.3, 0.2, -0.3])
    memory = np.zeros(both.size)
    for _ in range(3):
        _, diagnostics, memory = called(both, first, memory)
    plan, diagnostics, after = called(both, first, memory)
    assert (diagnostics[3], diagnostics[4]) == (0, fp.Status.OK)
    np.testing.assert_allclose(after, memory, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(plan.ravel(order="F"), memory[:6, 0], atol=1e-12)


def test_bounds_of_the_call_count():
    """Narrower bounds than the problem's, none at all on one side, and an empty box."""
    both = loops(END)
    first, inf = np.array([0.2, -0.1, 0.3]), np.inf
    boxes = (
        ([-0.3, -20.0], [0.4, 10.0]),
        ([-inf, -50.0], [1.0, inf]),
        ([-inf, -inf], [inf, inf]),
        ([0.4, -9.0], [0.4, 9.0]),
    )
    for low, high in boxes:
        plan, _, _ = called(both, first, np.zeros(both.size), (np.array(low), np.array(high)))
        assert (plan >= np.array(low)[:, None] - 1e-12).all()
        assert (plan <= np.array(high)[:, None] + 1e-12).all()
    for k in range(2):
        lower, upper = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
        lower[k], upper[k] = 0.5, 0.4
        _, diagnostics, _ = called(both, first, np.zeros(both.size), (lower, upper))
        assert int(diagnostics[4]) == fp.Status.INFEASIBLE


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e301])
def test_what_is_not_finite(bad):
    """A state or data that are no numbers are told and leave a memory alone; a memory that is none is forgotten."""
    both = loops(END)
    memory = called(both, np.array([0.2, 0.1, -0.2]), np.zeros(both.size))[2]
    rest, size = np.array([0.2, 0.1, -0.2]), both.data.size
    for place in (0, 1, 2, 3, 3 + size // 2, 2 + size):
        values = np.concatenate([rest, both.data.ravel()])
        values[place] = bad
        plan, diagnostics, after = called(both, values[:3], memory, data=values[3:].reshape(both.data.shape))
        assert int(diagnostics[4]) == fp.Status.NON_FINITE
        np.testing.assert_array_equal(after, memory)
    plan, _, _ = called(both, np.full(3, bad), np.full(both.size, bad))
    np.testing.assert_array_equal(plan, np.zeros((2, 3)))
    plan, diagnostics, after = called(both, np.full(3, 1e160), memory)  # every plan overflows
    assert int(diagnostics[4]) == fp.Status.NON_FINITE
    np.testing.assert_array_equal(plan.ravel(order="F"), memory[:6, 0])
    assert not after.any()
    for place in (0, both.size // 2, both.size - 1):
        broken = memory.copy()
        broken[place] = bad
        _, diagnostics, after = called(both, np.array([0.35, -0.1, 0.3]), broken)
        assert int(diagnostics[4]) == fp.Status.OK
        assert np.isfinite(after).all()


@pytest.mark.skipif(sys.platform != "linux", reason="it needs the traps of GCC or Clang on Linux")
def test_no_loop_leaves_its_arrays():
    """One turn too many of a loop reads and writes what belongs to others, and need not change a number."""
    both, random = loops(END), np.random.default_rng(4)
    solved = called(both, np.array([0.2, 0.1, -0.2]), np.zeros(both.size))[2]
    bounds = both.ocp.input_lower, both.ocp.input_upper
    calls = (
        (size * random.normal(size=3), both.data, *bounds, memory)
        for size in (0.2, 0.8, 2.5)
        for memory in (np.zeros(both.size), solved, np.full(both.size, np.nan))
    )
    assert within_its_arrays(both, calls)
