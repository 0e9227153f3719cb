"""Three discs on a shaft with two lagging motors (the oscillating masses of do-mpc's examples), planned every tenth cycle."""

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance import posed
from fpirhc.contracts import judge
from fpirhc.errors import NotSupported

INERTIA = 2.25e-4  # kg m^2
SPRINGS = 2.697e-3, 2.66e-3, 3.05e-3, 2.86e-3  # N m/rad: motor to disc, between discs, disc to motor
DAMPINGS = 6.78e-5, 8.01e-5, 8.82e-5  # N m s/rad
LAG = 1e-2  # s, of both motors


def response(x, u, p):
    shaft = (x.left, x.first, x.second, x.third, x.right)
    torques = [k * (shaft[i + 1] - shaft[i]) for i, k in enumerate(SPRINGS)]
    speeds = (x.first_speed, x.second_speed, x.third_speed)
    parts = zip(torques, torques[1:], DAMPINGS, speeds, strict=False)
    turns = [p.stiffness * (after - before) / INERTIA - d * w / INERTIA for before, after, d, w in parts]
    names = ("first", "second", "third")
    rates = dict(zip(names, speeds, strict=True)) | dict(zip((f"{n}_speed" for n in names), turns, strict=True))
    return rates | {side: (u[f"{side}_set"] - x[side]) / LAG for side in ("left", "right")}


def discs(discretisation):
    angles, motors = ("first", "second", "third"), ("left", "right")
    coordinates = dict.fromkeys([*angles, *motors], "rad") | dict.fromkeys([f"{n}_speed" for n in angles], "rad/s")
    plant = fp.Plant(
        coordinates=coordinates,
        inputs={f"{m}_set": "rad" for m in motors},
        controlled=motors,
        order=1,
        response=response,
        parameters={"stiffness": fp.Parameter(1.0, 1.0, "1")},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: dict.fromkeys(coordinates, 0 * t)),
        start=dict.fromkeys(coordinates, 0.0) | {"first": 2.0, "second": 0.8, "third": 2.5},
        period=0.01,
        duration=5.0,
        limits=fp.Limits(inputs=dict.fromkeys(plant.inputs, (-2 * np.pi, 2 * np.pi))),
        horizon=fp.Horizon(stages=20, step=0.1, discretisation=discretisation),
        cost=fp.Quadratic(states=dict.fromkeys(angles, 1.0), effort=dict.fromkeys(plant.inputs, 1e-2)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("discretisation", [fp.RungeKutta4(4), fp.Collocation()])
def test_bounded_linear_quadratic_plans_give_the_loop_of_ipopt(discretisation):
    """One iteration per plan, inputs at their bounds: every plan is converged, and the loop is that of IPOPT."""
    p = discs(discretisation)
    run = fp.simulate(p, fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-2)), seed=0)
    other = fp.simulate(p, fp.RecedingHorizon(fp.Ipopt(tolerance=1e-4)), seed=0)
    assert set(fp.measure(p, run).statuses) == set(fp.measure(p, other).statuses) == {"OK"}
    assert np.isclose(np.abs(run["command"]), 2 * np.pi).any()
    np.testing.assert_allclose(run["state"], other["state"], atol=1e-3)
    late = np.abs(run["state"][450:, [p.plant.state.elements.index(n) for n in ("first", "second", "third")]])
    assert late.max() < 0.0265


@pytest.mark.parametrize("substeps", [1, 3])
def test_steps_with_which_the_model_runs_away_are_refused_with_a_remedy(substeps):
    """RK4 multiplies the motors, which decay within a stage, by 291, by 13.7^2 or by 2.2^3 per stage."""
    p = discs(fp.RungeKutta4(substeps))
    with pytest.raises(NotSupported, match=r"multiplies a motion by .* in a stage .* use Horizon\(discretisation=Col"):
        fp.simulate(p, fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-2)), seed=0)


def pendulum(length, horizon, limits):
    """An upright pendulum, which falls with the rate sqrt(g / length)."""
    plant = fp.Plant(
        coordinates={"a": "rad"},
        inputs={"M": "N m"},
        parameters={"g": fp.Parameter(9.81, 9.81, "m/s^2")},
        response=lambda q, v, u, p: {"a": p.g / length * ca.sin(q.a) + u.M / length**2 - 0.05 * v.a},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"a": 0 * t}),
        start={"a": 0.2},
        period=0.02,
        duration=0.6,
        limits=fp.Limits(inputs={"M": (-20.0, 20.0)}, states=limits),
        horizon=fp.Horizon(stages=round(horizon / 0.04), step=0.04),
        cost=fp.Quadratic(states={"a": 10.0, "a'": 1.0}, effort={"M": 0.01}),
    )


PLANNED = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-4))


def test_a_plant_that_runs_away_itself_is_planned_with_states_of_its_own():
    """It multiplies a motion by 1e10 over the horizon; with limits of states the plans are those of IPOPT."""
    problem = pendulum(0.25, 4.0, {"a": (-0.5, 0.5)})
    run = fp.simulate(problem, PLANNED, seed=0)
    other = fp.simulate(problem, fp.RecedingHorizon(fp.Ipopt(tolerance=1e-8)), seed=0)
    assert set(fp.measure(problem, run).statuses) == {"OK"}
    np.testing.assert_allclose(run["state"], other["state"], atol=1e-4)


@pytest.mark.parametrize("horizon", [1.6, 3.0, 4.0])
def test_a_plant_that_runs_away_itself_is_planned_without_them(horizon):
    """Every plan, the first one too, is that of IPOPT and OK: a plan that lets the pendulum fall does not look stationary."""
    problem = pendulum(0.25, horizon, {})
    ocp, first, data = posed(problem)
    for tolerance in (1e-4, 1e-8):
        plan = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=tolerance), first, data)
        best = fp.solve(ocp, fp.Ipopt(tolerance=1e-8), first, data)
        assert plan.status is best.status is fp.Status.OK
        assert plan.cost == pytest.approx(best.cost, rel=1e-6)
    judged = judge(ocp)(np.zeros((1, ocp.stages)), first, data, -20.0, 20.0, np.zeros((2, ocp.stages)))
    assert float(judged[1]) > 1.0  # N m, of the plan without torque
    run = fp.simulate(problem, PLANNED, seed=0, compiled=False)
    other = fp.simulate(problem, fp.RecedingHorizon(fp.Ipopt(tolerance=1e-8)), seed=0, compiled=False)
    assert set(fp.measure(problem, run).statuses) == {"OK"}
    np.testing.assert_allclose(run["state"], other["state"], atol=1e-4)
