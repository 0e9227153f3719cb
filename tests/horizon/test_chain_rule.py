"""Derivatives in two parts are CasADi's, with fewer operations; what is known of a stage is not computed again."""

from __future__ import annotations

import runpy
from collections import Counter
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.horizon.hessian_models import hessian_stage, linear_stage, split_hessian, split_stage
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




def operations(function: ca.Function) -> Counter[int]:
    return Counter(function.instruction_id(k) for k in range(function.n_instructions()))












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


