"""Plans that keep a margin from limits of states: margins along the horizon, and margins computed for a wrong model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from forms import named_again
from reviewed import linear

import fpirhc as fp
from fpirhc.errors import InvalidProblem, InvalidValue, NotSupported
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.review.response_prediction import _reached, state_margins

LIMIT = 0.8


def carriage(mass: float = 1.0, believed: float = 1.3) -> fp.Problem:
    """A carriage on a track that is shorter than what it is to follow."""
    plant = fp.Plant(
        coordinates={"q": "m"},
        inputs={"F": "N"},
        response=lambda q, v, u, p: {"q": (u.F - 2.0 * q.q - 0.4 * v.q) / p.m},
        parameters={"m": fp.Parameter(believed, mass, "kg")},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"q": ca.sin(2 * t)}),
        start={"q": 0.0, "q'": 2.0},
        period=0.01,
        duration=3.5,
        measure_from=1.0,
        limits=fp.Limits(inputs={"F": (-20.0, 20.0)}, states={"q": (-LIMIT, LIMIT), "q'": (-2.5, 2.5)}),
        horizon=fp.Horizon(stages=20, step=0.05),
        cost=fp.Quadratic(states={"q": 100.0, "q'": 1.0}, effort={"F": 1e-3}),
    )


def adaptive(gain: float = -1.0) -> fp.RecedingHorizon:
    return fp.RecedingHorizon(fp.FixedPoint(iterations=20, tolerance=1e-6), fp.Affine(gain))


def plain() -> fp.RecedingHorizon:
    return replace(adaptive(), deformation=fp.Identity())


def beyond(problem: fp.Problem, controller: Any) -> float:
    """The largest violation of the track's end after the first second."""
    run = fp.simulate(problem, controller, seed=0)
    assert run.stop is None
    return float(np.abs(run["state"][100:, 0]).max() - LIMIT)


def test_a_margin_narrows_the_plan_by_its_number_at_every_stage():
    """On the bound of the stage where the margin is active, like IPOPT's plan with the same margins."""
    margins = tuple(0.01 * (i + 1) for i in range(20))
    problem = carriage()
    assert problem.horizon is not None
    horizon = replace(problem.horizon, margins={"q": margins})
    assert problem.cost is not None
    ocp = transcribe(problem.plant, problem.reference, horizon, problem.cost, problem.limits)
    data = np.asarray(stage_data(problem.plant, problem.reference, horizon, problem.cost)(0.3, [1.3]).full())
    first = np.asarray(ocp.start([0.55, 1.4], [0.0]).full()).ravel()
    plan = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=1e-7), first, data)
    assert plan.status == fp.Status.OK
    room = LIMIT - np.array(margins) - np.asarray(plan.states)[0, 1:]
    assert room.min() == pytest.approx(0.0, abs=1e-5)
    other = fp.solve(ocp, fp.Ipopt(tolerance=1e-9), first, data)
    assert plan.cost == pytest.approx(other.cost, rel=1e-4)


def test_with_the_right_model_there_is_no_margin():
    """Nothing deviates without adaptation; plain adaptation takes the drift within a cycle for an error of the model."""
    margins = state_margins(carriage(1.0, 1.0), plain(), passes=0)
    assert set(margins) == {"q", "q'"}
    assert max(max(m) for m in margins.values()) < 1e-9


def test_margins_grow_along_the_horizon_and_with_the_error_of_the_model():
    near, far = (state_margins(carriage(1.0, m), plain(), passes=0) for m in (1.1, 1.4))
    for name in ("q", "q'"):
        assert np.all(np.diff(near[name]) >= 0)
        assert far[name][-1] > near[name][-1] > 0


def test_a_limit_that_the_wrong_model_breaks_is_kept_with_margins():
    """Plain control leaves its track, adaptation leaves it by less, and with margins the plant stays inside."""
    problem = carriage()
    alone, adapted = beyond(problem, plain()), beyond(problem, adaptive())
    assert alone > 1e-3
    assert 0 < adapted < 0.5 * alone
    assert beyond(problem, fp.tightened(problem, adaptive())) <= 1e-6


@pytest.mark.slow
def test_margins_keep_the_limits_of_a_plant_by_its_outputs():
    """The same carriage with its place as an output needs nearly the same margins, and keeps its track with them."""
    in_place = replace(carriage(), duration=5.0)
    problem = named_again(in_place)
    own, again = (state_margins(p, adaptive(), passes=0) for p in (in_place, problem))
    for name, margins in own.items():
        np.testing.assert_allclose(again[name], margins, rtol=0.2)
    assert beyond(problem, adaptive()) > 1e-4
    assert beyond(problem, fp.tightened(problem, adaptive())) <= 1e-6


def test_margins_for_a_box_of_parameters_are_at_least_those_of_the_plant():
    own, boxed = (state_margins(carriage(), adaptive(), mismatch=m, passes=0) for m in (None, 20.0))
    assert boxed["q"][-1] >= own["q"][-1]


def test_predicted_margins_are_those_of_the_deviations_in_their_order():
    """A single jump counts once, and what comes after it as the loop carries it on; one in every cycle counts every time."""
    dynamics = np.array([[0.9, 0.1], [-0.4, 0.7]])
    loop = linear(dynamics, np.zeros((2, 1)), np.zeros((1, 2)), np.arange(2), 0.01)
    once = np.zeros((40, 2))
    once[3] = (0.0, 1.0)
    powers = [np.abs(np.linalg.matrix_power(dynamics, k)[:, 1]) for k in range(10)]
    sums = np.cumsum(powers, axis=0)
    assert np.allclose(_reached(loop, 10, once), np.maximum.accumulate(powers))
    assert np.allclose(_reached(loop, 10, np.tile((0.0, 1.0), (40, 1))), sums)


def test_verified_margins_keep_what_predicted_ones_do_not():
    """The run with margins differs from the run that predicts them, and a limit holds at stages only."""
    problem = replace(carriage(), duration=2.5)
    predicted = fp.tightened(problem, adaptive(), passes=0, widen=0.2)
    assert beyond(problem, predicted) > 1e-6
    verified = fp.tightened(problem, adaptive(), widen=0.2)
    assert beyond(problem, verified) <= 1e-6


@pytest.mark.slow
def test_margins_verified_on_a_box_of_parameters_serve_a_plant_in_it():
    boxed = fp.tightened(carriage(), adaptive(), mismatch=10.0)
    assert beyond(carriage(mass=1.04), boxed) <= 1e-6


def test_mistakes_are_named():
    problem = replace(carriage(), duration=1.2)
    free = replace(problem, limits=fp.Limits())
    with pytest.raises(InvalidProblem, match="no hard limits of states"):
        fp.tightened(free, adaptive())
    with pytest.raises(NotSupported, match="has no plan that could keep margins"):
        fp.tightened(problem, fp.ComputedTorque(fp.Exponential(rate=6.0)))
    with pytest.raises(InvalidValue, match=r"widen: .* got 0"):
        fp.tightened(problem, adaptive(), widen=0)
    with pytest.raises(InvalidValue, match=r"passes: .* got -1"):
        fp.tightened(problem, adaptive(), passes=-1)
    with pytest.raises(NotSupported, match=r"after 1 runs the plant still passes its limits \('q' by"):
        fp.tightened(problem, adaptive(), passes=1, widen=0.01)
    with pytest.raises(InvalidProblem, match="leaves nothing between its limits"):
        fp.tightened(problem, adaptive(), widen=1000.0)
    with pytest.raises(InvalidValue, match="one for every stage"):
        fp.Horizon(stages=3, step=0.1, margins={"q": (0.1,)})
    with pytest.raises(InvalidProblem, match="margins: limit of state 'p'"):
        replace(adaptive(), margins={"p": (0.0,) * 20}).check(problem)
    for limits in (replace(problem.limits, soft={"q": 10.0}), replace(problem.limits, prices={"q": 10.0})):
        yielding = replace(problem, limits=limits)
        assert set(state_margins(yielding, adaptive(), passes=0)) == {"q'"}
        with pytest.raises(InvalidProblem, match="margins of 'q': its limit is soft or has a price"):
            replace(adaptive(), margins={"q": (0.01,) * 20}).check(yielding)


@pytest.mark.parametrize("weights", [{"rate": {"F": 1.0}}, {}])
def test_the_rate_of_a_plan_counts_from_the_command_without_its_shift(weights):
    """A constant force that the model lacks: with the shift in its rate, a plan would pay for it for ever and stay off.

    Without a weight of the rate the error is that of the horizon alone, and the same.
    """
    plant = fp.Plant(
        coordinates={"q": "m"},
        inputs={"F": "N"},
        order=1,
        response=lambda q, u, p: {"q": u.F - q.q + p.d},
        parameters={"d": fp.Parameter(0.0, 2.0, "N")},
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"q": 0 * t}),
        start={"q": 0.0},
        period=0.01,
        duration=6.0,
        limits=fp.Limits(),
        horizon=fp.Horizon(stages=20, step=0.05),
        cost=fp.Quadratic(states={"q": 10.0}, **weights),
    )
    run = fp.simulate(
        problem, fp.RecedingHorizon(fp.FixedPoint(iterations=50, tolerance=1e-9), fp.Affine(-1.0)), seed=0
    )
    assert np.abs(run["state"][-50:, 0]).max() < 1e-6


def test_a_run_with_blocks_and_margins_is_measured():
    """Its cost is that of the problem's stage, which has neither."""
    problem = carriage()
    assert problem.horizon is not None
    shaped = replace(
        problem,
        duration=0.3,
        measure_from=0.0,
        horizon=replace(problem.horizon, blocks=(1,) * 10 + (5, 5), margins={"q": (0.01,) * 20}),
    )
    run = fp.simulate(shaped, adaptive(), seed=0)
    assert np.isfinite(run["cost"]).all()
