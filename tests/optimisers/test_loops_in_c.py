"""The loops in C are the composed graph: the same plan, numbers and memory, whatever they are called with."""

import sys

import numpy as np
import pytest
from helpers.loops_in_c import pair, ring, within_its_arrays
from helpers.machine import needs_compiler

import fpirhc as fp

pytestmark = needs_compiler
WIDE = np.array([-9.0, -900.0]), np.array([9.0, 900.0])
NARROW = np.array([-0.7, -110.0]), np.array([1.2, 40.0])


def same(one: list[np.ndarray], other: list[np.ndarray], allowed: float = 1e-9) -> None:
    """Equal entries, NaN and infinities included, to rounding."""
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=allowed, atol=allowed)


@pytest.fixture(scope="module", params=[(1, None), (4, fp.ExactHessian()), (None, None)], ids=["one", "four", "solved"])
def stepping(request):
    """Loops of one iteration per call, of four with the exact Hessian, and of as many as a plan needs."""
    iterations, hessian = request.param
    return pair("step", fp.FixedPointSolver(iterations=iterations, tolerance=1e-7, damping=0.02, hessian=hessian))


WAYS = {
    "one-wide": 2160.0626624770,
    "four-wide": 2253.6903639869,
    "solved-wide": 2429.2013723188,
    "one-narrow": 1444.3201471803,
    "four-narrow": 1526.2722150584,
    "solved-narrow": 1624.3232326178,
}


@pytest.mark.parametrize("bounds", [WIDE, NARROW], ids=["wide", "narrow"])
def test_calls_one_after_the_other(stepping, bounds, request):
    """From nothing and from what was remembered, with free inputs and with inputs at their bounds, near and far."""
    random, way = np.random.default_rng(0), 0.0  # a solution hides the way to it
    for size in (0.1, 1.0, 3.0, 8.0):
        memory = np.zeros(stepping.size)
        for _ in range(5):
            first = size * random.normal(size=3)
            results = list(stepping.both(first, stepping.data, *bounds, memory))
            same(results[0], results[1], 1e-6)
            way += results[0][1][3:].sum() + sum(np.log1p(np.abs(v)).sum() for v in results[0])
            memory = results[0][2]
    assert way == pytest.approx(WAYS[request.node.callspec.id], rel=1e-8)


def test_matrices_of_many_rows():
    """Thirteen states and three inputs, of which some are at their bounds."""
    wide, random = pair("step", fp.FixedPointSolver(iterations=1, tolerance=1e-7), of=ring), np.random.default_rng(0)
    bounds = np.array([-1.0, -20.0, -0.3]), np.array([1.5, 10.0, 0.4])
    for size in (0.3, 1.0, 3.0):
        memory = np.zeros(wide.size)
        for _ in range(5):
            results = list(wide.both(size * random.normal(size=13), wide.data, *bounds, memory))
            same(results[0], results[1], 1e-6)
            memory = results[0][2]


def test_any_memory(stepping):
    """A plan, a feedback, a step length of any size: what a run may remember, and what it never would."""
    random = np.random.default_rng(1)
    for tau in (1.0, 0.3, 1e-3, 1e-9, 0.0, -1.0, 5.0):
        for gamma in (1e-3, 0.1, 10.0, 0.0, -1.0):
            memory = 0.5 * random.normal(size=stepping.size)
            memory[-2:] = gamma, tau
            same(*stepping.both(random.normal(size=3), stepping.data, *NARROW, memory), 1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e301])
def test_what_is_not_finite(stepping, bad):
    """A state, data, bounds and a memory that are no numbers: one status, a finite plan, and a memory that is finite."""
    base = [np.ones(3), stepping.data.copy(), *WIDE, np.zeros(stepping.size)]
    for place in range(5):
        flat = base[place].ravel()
        for entry in (0, flat.size // 2, flat.size - 1):
            arguments = [np.array(v, dtype=float) for v in base]
            changed = arguments[place].ravel()
            changed[entry] = bad
            arguments[place] = changed.reshape(base[place].shape)
            results = list(stepping.both(*arguments))
            if (place in (2, 3) and np.isnan(bad)) or (place == 3 and bad < 0):  # no box, and so no plan to compare
                assert results[0][1][4, 0] == results[1][1][4, 0] != fp.Status.OK
                continue
            same(results[0], results[1], 1e-6)
            assert np.isfinite(results[1][0]).all()
            if place in (0, 1):
                assert int(results[1][1][4, 0]) == fp.Status.NON_FINITE


def test_an_empty_box_is_told(stepping):
    """One input whose lower bound is above its upper one: no plan, whichever input it is."""
    for k in range(2):
        lower, upper = np.array(WIDE[0]), np.array(WIDE[1])
        lower[k], upper[k] = 1.0, 0.5
        results = list(stepping.both(np.ones(3), stepping.data, lower, upper, np.zeros(stepping.size)))
        same(results[0], results[1])
        assert int(results[1][1][4, 0]) == fp.Status.INFEASIBLE


def test_a_plan_that_overflows_is_forgotten(stepping):
    """A remembered plan under which the model overflows, and a first state from which every plan does."""
    memory = np.full(stepping.size, 0.1)
    memory[:8] = 1e200
    for first, box in ((np.ones(3), 1e250), (np.full(3, 1e160), 9.0), (np.full(3, 1e160), np.inf)):
        bounds = np.full(2, -box), np.full(2, box)
        same(*stepping.both(first, stepping.data, *bounds, memory), 1e-6)


def test_calls_without_results(stepping):
    """Results that nobody wants are not written, and zeros without an address are read as zeros."""
    function, values = stepping.loops, (np.zeros(3), stepping.data, *WIDE, np.zeros(stepping.size))
    every = [np.asarray(v.full()) for v in function(*values)]
    for k, wanted in enumerate(every):
        alone = np.zeros(wanted.size)
        buffer, call = function.buffer()
        kept = [np.ravel(v, order="F").astype(float) for v in values]
        for j in (1, 2, 3):
            buffer.set_arg(j, kept[j].data)
        buffer.set_res(k, alone.data)
        call()
        np.testing.assert_array_equal(alone, wanted.ravel(order="F"))


@pytest.mark.parametrize("bounds", [WIDE, NARROW], ids=["wide", "narrow"])
def test_converging_loops_stop_where_the_graph_stops(bounds):
    """The same count, at the tolerance and at the most plain steps, cold and warm."""
    converging = pair("converging", fp.FixedPointSolver(iterations=1, tolerance=1e-7))
    random = np.random.default_rng(2)
    memory, counts = np.zeros(converging.size), set()
    for size in (0.0, 0.3, 0.6, 1.0, 1.5):
        first = size * random.normal(size=3)
        results = list(converging.both(first, converging.data, *bounds, memory))
        same(results[0][:2], results[1][:2], 1e-6)
        # Not the feedback: rounding decides whether an input is just at its bound.
        same([results[0][2][-2:]], [results[1][2][-2:]], 1e-6)
        counts.add(results[1][1][3, 0])
        assert results[1][1][4, 0] == fp.Status.OK
        memory = results[0][2]
    assert len(counts) > 1


@pytest.mark.skipif(sys.platform != "linux", reason="it needs the traps of GCC or Clang on Linux")
def test_no_loop_leaves_its_arrays(stepping):
    """One turn too many of a loop reads and writes what belongs to others, and need not change a number."""
    random = np.random.default_rng(4)
    calls = (
        (random.normal(size=3), stepping.data, *bounds, scale * random.normal(size=stepping.size))
        for bounds in (WIDE, NARROW)
        for scale in (0.0, 0.3, 0.3, np.nan)
    )
    assert within_its_arrays(stepping, calls)
