"""Derivatives in two parts are CasADi's, with fewer operations; what is known of a stage is not computed again."""

from __future__ import annotations

import runpy
from collections import Counter
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.horizon.hessian_models import (
    chain_rule,
    hessian_stage,
    linear_stage,
    linearise_stage,
    split_hessian,
    split_stage,
    stage_leaves,
)
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.symbolic.native import find_compiler, native

X, P = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
CALLED = ca.Function("called", [X], [ca.vertcat(ca.sin(X[0]) * X[1], X[2], 1 / (2 + X[0]))], {"never_inline": True})
EXPRESSIONS = {
    "smooth": ca.vertcat(ca.sin(X[0]) * ca.exp(X[1] / P[0]), X[2] ** 3 / (1 + X[0] ** 2), ca.sqrt(2 + X[1])),
    "branches": ca.vertcat(ca.if_else(X[0] > P[1], X[1] * X[2], X[1] / 3), ca.fmin(X[0], X[2]) + ca.fabs(X[1])),
    "linear": ca.vertcat(2 * X[0] - X[1], X[2], X[2] - X[2]),
    "shared": ca.vertcat(X[0] * X[0], X[0], X[0], P[0] * P[1], 5),
    "call": 2 * CALLED(X) + ca.vertcat(X[1] ** 2, 0, P[0] * X[2]),
    "power": ca.vertcat(ca.fabs(X[0]) ** P[0] * ca.sign(X[0]), ca.atan2(X[1], X[2]), ca.tanh(X[0] * X[1] * X[2])),
}
_OF_TIME = ("two_mass", "cart_pole", "van_der_pol", "chain_of_masses")


@pytest.fixture(scope="module", params=_OF_TIME)
def ocp(request) -> OptimalControl:
    p = fp.load_problem(request.param).problem
    assert p.horizon is not None
    assert p.cost is not None
    return transcribe(p.plant, p.reference, p.horizon, p.cost, p.limits)


def in_parts(ocp: OptimalControl) -> dict[str, ca.Function]:
    return {**split_stage(ocp), "linearise": linearise_stage(ocp)}


def operations(function: ca.Function) -> Counter[int]:
    return Counter(function.instruction_id(k) for k in range(function.n_instructions()))


@pytest.mark.parametrize("data", [None, P], ids=["", "data"])
@pytest.mark.parametrize("results", EXPRESSIONS.values(), ids=EXPRESSIONS.keys())
def test_both_parts_are_the_derivative(results, data):
    """J(m) is the Jacobian, and J(m)' w its transpose times any w; of twice a number the number is kept."""
    parts = chain_rule(ca.densify(results), X, P, data)
    assert not any(one.is_op(ca.OP_TWICE) for one in ca.vertsplit(parts.partials))
    made = ca.Function("made", [X, P], [parts.partials])
    jacobian = ca.Function("jacobian", [parts.symbols, P], [ca.densify(parts.jacobian)])
    pulled = ca.Function("pulled", [parts.symbols, P, parts.weights], [ca.densify(parts.pulled)])
    expected = ca.Function("expected", [X, P], [ca.densify(ca.jacobian(results, X))])
    rng = np.random.default_rng(4)
    for _ in range(20):
        x, p, w = rng.normal(size=3), rng.uniform(0.5, 1.5, size=2), rng.normal(size=results.numel())
        m, j = made(x, p), expected(x, p).full()
        np.testing.assert_allclose(jacobian(m, p).full(), j, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(pulled(m, p, w).full().ravel(), j.T @ w, rtol=1e-12, atol=1e-13)


def test_what_parameters_tell_in_two_operations_is_not_kept():
    """A quotient is, because it would be computed again for every use."""
    results = ca.vertcat(P[0] * X[0] + (P[1] - 1) / 2 * X[1], X[2] / P[0], P[0] * (P[1] - 1) / 2 * X[0])
    parts = chain_rule(results, X, P, P)
    assert [ca.is_equal(one, 1 / P[0], 2) for one in ca.vertsplit(parts.partials)] == [True, False]
    assert chain_rule(results, X, P).partials.numel() == 4


def test_linear_results_have_no_partial_derivatives_to_compute():
    parts = chain_rule(ca.densify(EXPRESSIONS["linear"]), X, P)
    assert parts.partials.numel() == 1
    assert float(parts.partials) == 0
    assert ca.DM(parts.jacobian).full().tolist() == [[2, -1, 0], [0, 0, 1], [0, 0, 0]]


def test_a_stage_in_parts_is_the_linear_stage(ocp):
    """Next state, cost, Jacobians and gradients agree with CasADi's, and the adjoint with theirs."""
    whole, parts, rng = linear_stage(ocp), in_parts(ocp), np.random.default_rng(5)
    states, inputs, data = ocp.nodes
    for _ in range(5):
        s = states[:, 0] + 0.1 * rng.normal(size=ocp.state.size)
        u, after = inputs[:, 0] + 0.1 * rng.normal(size=ocp.input.size), rng.normal(size=ocp.state.size)
        next_state, cost, a, b, by_state, by_input = (v.full() for v in whole(s, u, data[:, 0]))
        split_next, split_cost, m = parts["evaluate"](s, u, data[:, 0])
        assert (split_next.full() == next_state).all()
        assert float(split_cost) == cost
        for mine, theirs in zip(parts["linearise"](m, data[:, 0]), (a, b, by_state, by_input), strict=True):
            np.testing.assert_allclose(mine.full(), theirs, rtol=1e-12, atol=1e-13)
        before, slope = parts["pull"](m, after, data[:, 0])
        np.testing.assert_allclose(before.full(), by_state + a.T @ after[:, None], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(slope.full(), by_input + b.T @ after[:, None], rtol=1e-12, atol=1e-12)


def test_nothing_is_computed_twice(ocp):
    """The second parts multiply and add only, and both together take less than CasADi's Jacobian."""
    whole, parts = operations(linear_stage(ocp)), {k: operations(f) for k, f in in_parts(ocp).items()}
    plain = {ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_MUL, ca.OP_ADD, ca.OP_SUB, ca.OP_NEG, ca.OP_SQ, ca.OP_TWICE}
    assert parts["pull"].keys() <= plain
    assert parts["linearise"].keys() <= plain
    assert 2 * parts["evaluate"][ca.OP_DIV] < whole[ca.OP_DIV]
    assert parts["evaluate"].total() + parts["linearise"].total() < whole.total()


def test_a_problem_has_one_split_stage(ocp):
    assert split_stage(ocp) is split_stage(ocp)


@pytest.mark.parametrize("hessian", [fp.GaussNewton(), fp.ExactHessian()])
def test_second_derivatives_in_parts_are_those_of_the_stage(ocp, hessian):
    """Q, S and R agree with CasADi's Hessian, with fewer divisions."""
    whole, parts, rng = hessian_stage(ocp, hessian), split_hessian(ocp, hessian), np.random.default_rng(6)
    states, inputs, data = ocp.nodes
    for _ in range(5):
        s = states[:, 0] + 0.1 * rng.normal(size=ocp.state.size)
        u, after = inputs[:, 0] + 0.1 * rng.normal(size=ocp.input.size), rng.normal(size=ocp.state.size)
        expected = whole(s, u, data[:, 0], after)
        for mine, theirs in zip(parts["curve"](parts["bend"](s, u, data[:, 0], after)), expected, strict=True):
            np.testing.assert_allclose(mine.full(), theirs.full(), rtol=1e-11, atol=1e-12)
    counted = operations(parts["bend"]) + operations(parts["curve"])
    assert counted[ca.OP_DIV] <= operations(whole)[ca.OP_DIV]


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
def test_the_directions_of_a_large_stage_run_side_by_side():
    """Five masses have 24 directions: loops over all of them, in the plain iteration and with a wall, do what the graph does."""
    p = runpy.run_path(str(fp.load_problem("chain_of_masses").path))["chain"](5)
    for states in ({}, {"y1": (-0.2, 5.0)}):  # by Gauss-Newton, which compiles fast
        limits = fp.Limits(inputs=p.limits.inputs, states=states)
        ocp = transcribe(p.plant, p.reference, replace(p.horizon, stages=12), p.cost, limits)
        assert "slopes" in stage_leaves(ocp, ())[0]
        data = np.asarray(
            stage_data(p.plant, p.reference, replace(p.horizon, stages=12), p.cost)(0.0, p.plant.approximate).full()
        )
        first = np.asarray(ocp.start(p.start_state, np.zeros(3)).full()).ravel()
        optimiser = fp.FixedPoint(iterations=3, tolerance=1e-6, hessian=fp.GaussNewton())
        graph = optimiser.step(ocp)
        compiled = native(graph)
        assert compiled.compiled
        memory = optimiser.memory(ocp).start()
        for _ in range(3):
            arguments = first, data, ocp.input_lower, ocp.input_upper, memory
            expected, results = ([np.asarray(v.full()) for v in f(*arguments)] for f in (graph, compiled.function))
            np.testing.assert_allclose(results[0], expected[0], atol=1e-9)
            np.testing.assert_array_equal(results[1][3:], expected[1][3:])
            memory = expected[2].ravel()
