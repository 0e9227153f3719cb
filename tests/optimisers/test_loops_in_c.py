"""The loops in C are the composed graph: the same plan, numbers and memory, whatever they are called with, and whenever cut off."""

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import horizon_of
from helpers.machine import needs_compiler

import fpirhc as fp
from fpirhc.conformance import compiled

pytestmark = needs_compiler
REST = fp.Trajectory(lambda t: {"a": 0.3 * ca.sin(t), "b": 0 * t})


@dataclass(frozen=True, eq=False)
class Pair:
    """A step as the virtual machine runs it, and the same Function as compiled loops."""

    ocp: Any
    data: np.ndarray
    graph: ca.Function
    loops: ca.Function

    @property
    def size(self) -> int:
        return int(self.graph.size1_in(4))

    def both(self, *arguments) -> Iterator[list[np.ndarray]]:
        """Plan, diagnostics and memory in the virtual machine, and by the loops."""
        for function in (self.graph, self.loops):
            yield [np.asarray(v.full()) for v in function(*arguments)]


def coupled_plant() -> fp.Plant:
    """A pendulum and a lagging disc with two motors that both feel both: three states, and nothing symmetric or zero."""
    return fp.Plant(
        coordinates={"a": "rad", "b": "rad"},
        inputs={"Ma": "N m", "Mb": "N m"},
        order={"a": 2, "b": 1},
        parameters={"k": fp.Parameter(1.3, 1.3, "1/s^2")},
        response=lambda q, v, u, p: {
            "a": u.Ma - 0.003 * u.Mb + 2.0 * ca.sin(q.a) - p.k * (q.a - q.b) - 0.1 * v.a,
            "b": 0.008 * u.Mb + 0.2 * u.Ma * ca.cos(q.b) + 0.6 * q.b**2 + p.k * (q.a - q.b) + 0.4 * v.a,
        },
    )


def _terms(v):
    error = v.state.a - v.reference.a
    return {
        "error": 60.0 * error**2 + 2.0 * v.state.b**2 + 6.0 * v.state["a'"] ** 2 + 4.0 * error**4,
        "effort": 1.5 * (v.input.Ma - v.feedforward.Ma) ** 2 + 4e-4 * v.input.Mb**2 + 0.2 * v.input.Ma**4,
        "both": 0.02 * v.input.Ma * v.input.Mb + 0.3 * v.state.b * v.input.Ma,
    }


def _terminal(v):
    return 90.0 * (v.state.a - v.reference.a) ** 2 + 40.0 * v.state.b**2 + 9.0 * v.state["a'"] ** 2


@cache
def coupled(limits: fp.Limits | None = None, stages: int = 4) -> tuple[Any, np.ndarray]:
    """The horizon of these two with a cost whose curvature changes with states and inputs, and couples them."""
    cost = fp.CustomCost(terms=_terms, terminal=_terminal)
    horizon, plant = fp.Horizon(stages=stages, step=0.15), coupled_plant()
    return horizon_of(plant, REST, horizon, cost, limits, time=0.3)


RING = [f"x{k}" for k in range(13)]  # rows of a matrix in a block of eight, one of four, and one more


@cache
def ring(limits: fp.Limits | None = None, stages: int = 3) -> tuple[Any, np.ndarray]:
    """The horizon of a ring of thirteen states, each driven by two of three inputs, whose cost is small in its unit."""

    def response(q, u, p):
        x, v = [getattr(q, name) for name in RING], [u.u0, 0.05 * u.u1, 3.0 * u.u2]
        pairs = enumerate(zip(x, x[1:] + x[:1], strict=True))
        return {
            RING[k]: p.k * ca.sin(after) - 0.3 * (k % 4) * one + 0.4 * one * after + v[k % 3] - 0.1 * k * v[(k + 1) % 3]
            for k, (one, after) in pairs
        }

    def terms(v):
        x, (a, b, c) = [v.state[name] for name in RING], (v.input.u0, 0.05 * v.input.u1, 3.0 * v.input.u2)
        error = sum((1 + k % 3) * (one - 0.1) ** 2 + 0.3 * one * x[k - 1] + 0.2 * one**4 for k, one in enumerate(x))
        return {
            "all": 1e-3 * (error + 0.4 * a * a + 0.3 * b * b + 0.6 * c * c + 0.2 * a * b - 0.1 * b * c + 0.1 * a * x[3])
        }

    inputs, gain = dict.fromkeys(("u0", "u1", "u2"), "N"), {"k": fp.Parameter(1.3, 1.3, "1/s")}
    plant = fp.Plant(dict.fromkeys(RING, "m"), inputs, gain, response, order=1, controlled=RING[:3])
    rest, cost = fp.Trajectory(lambda t: dict.fromkeys(RING, 0 * t)), fp.CustomCost(terms=terms)
    return horizon_of(plant, rest, fp.Horizon(stages=stages, step=0.15), cost, limits, time=0.3)


@cache
def pair(
    kind: str, optimiser: fp.FixedPointSolver, limits: fp.Limits | None = None, stages: int = 4, of: Any = coupled
) -> Pair:
    """Graph and loops of `step` or `converging`."""
    ocp, data = of(limits, stages)
    graph = getattr(optimiser, kind)(ocp)
    return Pair(ocp, data, graph, compiled(graph))


def within_its_arrays(pair_of: Pair, calls: Iterator[tuple[np.ndarray, ...]]) -> bool:
    """Whether the loops stay inside their arrays: compiled so that they end their process where they do not."""
    flags = ("-fsanitize=bounds", "-fsanitize-undefined-trap-on-error")
    function = compiled(pair_of.graph, flags)
    child = os.fork()
    if not child:
        for arguments in calls:
            function(*arguments)
        os._exit(0)
    return os.waitpid(child, 0)[1] == 0


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


# With limits of states, after a few turns and at the end
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


CUT_OFF = {
    1: (5956.1039412, 5027.5742198),
    3: (6256.4379354, 5075.5276399),
    8: (6855.8178224, 4988.9530624),
    END: (8131.6825142, 6356.3981943),
    400: (9880.2335543, 10426.6413867),
}


@pytest.mark.parametrize("turns", CUT_OFF)
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
    assert way == pytest.approx(CUT_OFF[turns][place], rel=1e-7)


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
def test_what_is_not_finite_between_limits_of_states(bad):
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
def test_no_loop_with_limits_of_states_leaves_its_arrays():
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
