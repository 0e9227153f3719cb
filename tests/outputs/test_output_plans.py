"""Plans on outputs under a wrong model, beside a controller of CasADi's Opti and IPOPT that shares nothing with the library.

Laws: without adaptation the commands are those of the independent controller; with it the plant does what the plan foresaw, so that
a small share of the error is left. Plants and bars are those of `benchmarks/output_plans.py`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import output_plans as study
import pytest
from own_nmpc import FINE, equations, own_run, runge_kutta
from scipy.integrate import solve_ivp

import fpirhc as fp
from fpirhc.status import Status

PLANS = 8


@pytest.mark.parametrize("name", ["growth", "flexible_joint", "quadrotor"])
def test_the_independent_plant_moves_as_scipy_moves_it(name: str) -> None:
    problem = study.PLANTS[name]()
    rate = equations(problem, exact=True)[0]
    x = np.array([problem.start[n] for n in problem.plant.coordinates])
    u = 0.3 * study.spans(problem)

    def derivative(t: float, z: np.ndarray) -> np.ndarray:
        return np.asarray(rate(z, u).full()).ravel()

    there = solve_ivp(derivative, (0.0, problem.period), x, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    moved = np.asarray(runge_kutta(rate, problem.period, FINE)(x, u).full()).ravel()
    assert np.allclose(moved, there, rtol=1e-10, atol=1e-12)


# One plant of every relative order from 1 to 4, and one with two outputs of different orders. The slow study has all fifteen.
RMS = {"growth": 1.0e-4, "anaesthesia": 0.0104, "link": 2.1e-5, "flexible_joint": 2.5e-6, "vehicle": 5.7e-5}
"""Rms errors with the model-referenced deformation; without adaptation 28 (growth) to 3 300 (flexible joint) times as large."""
SHORT = [pytest.param(name, marks=pytest.mark.slow) if name in ("anaesthesia", "link") else name for name in RMS]


@pytest.mark.parametrize("name", SHORT)
def test_plans_of_a_wrong_model_are_those_of_an_independent_controller(name: str) -> None:
    problem = study.PLANTS[name]()
    assert problem.horizon is not None
    problem = replace(problem, duration=PLANS * problem.horizon.step, measure_from=0.0)
    own, run = own_run(problem), fp.simulate(problem, study.ways(problem)["RHC"], seed=0, compiled=False)
    assert own.converged.all()
    assert (run["solve.status"] == Status.OK).all()
    assert np.abs((run["command"] - own.commands) / study.spans(problem)).max() < 1e-3


@pytest.mark.parametrize("name", SHORT)
def test_with_adaptation_the_plant_does_what_the_plan_foresaw(name: str) -> None:
    problem = study.PLANTS[name]()
    adaptive = study.judged(problem, study.ways(problem)["RHC+FPI, model-referenced"])
    assert adaptive.rms == pytest.approx(RMS[name], rel=0.1)
    assert adaptive.converged == 1.0


def test_two_iterations_hold_a_quadrotor_whose_outputs_have_the_orders_four_and_four() -> None:
    for what, value, most in study.of_two_iterations():
        assert value <= most, what


@pytest.mark.slow
@pytest.mark.parametrize("name", study.PLANTS)
def test_every_bar_of_the_study_is_kept(name: str) -> None:
    for what, value, most in study.bars(name, study.outcomes(study.PLANTS[name]())):
        assert value <= most, what
