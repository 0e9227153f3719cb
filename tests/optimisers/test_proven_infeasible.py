"""Whether a horizon is said to be infeasible where it is, and only there: small linear horizons against linear programs (HiGHS)."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import linprog
from test_limited import linear_horizon

import fpirhc as fp
from fpirhc.horizon.riccati import Expansion, expand
from fpirhc.optimisers.bounds import Limited, cannot_be_kept, scales
from fpirhc.optimisers.limited_settings import SURE

UNSTABLE = range(200, 250)  # six horizons among these are violated by ten times the limits and more


@pytest.fixture(scope="module")
def horizon():
    return linear_horizon()


def drawn(horizon, seed):
    """Data and first state of one random plant."""
    random = np.random.default_rng(seed)
    parameters = np.concatenate([random.normal(size=4) * 1.5, np.eye(2).ravel() + 0.4 * random.normal(size=4)])
    return np.asarray(horizon[1](0.0, parameters).full()), random.uniform([-0.5, -0.8], [0.6, 0.5])


@pytest.fixture(scope="module")
def plants(horizon):
    """Seed, data and first state of every plant, and its least violation with the weights that prove it."""
    drawn_ = [(seed, *drawn(horizon, seed)) for seed in UNSTABLE]
    return [(seed, data, first, *least_violation(horizon[0], first, data)) for seed, data, first in drawn_]


def least_violation(ocp, first, data):
    """The smallest largest violation that inputs within their limits reach, and the weights that prove it, (states, stages)."""
    n, nu, ns = ocp.stages, ocp.input.size, ocp.state.size

    def states(inputs):
        s, rows = first, []
        for i in range(n):
            s = np.asarray(ocp.dynamics(s, inputs[i * nu : (i + 1) * nu], data[:, i]).full()).ravel()
            rows.append(s)
        return np.concatenate(rows)

    rest = states(np.zeros(nu * n))
    rows = np.column_stack([states(one) - rest for one in np.eye(nu * n)])
    upper, lower = np.tile(ocp.state_upper, n) - rest, np.tile(ocp.state_lower, n) - rest
    give = -np.ones((ns * n, 1))
    found = linprog(
        np.r_[np.zeros(nu * n), 1.0],
        A_ub=np.block([[rows, give], [-rows, give]]),
        b_ub=np.r_[upper, -lower],
        bounds=[*zip(np.tile(ocp.input_lower, n), np.tile(ocp.input_upper, n), strict=True), (0, None)],
    )
    weights = -np.asarray(found.ineqlin.marginals)
    above, below = (part.reshape(n, ns).T for part in np.split(weights, 2))
    return float(found.x[-1]), below, above


def test_a_linear_horizon_is_infeasible_where_a_linear_program_says_so(horizon, plants):
    """In both directions, also where the largest multipliers leave a plan too few digits for its tolerance."""
    ocp, _, step, start = horizon
    told = set()
    for seed, data, first, least, *_ in plants:
        status = fp.Status(int(step(first, data, ocp.input_lower, ocp.input_upper, start)[1][4]))
        assert status == (fp.Status.INFEASIBLE if least > 1e-7 else fp.Status.OK), (seed, least)
        told.add(status)
    assert len(told) == 2


def proves(ocp):
    """Function (s0, data, U, X, z) -> whether these multipliers prove that the limits cannot be kept."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    lower, upper = ca.MX(ca.DM(ocp.input_lower)), ca.MX(ca.DM(ocp.input_upper))
    s0, data = ca.MX.sym("s0", ns), ca.MX.sym("data", ocp.data.size, n + 1)
    inputs, states, z = ca.MX.sym("U", nu, n), ca.MX.sym("X", ns, n + 1), ca.MX.sym("z", nu + ns, 2 * n)
    limits = Limited(ocp, scales(ocp), lower, upper)
    p = Expansion(*expand(ocp)(inputs, states, ca.MX.zeros(nu, ns * n), 0, ca.MX.zeros(ns, n), s0, data, lower, upper))
    return ca.Function("proves", [s0, data, inputs, states, z], [cannot_be_kept(ocp, limits, p, z, SURE)])


def test_no_multipliers_prove_what_is_not_so_and_those_of_a_program_prove_what_is(horizon, plants):
    """Farkas' lemma, at random plans with gaps: the weights of the linear program, and five random ones per plant."""
    ocp, n, nu = horizon[0], horizon[0].stages, horizon[0].input.size
    proven, random, sizes = proves(ocp), np.random.default_rng(1), set()
    for seed, data, first, least, below, above in plants:
        plan = random.uniform(-0.7, 0.7, (nu, n)), np.column_stack([first, random.normal(size=(2, n))])
        weights = np.zeros((nu + 2, 2 * n))
        weights[nu:] = np.hstack([below, above])
        assert bool(proven(first, data, *plan, weights)) == (least > 1e-7), (seed, least)
        sizes.add(least > 1e-7)
        for _ in range(5 if least <= 1e-7 else 0):
            drawn_weights = 10 ** random.uniform(-3, 3, weights.shape) * (random.uniform(size=weights.shape) < 0.2)
            assert not bool(proven(first, data, *plan, drawn_weights))
    assert len(sizes) == 2
