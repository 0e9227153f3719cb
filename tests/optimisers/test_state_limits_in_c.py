"""The loops in C with limits of states: whatever they are called with, after a few turns and at the end."""

import sys

import numpy as np
import pytest
from helpers.horizons import rolled
from helpers.loops_in_c import Pair, pair, within_its_arrays
from helpers.machine import needs_compiler

import fpirhc as fp

pytestmark = needs_compiler
LIMITS = fp.Limits(inputs={"Ma": (-2.0, 2.5), "Mb": (-150.0, 120.0)}, states={"a": (-0.5, 0.6), "a'": (-np.inf, 1.2)})
END = 60  # more turns than any of these horizons needs


def loops(turns: int, kind: str = "step") -> Pair:
    """Loops that are cut off after so many turns."""
    return pair(kind, fp.FixedPoint(iterations=1, tolerance=1e-7, most_iterations=turns), LIMITS, 3)


def called(both: Pair, first: np.ndarray, memory: np.ndarray, bounds=None, data=None) -> tuple[np.ndarray, ...]:
    """What the plan gives: finite, and the same bits as a library and in a whole loop."""
    lower, upper = bounds or (both.ocp.input_lower, both.ocp.input_upper)
    one, other = both.both(first, both.data if data is None else data, lower, upper, memory)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)
    plan, diagnostics, after = other
    assert np.isfinite(np.concatenate([plan.ravel(), diagnostics.ravel()])).all()
    return plan, diagnostics[:, 0], after


@pytest.mark.parametrize(("turns", "way"), [(1, 3568.508178), (3, 5046.259527), (8, 5474.593530), (END, 5713.760566)])
def test_calls_that_are_cut_off_after_every_turn(turns, way):
    """From nothing and from what was remembered of a state nearby, of one far away, and of one outside its limits."""
    both, random, statuses, total = loops(turns), np.random.default_rng(0), set(), 0.0  # a solution hides the way to it
    for size in (0.1, 0.4, 0.7, 1.0, 1.5, 2.5):
        memory = np.zeros(both.size)
        for _ in range(3):
            plan, diagnostics, memory = called(both, size * random.normal(size=3), memory)
            statuses.add(int(diagnostics[4]))
            total += diagnostics[3] + np.abs(plan).sum()
    assert total == pytest.approx(way, rel=1e-7)
    assert statuses >= ({fp.Status.OK, fp.Status.INFEASIBLE} if turns == END else {fp.Status.NOT_CONVERGED})


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


@pytest.mark.parametrize("turns", [3, 8])
def test_any_memory(turns):
    """Barriers, dampings and multipliers of any size, and what no run would remember."""
    both, random = loops(turns), np.random.default_rng(1)
    for barrier in (1e-4, 1e-2, 1.0, 0.0, -1.0):
        for damping in (0.0, 1e-3, 10.0):
            memory = 0.3 * random.normal(size=both.size)
            memory[-2:] = barrier, damping
            memory[45:54:4] = 0.0  # of the limit that is not there
            _, diagnostics, after = called(both, 0.3 * random.normal(size=3), memory)
            assert np.isfinite(after).all()
            assert int(diagnostics[4]) != fp.Status.NON_FINITE


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
    for place in (0, both.size // 2, both.size - 1):
        broken = memory.copy()
        broken[place] = bad
        _, diagnostics, after = called(both, np.array([0.35, -0.1, 0.3]), broken)
        assert int(diagnostics[4]) == fp.Status.OK
        assert np.isfinite(after).all()


def test_a_plan_that_leaves_a_limit_is_never_called_ok():
    """What the loops call OK keeps the limits when it is simulated, and is stationary; what leaves them is not OK."""
    both, random = loops(END), np.random.default_rng(5)
    verdicts = set()
    for _ in range(12):
        first = np.array([0.5, 0.4, 1.0]) * random.normal(size=3)
        plan, diagnostics, _ = called(both, first, np.zeros(both.size))
        states = rolled(both.ocp, first, plan, both.data).states[:, 1:].T
        worst = float(np.maximum(both.ocp.state_lower - states, states - both.ocp.state_upper).max())
        assert diagnostics[2] == pytest.approx(max(worst, 0.0), abs=1e-9)
        verdicts.add((int(diagnostics[4]) == fp.Status.OK, worst <= 1e-6))
    assert verdicts == {(True, True), (False, False)}


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
