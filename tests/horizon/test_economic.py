"""Economic costs, which do not bend upwards: the exact Hessian with interior steps finds the optimum.

The reactor of M. Diehl, R. Amrit, J. B. Rawlings, A Lyapunov function for economic optimizing model predictive control, IEEE Trans.
Automatic Control 56(3), 2011, example V-B: A -> B of first order in a stirred tank, dilution Q from 0 to 20 l/min, the cost
-2 Q c_B + Q / 2. The best steady state is c_A = c_B = 1/2 mol/l at Q = 12 l/min; their regularisation is .505 times the squared
distance from it, which makes it optimal for the dynamic problem too.
"""

import numpy as np
import pytest
from helpers.horizons import horizon_of
from helpers.plants import known

import fpirhc as fp
from fpirhc.errors import NotSupported

REACTOR = fp.Plant(
    coordinates={"cA": "mol/l", "cB": "mol/l"},
    inputs={"Q": "l/min"},
    order=1,
    parameters={
        "k": fp.Parameter(1.2, 1.2, "1/min"),
        "V": fp.Parameter(10.0, 10.0, "l"),
        "feed": fp.Parameter(1.0, 1.0, "mol/l"),
    },
    response=lambda q, u, p: {"cA": u.Q / p.V * (p.feed - q.cA) - p.k * q.cA, "cB": -u.Q / p.V * q.cB + p.k * q.cA},
    controlled=("cB",),
    time_unit="min",
)
STEADY = fp.Trajectory(lambda t: {"cA": 0.5 + 0 * t, "cB": 0.5 + 0 * t})
STARTS = ([0.4, 0.2], [0.1, 0.8])
TOLERANCE = 1e-6
HALF = {"cA": 0.5, "cB": 0.4}
ECONOMIC = fp.FixedPointSolver(iterations=1, tolerance=TOLERANCE, hessian=fp.ExactHessian())


def horizon(regular: float, states: dict[str, tuple[float, float]], stages: int = 30):
    """The horizon in standard form, and its data."""
    cost = fp.CustomCost(
        lambda v: {
            "production": -v.input.Q * (2 * v.state.cB - 0.5),
            "regular": regular * ((v.state.cA - 0.5) ** 2 + (v.state.cB - 0.5) ** 2 + (v.input.Q - 12) ** 2),
        }
    )
    made = fp.Horizon(stages=stages, step=0.1)
    return horizon_of(REACTOR, STEADY, made, cost, fp.Limits(inputs={"Q": (0.0, 20.0)}, states=states), start=HALF)


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("regular", [0.505, 0.05])
@pytest.mark.parametrize("states", [{}, {"cA": (0.0, 0.49), "cB": (0.0, 1.0)}], ids=["inputs", "states"])
def test_a_production_rate_has_the_optimum_of_ipopt(regular, states, start):
    """The published regularisation, and a tenth of it: one optimum, found by both; the limit of c_A is active."""
    ocp, data = horizon(regular, states)
    assert ocp.along.least_curvature() < -0.1
    plan = fp.solve(ocp, ECONOMIC, np.array(start), data)
    best = fp.solve(ocp, fp.Ipopt(accuracy=1e-9), np.array(start), data)
    assert plan.status == best.status == fp.Status.OK
    assert known(plan.cost) == pytest.approx(known(best.cost), rel=1e-6)
    np.testing.assert_allclose(plan.inputs, best.inputs, atol=1e-4)
    if states:
        assert plan.states[0].max() == pytest.approx(0.49, abs=1e-6)


def test_a_long_horizon_passes_the_published_steady_state():
    """A plan of ten minutes is at the steady state in between: c_A = c_B = 1/2 mol/l at 12 l/min."""
    ocp, data = horizon(0.505, {}, stages=100)
    first = np.asarray(ocp.start([0.4, 0.2], [0.0]).full()).ravel()
    plan = fp.solve(ocp, ECONOMIC, first, data)
    assert plan.status == fp.Status.OK
    np.testing.assert_allclose(plan.states[:2, 45:61], 0.5, atol=4e-3)
    np.testing.assert_allclose(plan.inputs[0, 45:58], 12.0, atol=5e-2)


def test_gauss_newton_refuses_an_economic_cost_and_names_the_remedy():
    ocp, data = horizon(0.505, {})
    with pytest.raises(NotSupported, match=r"bends upwards.*hessian=ExactHessian\(\)"):
        fp.solve(ocp, fp.FixedPointSolver(1, TOLERANCE), np.array(STARTS[0]), data)
