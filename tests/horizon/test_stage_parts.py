"""Derivatives of a stage in parts, as the loops in C call them, are those of the whole stage."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.horizon.hessian_models import GaussNewton, hessian_stage, linear_stage, split_hessian, split_stage
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.transcription import transcribe


@pytest.fixture(scope="module", params=["two_mass", "cart_pole", "van_der_pol", "chain_of_masses"])
def ocp(request) -> OptimalControl:
    p = fp.load_problem(request.param).problem
    assert p.horizon is not None
    assert p.cost is not None
    return transcribe(p.plant, p.reference, p.horizon, p.cost, p.limits)


def points(ocp: OptimalControl, seed: int) -> list[list[np.ndarray]]:
    """States, inputs, data of a stage, and costates, near the reference."""
    rng, (states, inputs, data) = np.random.default_rng(seed), ocp.nodes
    sizes = ocp.state.size, ocp.input.size
    return [
        [
            states[:, 0] + 0.1 * rng.normal(size=sizes[0]),
            inputs[:, 0] + 0.1 * rng.normal(size=sizes[1]),
            data[:, 0],
            rng.normal(size=sizes[0]),
        ]
        for _ in range(5)
    ]


def alike(one: list[ca.DM], other: list[ca.DM]) -> None:
    for mine, theirs in zip(one, other, strict=True):
        np.testing.assert_allclose(mine.full(), theirs.full(), rtol=1e-11, atol=1e-12)


def test_first_derivatives(ocp):
    """Next state and cost, A, B, l_s, l_u, and the adjoint step (A' lambda + l_s, B' lambda + l_u)."""
    whole, parts = linear_stage(ocp), split_stage(ocp)
    assert split_stage(ocp) is parts
    for s, u, data, after in points(ocp, 5):
        next_state, cost, a, b, by_state, by_input = whole(s, u, data)
        *values, kept = parts["evaluate"](s, u, data)
        alike(values, [next_state, cost])
        alike(list(parts["linearise"](kept, data)), [a, b, by_state, by_input])
        alike(list(parts["pull"](kept, after, data)), [by_state + a.T @ after, by_input + b.T @ after])


@pytest.mark.parametrize("hessian", [GaussNewton(), fp.ExactHessian()])
def test_second_derivatives(ocp, hessian):
    """Q, S and R."""
    whole, parts = hessian_stage(ocp, hessian), split_hessian(ocp, hessian)
    for s, u, data, after in points(ocp, 6):
        alike(list(parts["curve"](parts["bend"](s, u, data, after))), list(whole(s, u, data, after)))
