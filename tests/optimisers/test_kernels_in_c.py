"""The small functions of the loops in C, alone, against numpy: every shape up to six states and three inputs."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from helpers.c_alone import call, columns, defined, library

from fpirhc.symbolic.expression import FINITE
from fpirhc.symbolic.native import find_compiler

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
SHAPES = ((1, 1), (2, 1), (3, 2), (4, 2), (5, 3), (6, 3))
by_shape = pytest.mark.parametrize(("states", "inputs"), SHAPES)

KERNELS = """
double t_larger(double a, double b) { return larger(a, b); }
double t_smaller(double a, double b) { return smaller(a, b); }
double t_between(double v, double low, double high) { return between(v, low, high); }
int t_all_finite(In v, int n) { return all_finite(v, n); }
int t_multiply(Out c, In a, In b, int rows, int inner, int columns) { multiply(c, a, b, rows, inner, columns); return 0; }
int t_transpose(Out to, In from, int rows, int columns) { transpose(to, from, rows, columns); return 0; }
int t_condense(Out q, Out cross, Out r, In p, In a, In b, Out turned) { condense(q, cross, r, p, a, b, turned); return 0; }
int t_sane(In s0, In data, In lower, In upper) { return sane(s0, data, lower, upper); }
"""


def kernels(states: int = 3, inputs: int = 2) -> Any:
    return library(("kernels",), defined(NS=states, NU=inputs, N=2, NT=2), KERNELS)


def test_products_of_every_shape():
    """C += a b and the transpose, up to six rows, factors and columns; what is beside the arrays stays."""
    rng = np.random.default_rng(0)
    for rows, inner, cols in itertools.product(range(1, 7), repeat=3):
        a, b, c = (rng.normal(size=s) for s in ((rows, inner), (inner, cols), (rows, cols)))
        result = np.append(columns(c), [7.0] * 8)
        call(kernels(), "t_multiply", result, columns(a), columns(b), rows, inner, cols)
        np.testing.assert_allclose(result[: rows * cols], columns(c + a @ b), rtol=1e-13, atol=1e-13)
        assert np.all(result[rows * cols :] == 7.0)
        turned = np.full(rows * inner + 4, 7.0)
        call(kernels(), "t_transpose", turned, columns(a), rows, inner)
        assert np.array_equal(turned, [*columns(a.T), 7.0, 7.0, 7.0, 7.0])


@by_shape
def test_condensed_hessians(states, inputs):
    """Q += A'PA, S += B'PA, R += B'PB."""
    rng = np.random.default_rng(states)
    shapes = (
        (states, states),
        (inputs, states),
        (inputs, inputs),
        (states, states),
        (states, states),
        (states, inputs),
    )
    q, s, r, p, a, b = (rng.normal(size=shape) for shape in shapes)
    results = [columns(m) for m in (q, s, r)]
    turned = np.zeros(states * states)
    call(kernels(states, inputs), "t_condense", *results, columns(p), columns(a), columns(b), turned)
    for result, expected in zip(results, (q + a.T @ p @ a, s + b.T @ p @ a, r + b.T @ p @ b), strict=True):
        np.testing.assert_allclose(result, columns(expected), rtol=1e-12, atol=1e-12)
    assert np.array_equal(turned, columns(a.T))


def test_numbers_that_are_none():
    """Fmax and fmin take the other one; a bounded value that is none becomes the lower limit."""
    import ctypes

    alone, values = kernels(), [-2.0, 0.0, 1.5, np.inf, -np.inf, np.nan]
    for name in ("t_larger", "t_smaller", "t_between"):
        getattr(alone, name).restype = ctypes.c_double
        getattr(alone, name).argtypes = [ctypes.c_double] * (3 if name == "t_between" else 2)
    for a, b in itertools.product(values, repeat=2):
        assert np.array_equal(alone.t_larger(a, b), np.fmax(a, b), equal_nan=True)
        assert np.array_equal(alone.t_smaller(a, b), np.fmin(a, b), equal_nan=True)
        assert alone.t_between(a, -1.0, 1.0) == (np.clip(a, -1.0, 1.0) if a == a else -1.0)  # noqa: PLR0124 -- no NaN


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1.01 * FINITE])
def test_finite_at_every_place(bad):
    """One entry that is not finite is found wherever it stands, and none beyond the end."""
    for size in range(1, 8):
        good = np.array([(-1) ** k * FINITE for k in range(size)])
        assert call(kernels(), "t_all_finite", np.append(good, bad), size) == 1
        for k in range(size):
            wrong = good.copy()
            wrong[k] = bad
            assert call(kernels(), "t_all_finite", wrong, size) == 0


def test_arguments_that_make_sense():
    """State and data are finite in every entry, and the box of the inputs is not empty, nor beyond every number."""
    good = {"s0": np.ones(3), "data": np.ones(6), "lower": np.array([-1.0, -np.inf]), "upper": np.array([1.0, np.inf])}

    def sane(**changes: tuple[int, float]) -> int:
        arrays = {name: values.copy() for name, values in good.items()}
        for name, (place, value) in changes.items():
            arrays[name][place] = value
        return call(kernels(), "t_sane", *arrays.values())

    assert sane() == sane(lower=(0, 1.0)) == sane(lower=(0, -np.inf), upper=(0, np.inf)) == 1
    for name, size in (("s0", 3), ("data", 6)):
        assert [sane(**{name: (k, np.nan)}) for k in range(size)] == [0] * size
    for k in range(2):
        assert sane(lower=(k, np.nan)) == sane(upper=(k, np.nan)) == 0
        assert sane(lower=(k, 2.0), upper=(k, 1.9)) == 0
        assert sane(lower=(k, 2 * FINITE), upper=(k, np.inf)) == sane(upper=(k, -2 * FINITE), lower=(k, -np.inf)) == 0


# Factors and the box of one stage

POLICY = """
int t_factorise(In matrix, const int* free, Out lower, Out pivots) { factorise(matrix, free, lower, pivots); return 0; }
int t_substitute(const int* free, In lower, In pivots, Out column) { substitute(free, lower, pivots, column); return 0; }
int t_policy(In slope, In matrix, In low, In high, Out v, int* free, Out lower, Out pivots) {
  box_policy(slope, matrix, low, high, v, free, lower, pivots);
  return 0;
}
int t_judged(In old, In u, In g, In next, double value, double after, double reach) {
  static Search s;
  static Plan best, plan;
  casadi_real low[NU], high[NU];
  int k;
  for (k = 0; k < NU; ++k) low[k] = -10, high[k] = 10;
  for (k = 0; k < N * NU; ++k) best.u[k] = old[k], plan.u[k] = u[k], best.g[k] = g[k], plan.g[k] = next[k];
  best.value = value, plan.value = after;
  s.tau = 1, s.gamma = 1e-3, s.envelope = value, s.reach = reach;
  return judged(&s, &best, &plan, 1, low, high);
}
"""
PIVOT, SHARE, ARMIJO = 1e-9, 0.9, 0.1


def policy(inputs: int, rounds: int = 12) -> Any:
    """`fixed_point.c` with as many rounds of the box as this."""
    constants = defined(
        NS=2, NU=inputs, N=3, NT=1, NM=1, MEMORY=1, WORK=1, INTEGERS=1, SCALE=[1.0] * inputs, FIRST_GAMMA=1.0,
        ITERATIONS=1, STOP_EARLY=0, TOLERANCE=1e-6, DAMPING=0.0, SHARE=SHARE, ARMIJO=ARMIJO, SHORTER=0.3, SHORTEST=0.03,
        DRAWN_IN=0.1, FLAT=1e-9, CONVERGING=0, ROUNDING=1e-12, PLAIN=3, UNTRIED=1e299,
        PIVOT=PIVOT, ROUNDS=rounds, CONVERGED=0, NOT_CONVERGED=1,
        INFEASIBLE=2, NON_FINITE=4, COSTATES=3, ROOM="(sizeof(Search) / sizeof(casadi_real))",
    )  # fmt: skip
    return library(("kernels", "fixed_point"), constants, POLICY)


def definite(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


@pytest.mark.parametrize("inputs", [1, 2, 3, 4])
def test_factors_solve_the_free_rows(inputs):
    """L D L' of a matrix solves its free rows; what is not free does not move."""
    rng, alone = np.random.default_rng(inputs), policy(inputs)
    for free in itertools.product((0, 1), repeat=inputs):
        matrix, wanted = definite(rng, inputs), rng.normal(size=inputs)
        flags, column = np.array(free, dtype=np.int32), wanted.copy()
        lower, pivots = np.full(inputs * inputs, np.nan), np.full(inputs, np.nan)
        call(alone, "t_factorise", columns(matrix), flags, lower, pivots)
        call(alone, "t_substitute", flags, lower, pivots, column)
        expected, rows = np.zeros(inputs), np.flatnonzero(free)
        expected[rows] = np.linalg.solve(matrix[np.ix_(rows, rows)], wanted[rows])
        np.testing.assert_allclose(column, expected, rtol=1e-9, atol=1e-12)


def test_pivots_that_are_not_positive_are_replaced():
    """By the size of the entry, so that a matrix that is not definite still has a descent."""
    matrix = np.array([[-2.0, 1.0], [1.0, 3.0]])
    flags, lower, pivots = np.ones(2, dtype=np.int32), np.zeros(4), np.zeros(2)
    call(policy(2), "t_factorise", columns(matrix), flags, lower, pivots)
    np.testing.assert_allclose(pivots, [2.0, 3.0 - 0.5**2 * 2.0])
    assert lower[1] == 0.5


@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_the_box_of_a_stage_has_the_best_move(inputs):
    """Against every set of active limits: the move has the least value, and what is free is what no limit holds.

    Of three inputs one move in a hundred may be another one: rounds of projected Newton steps, and no search of all sets.
    """
    rng, alone, others = np.random.default_rng(10 + inputs), policy(inputs), 0
    for _ in range(200):
        matrix, slope = definite(rng, inputs), 2 * rng.normal(size=inputs)
        low, high = -rng.uniform(0, 1.5, inputs), rng.uniform(0, 1.5, inputs)
        flags, v = np.ones(inputs, dtype=np.int32), np.zeros(inputs)  # of another stage, with other factors
        lower, pivots = np.full(inputs**2, np.nan), np.full(inputs, np.nan)
        call(alone, "t_policy", slope, columns(matrix), low, high, v, flags, lower, pivots)
        best = best_in_box(matrix, slope, low, high)
        assert 0.5 * v @ matrix @ v + slope @ v <= 0
        assert np.all((low <= v) & (v <= high))
        others += not np.allclose(v, best, rtol=1e-9, atol=1e-9)
        rate = matrix @ v + slope
        held = ((v <= low) & (rate > 0)) | ((v >= high) & (rate < 0))
        assert np.array_equal(flags, ~held)
    assert others <= (2 if inputs == 3 else 0)


@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_the_first_round_has_factors_of_its_own(inputs):
    """A move inside the box is found in one round, whatever the stage before had free, and with its factors."""
    rng, alone = np.random.default_rng(inputs), policy(inputs, rounds=1)
    for before in (0, 1):
        matrix, slope, limit = definite(rng, inputs), rng.normal(size=inputs), np.full(inputs, 1e3)
        flags, v = np.full(inputs, before, dtype=np.int32), np.zeros(inputs)
        lower, pivots = np.full(inputs**2, np.nan), np.full(inputs, np.nan)
        call(alone, "t_policy", slope, columns(matrix), -limit, limit, v, flags, lower, pivots)
        np.testing.assert_allclose(v, -np.linalg.solve(matrix, slope), rtol=1e-9)


def best_in_box(matrix: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The least quadratic in a box, by trying all sets of active limits."""
    moves = []
    for sides in itertools.product((None, 0, 1), repeat=len(slope)):
        move = np.array([0.0 if s is None else (low, high)[s][k] for k, s in enumerate(sides)])
        free = [k for k, s in enumerate(sides) if s is None]
        if free:
            rhs = -(slope + matrix @ move)[free]
            move[free] = np.linalg.solve(matrix[np.ix_(free, free)], rhs)
        if np.all((low - 1e-12 <= move) & (move <= high + 1e-12)):
            moves.append(move)
    return min(moves, key=lambda m: 0.5 * m @ matrix @ m + slope @ m)


@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_a_step_along_the_direction_has_to_lower_the_cost_by_a_share_of_its_slope(inputs):
    """With a flat gradient at its end: by ARMIJO of it, in every entry, or by SHARE (1 - SHARE) of the reach."""
    rng, alone, size = np.random.default_rng(inputs), policy(inputs), 3 * inputs
    for k in range(size):
        old, move, slope = rng.normal(size=size), np.zeros(size), np.zeros(size)
        move[k], slope[k] = 1.0, -4.0
        flat = np.zeros(size)
        for fall, far, accepted in ((0.3, 1e3, 0), (0.5, 1e3, 1), (0.05, 1e3, 0), (0.1, 1.0, 1), (-0.1, 1.0, 0)):
            assert call(alone, "t_judged", old, old + move, slope, flat, 1.0, 1.0 - fall, far) == accepted, (k, fall)


# The sweep of a plan with limits of states

SWEEP = """
static const double *base, *given[3];
static int copied(int which, int size, const double* x, double* to) {
  int j, i = (int)(x - base) / NS;
  for (j = 0; j < size; ++j) to[j] = given[which][i * size + j];
  return 0;
}
static int plain(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {
  return copied(0, NS * NS, arg[0], res[0]) || copied(1, NU * NS, arg[0], res[1]) || copied(2, NU * NU, arg[0], res[2]);
}
#define PUT(to, from, size) for (k = 0; k < (size); ++k) (to)[k] = (from)[k]
int t_sweep(In f, In a, In b, In ls, In lu, In x, In tail, In final, In weight, In lean, In q, In cross, In r, double delta,
            Out dx, Out du, Out costates) {
  static Point p;
  static Direction d;
  static Scratch s;
  int k, ok;
  PUT(p.f, f, N * NS); PUT(p.a, a, N * NS * NS); PUT(p.b, b, N * NS * NU); PUT(p.ls, ls, N * NS); PUT(p.lu, lu, N * NU);
  PUT(p.x, x, (N + 1) * NS); PUT(p.tail, tail, NS); PUT(p.final, final, NS * NS);
  base = p.x, given[0] = q, given[1] = cross, given[2] = r;
  ok = swept(&d, &p, weight, lean, costates, delta, 0, x, &s);
  PUT(dx, d.dx, (N + 1) * NS); PUT(du, d.du, N * NU); PUT(costates, d.costates, (N + 1) * NS);
  return ok;
}
int t_factorised(In matrix, Out lower, Out pivots) { return factorised(matrix, lower, pivots); }
static const double* stage; /* f, cost, a, b, ls, lu of every stage; then cost, tail and final of the end */
#define ENTRIES (NS + 1 + NS * NS + NS * NU + NS + NU)
static int evaluate(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {
  const double* from = stage + ENTRIES * (int)arg[2][0];
  int k;
  PUT(res[0], from, NS);
  res[1][0] = from[NS], res[2][0] = arg[2][0];
  return 0;
}
static int linearise(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {
  const double* from = stage + ENTRIES * (int)arg[0][0] + NS + 1;
  int k;
  PUT(res[0], from, NS * NS); PUT(res[1], from + NS * NS, NS * NU);
  PUT(res[2], from + NS * NS + NS * NU, NS); PUT(res[3], from + NS * NS + NS * NU + NS, NU);
  return 0;
}
static int end(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {
  const double* from = stage + ENTRIES * N;
  int k;
  res[0][0] = from[0];
  PUT(res[1], from + 1, NS); PUT(res[2], from + 1 + NS, NS * NS);
  return 0;
}
int t_expand(In all, In data, In k, int rolled, In gaps, In s0, In low, In high, Out x, Out u, Out value) {
  static Point p;
  static Scratch s;
  int j, ok;
  for (j = 0; j < (N + 1) * NS; ++j) p.x[j] = x[j];
  for (j = 0; j < N * NU; ++j) p.u[j] = u[j];
  stage = all;
  ok = expand(&p, k, rolled, gaps, s0, data, low, high, &s);
  for (j = 0; j < (N + 1) * NS; ++j) x[j] = p.x[j];
  for (j = 0; j < N * NU; ++j) u[j] = p.u[j];
  *value = p.value;
  return ok;
}
"""
STAGES, COST, DAMPED = 4, 2.5, 0.3


def swept(states: int, inputs: int, places: list[int]) -> Any:
    """`limited_sweep.c` with these bounded states."""
    constants = defined(
        NS=states, NU=inputs, N=STAGES, NB=len(places), NT=1, NM=1, NH=1, WORK=1, INTEGERS=1, COST=COST, PIVOT=PIVOT,
        DAMPING=DAMPED, PLACES=[*places, 0], CURVATURE=[0.5 + k for k in range(inputs)],
        UNITS=[1.0] * (inputs + len(places) + 1), SPREADS=[1.0 + 0.5 * j for j in range(states)],
    )  # fmt: skip
    return library(("kernels", "limited_sweep"), constants, SWEEP, "plain evaluate linearise end")


@by_shape
@pytest.mark.parametrize("delta", [0.0, 0.7])
def test_a_sweep_solves_its_quadratic_model(states, inputs, delta):
    """Moves and costates against one dense system of equations, with gaps, limits of inputs and states, and damping."""
    rng, places = np.random.default_rng(7 * states + inputs), [states - 1, 0][: min(2, states)]
    one = {
        "a": rng.normal(size=(STAGES, states, states)) / np.sqrt(states),
        "b": rng.normal(size=(STAGES, states, inputs)),
        "ls": rng.normal(size=(STAGES, states)),
        "lu": rng.normal(size=(STAGES, inputs)),
        "weight": rng.uniform(0, 2, (STAGES, inputs + len(places))),
        "lean": rng.normal(size=(STAGES, inputs + len(places))),
    }
    hessians = [definite(rng, states + inputs) for _ in range(STAGES)]
    final, tail = definite(rng, states), rng.normal(size=states)
    f, x = rng.normal(size=(STAGES, states)), rng.normal(size=(STAGES + 1, states))
    q, cross, r = (np.array([h[w] for h in hessians]) for w in blocks(states))
    dx, du, costates = np.zeros((STAGES + 1) * states), np.zeros(STAGES * inputs), np.zeros((STAGES + 1) * states)
    flat = [np.concatenate([columns(m) for m in matrices]) for matrices in (one["a"], one["b"], q, cross, r)]
    ok = call(
        swept(states, inputs, places), "t_sweep", f.ravel(), flat[0], flat[1], one["ls"].ravel(), one["lu"].ravel(), x.ravel(),
        tail, columns(final), one["weight"].ravel(), one["lean"].ravel(), *flat[2:], delta, dx, du, costates,
    )  # fmt: skip
    assert ok == 1
    moves, inputs_of, multipliers = dense(one, (q, cross, r), final, tail, f - x[1:], places, delta)
    for result, expected in ((dx[states:], moves), (du, inputs_of), (costates[states:], multipliers)):
        np.testing.assert_allclose(result, expected, rtol=1e-7, atol=1e-9)


def blocks(states: int) -> tuple[tuple[slice, slice], ...]:
    """Places of Q, S and R in the Hessian of a stage."""
    return np.s_[:states, :states], np.s_[states:, :states], np.s_[states:, states:]


def dense(one: Any, hessian: Any, final: Any, tail: Any, gaps: Any, places: Any, delta: float) -> tuple[Any, Any, Any]:
    """States, inputs and multipliers of the whole quadratic programme with equality constraints."""
    (stages, states), inputs = gaps.shape, one["lu"].shape[1]
    n, m = stages * states, stages * inputs
    h, g, c, d = np.zeros((n + m, n + m)), np.zeros(n + m), np.zeros((n, n + m)), np.zeros(n)
    for i in range(stages):
        x, u, after = (
            slice(k, k + s) for k, s in (((i - 1) * states, states), (n + i * inputs, inputs), (i * states, states))
        )
        q, cross, r = (part[i] for part in hessian)
        h[u, u] += r + np.diag(one["weight"][i, :inputs] + (DAMPED + delta) * (0.5 + np.arange(inputs)))
        g[u] += one["lu"][i] + one["lean"][i, :inputs]
        if i:
            h[x, x] += q
            h[u, x] += cross
            h[x, u] += cross.T
            g[x] += one["ls"][i]
            c[after, x] = one["a"][i]
        h[after, after] += np.diag(0.01 * delta * COST / (1.0 + 0.5 * np.arange(states)) ** 2)
        for k, place in enumerate(places):
            h[i * states + place, i * states + place] += one["weight"][i, inputs + k]
            g[i * states + place] += one["lean"][i, inputs + k]
        c[after, after] = -np.eye(states)
        c[after, u] = one["b"][i]
        d[after] = -gaps[i]
    last = slice(n - states, n)
    h[last, last] += final
    g[last] += tail
    solution = np.linalg.solve(np.block([[h, c.T], [c, np.zeros((n, n))]]), np.concatenate([-g, d]))
    return solution[:n], solution[n : n + m], solution[n + m :]


@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_a_matrix_that_is_not_definite_is_told(inputs):
    """By the first pivot that is not positive, at any place; a pivot that is lost in rounding counts as none."""
    rng, alone = np.random.default_rng(inputs), swept(2, inputs, [0])
    good = definite(rng, inputs)
    arrays = np.zeros(inputs**2), np.zeros(inputs)
    assert call(alone, "t_factorised", columns(good), *arrays) == 1
    for k in range(inputs):
        for entry in (-1.0, 0.0):
            wrong = good.copy()
            wrong[k, :k] = wrong[:k, k] = 0
            wrong[k, k] = entry
            assert call(alone, "t_factorised", columns(wrong), *arrays) == 0
    if inputs > 1:
        assert call(alone, "t_factorised", columns(np.ones((inputs, inputs))), *arrays) == 0


STATES, INPUTS = 3, 2
ENTRIES = STATES + 1 + STATES**2 + STATES * INPUTS + STATES + INPUTS


def expanded(stages: np.ndarray, *, gaps: np.ndarray | None, rolled: int) -> tuple[int, np.ndarray, np.ndarray, float]:
    """Whether a plan could be expanded, with its states, inputs and cost."""
    rng = np.random.default_rng(5)
    x, u, k = (rng.normal(size=n) for n in ((STAGES + 1) * STATES, STAGES * INPUTS, STAGES * STATES * INPUTS))
    value, data = np.zeros(1), np.arange(STAGES + 1.0)
    limits = np.full(INPUTS, 0.8)
    given = stages, data, k, rolled, gaps, np.ones(STATES), -limits, limits
    ok = call(swept(STATES, INPUTS, [0]), "t_expand", *given, x, u, value)
    return ok, x.reshape(-1, STATES), u.reshape(-1, INPUTS), float(value[0])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_expansion_with_anything_that_is_not_finite_is_none(bad):
    """Values, slopes and Jacobians of every stage, and value and slope of the end, alone; also where the value is finite."""
    good = np.random.default_rng(6).normal(size=ENTRIES * STAGES + 1 + STATES + STATES**2)
    assert expanded(good, gaps=None, rolled=0)[0] == 1
    for place in range(ENTRIES * STAGES + 1 + STATES):
        wrong = good.copy()
        wrong[place] = bad
        assert expanded(wrong, gaps=None, rolled=0)[0] == 0, place


def test_a_rollout_follows_the_model_less_the_gaps():
    """With feedback from the states that it leaves, inside the limits of the inputs; the cost is that of all stages."""
    stages = np.random.default_rng(6).normal(size=ENTRIES * STAGES + 1 + STATES + STATES**2)
    rows = stages[: ENTRIES * STAGES].reshape(STAGES, ENTRIES)
    gaps = np.random.default_rng(7).normal(size=STAGES * STATES)
    rng = np.random.default_rng(5)
    x, u, k = (rng.normal(size=n) for n in ((STAGES + 1) * STATES, STAGES * INPUTS, STAGES * STATES * INPUTS))
    x, u, k = x.reshape(-1, STATES), u.reshape(-1, INPUTS), k.reshape(-1, STATES, INPUTS)
    for given in (None, gaps):
        ok, states, inputs, value = expanded(stages, gaps=given, rolled=1)
        own = rows[:, :STATES] - (0 if given is None else gaps.reshape(-1, STATES))
        expected = np.vstack([np.ones(STATES), own])
        wanted = u + np.einsum("isl,is->il", k, expected[:-1] - x[:-1])
        assert ok == 1
        np.testing.assert_allclose(states, expected, rtol=1e-13)
        np.testing.assert_allclose(inputs, np.clip(wanted, -0.8, 0.8), rtol=1e-12)
        assert np.isclose(value, rows[:, STATES].sum() + stages[ENTRIES * STAGES])
    _, states, inputs, _ = expanded(stages, gaps=None, rolled=0)
    np.testing.assert_array_equal(states[0], np.ones(STATES))
    np.testing.assert_array_equal(states[1:], x[1:])
    np.testing.assert_array_equal(inputs, u)
