"""Plans on outputs under a wrong model, beside a controller of CasADi's Opti and IPOPT that shares nothing with the library;
plans that start where the model has the measured outputs keep the limits of the measured state, and are optima from there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import output_plans as study
import pytest
from kinds import slow_but
from own_nmpc import FINE, equations, own_run, runge_kutta
from plants import simulated
from scipy.integrate import solve_ivp
from test_outputs import OPTIMISER, planned

import fpirhc as fp
from fpirhc.status import Status
from fpirhc.studies.comparison.optimality import measure_optimality

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


@pytest.mark.parametrize("name", slow_but(RMS, "growth"))
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


# Plans that start where the model has the measured outputs keep the limits of the measured state, and are optima from there


ADAPTIVE = fp.ModelReferenced(fp.Affine(-1.6))
SOLVED = fp.FixedPoint(iterations=20, tolerance=1e-4)  # V


def servo(believed: float, **settings: Any) -> fp.Problem:
    """A servo, angle' = a speed, speed' = 4 b (u - speed): a move at a speed of at most 1 rad/s; the model has a and b wrong."""
    plant = fp.Plant.of_states(
        states={"angle": "rad", "speed": "rad/s"},
        inputs={"u": "V"},
        parameters={"a": fp.Parameter(believed, 1.0, "1"), "b": fp.Parameter(1.3, 1.0, "1/s")},
        rates=lambda x, u, p: {"angle": p.a * x.speed, "speed": 4 * p.b * (u.u - x.speed)},
        outputs={"y": fp.Output("rad", lambda x, p: x.angle)},
    )
    limits: dict[str, Any] = {"inputs": {"u": (-3.0, 3.0)}, "states": {"speed": (-1.0, 1.0)}, **settings}
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"y": 2 / (1 + ca.exp(-4 * (t - 2)))}),
        start={"angle": 0.0, "speed": 0.0},
        period=0.02,
        duration=4.0,
        horizon=fp.Horizon(stages=20, step=0.1),
        cost=fp.Quadratic(outputs={"y": 1.0}, rate={"u": 1e-4}),
        limits=fp.Limits(**limits),
    )


def fastest(run: fp.Run) -> float:
    return float(np.abs(run["state.speed"]).max())


@pytest.mark.parametrize(("believed", "most"), [(0.7, 1.02), (1.4, 1.2)])
def test_limits_of_states_behind_outputs_hold_for_the_measured_state(believed: float, most: float) -> None:
    """At x* the model's speed is a / a^ times the measured one: bound there, it may be 1.4 rad/s, or not more than .7."""
    problem, controller = servo(believed), fp.RecedingHorizon(SOLVED, ADAPTIVE)
    run = simulated(problem, controller)
    assert 0.98 < fastest(run) < most
    assert run["status"].max() == 0
    free = simulated(servo(believed, states={}), controller)
    assert fastest(free) > 1.5


@pytest.mark.parametrize("settings", [{"soft": {"speed": 1e3}}, {"prices": {"speed": 1e2}}])
def test_so_do_soft_limits_and_priced_ones(settings: dict[str, Any]) -> None:
    run = simulated(servo(0.7, **settings), fp.RecedingHorizon(SOLVED, ADAPTIVE))
    assert 0.9 < fastest(run) < 1.1


def test_so_do_limits_with_margins() -> None:
    """A tenth of the limit is kept free, of the measured speed."""
    margins = {"speed": [0.1] * 20}
    run = simulated(servo(0.7), fp.RecedingHorizon(SOLVED, ADAPTIVE, margins=margins))
    assert 0.88 < fastest(run) < 0.93


@pytest.mark.parametrize("limited", [False, True])
def test_the_gap_to_the_optimum_is_that_of_the_horizon_from_there(limited: bool) -> None:
    """Converged plans have none; counted from the measured state they would have one."""
    problem = servo(1.4) if limited else planned()
    optimiser = SOLVED if limited else OPTIMISER
    controller = fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(-1.0)))
    run = simulated(problem, controller)
    gap = measure_optimality(problem, controller, run, compiled=False)
    assert gap is not None
    assert gap.plans > 10
    assert abs(gap.median) < 1e-3
