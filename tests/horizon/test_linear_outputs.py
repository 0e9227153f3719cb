"""Second derivatives on linearised outputs: plans for a curve that saturates, from a patient who is awake."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import tasks

import fpirhc as fp
from fpirhc.errors import NotSupported
from fpirhc.horizon.hessian_models import GaussNewton, hessian_stage
from fpirhc.horizon.transcription import transcribe

LINEAR = GaussNewton(linear_outputs=True)


def awake(own: float = 92.96, **changes: Any) -> fp.Problem:
    """The patient of the gallery without drug, with this bis; to 50 within some minutes."""
    problem = tasks.anaesthesia.problem
    parameters = problem.plant.parameters
    plant = replace(problem.plant, parameters={**parameters, "E0": replace(parameters["E0"], exact=own)})
    motion = fp.Trajectory(lambda t: {"bis": 50 + (own - 50) * (1 + t / 1.5) * ca.exp(-t / 1.5)})
    start = {"C1": 1e-3, "C2": 0.0, "C3": 0.0, "Ce": 1e-3}
    return replace(problem, plant=plant, reference=motion, start=start, duration=12.0, **changes)


def planned(problem: fp.Problem, optimiser: Any) -> fp.Run:
    return fp.simulate(problem, fp.RecedingHorizon(optimiser), seed=0, compiled=False)


def with_hessian(hessian: GaussNewton, iterations: int = 3) -> fp.FixedPoint:
    return fp.FixedPoint(iterations=iterations, tolerance=1e-1, hessian=hessian)


def test_a_squared_error_of_a_curve_is_refused_and_planned_with_linear_outputs():
    """Where nothing is given the curve is flat: its error bends downwards, and 2 h' h'^T does not."""
    with pytest.raises(NotSupported, match=r"bends upwards.*linear_outputs=True"):
        planned(awake(), with_hessian(GaussNewton()))
    run = planned(awake(), with_hessian(LINEAR))
    late = run.time > 5
    assert np.abs(run["true_error.bis"][late]).max() < 2.5
    assert run["command"][0, 0] > 10


@pytest.mark.parametrize("own", [97.0, 99.5])
def test_a_patient_above_the_models_curve_is_given_drug(own):
    """The model's curve ends at 92, and the bis of the start is beyond it."""
    run = planned(awake(own), with_hessian(LINEAR))
    assert run["command"][run.time < 2].max() > 10
    assert abs(run["true_error.bis"][-1]) < 2.5


def test_plans_are_those_of_another_solver():
    """Both minimise the same cost: Ipopt's commands, with the exact Hessian, within .3 mg/min, three times the tolerance."""
    problem = replace(awake(), duration=6.0)
    own, other = (planned(problem, one) for one in (with_hessian(LINEAR, iterations=40), fp.Ipopt(tolerance=1e-6)))
    np.testing.assert_allclose(own["command"], other["command"], atol=0.3)


def test_with_limits_of_states():
    """The concentration in the blood stays below 4.5 mg/l, also in the induction."""
    problem = awake(limits=replace(tasks.anaesthesia.problem.limits, states={"C1": (-1.0, 4.5)}))
    run = planned(problem, with_hessian(LINEAR))
    assert 4.4 < run["state.C1"].max() < 4.6
    assert np.abs(run["true_error.bis"][run.time > 8]).max() < 2.5


def test_a_live_weight_is_refused_and_the_cause_is_named():
    with pytest.raises(
        NotSupported, match=r"'cost\.outputs\.bis' cannot be live .* and without linear_outputs, or leave"
    ):
        fp.simulator(awake(), fp.RecedingHorizon(with_hessian(LINEAR)), live=["cost.outputs.bis"], compiled=False)


def test_the_hessian_is_that_of_the_slopes():
    """Q = 2 w h' h'^T plus the rate's, by differences of the output in numpy."""
    problem = awake(cost=fp.Quadratic(outputs={"bis": 1.0}, rate={"infusion": 1e-5}))
    assert problem.horizon is not None
    assert problem.cost is not None
    task = problem.plant, problem.reference, problem.horizon, problem.cost, problem.limits
    ocp = transcribe(*task, start=problem.start_state)
    state, command, data = (part[:, 3] for part in ocp.nodes)
    state = state + np.array([1.0, 0.2, 0.1, 2.0, 0.0])
    q, _, _ = (np.asarray(m.full()) for m in hessian_stage(LINEAR.of(ocp), LINEAR)(state, command, data, np.zeros(5)))
    own = dict(zip(problem.plant.parameter.elements, problem.plant.approximate, strict=True))
    curve = lambda c: own["E0"] / (1 + (c / own["C50"]) ** own["steepness"])  # noqa: E731 -- the formula of the file
    slope = (curve(state[3] + 1e-5) - curve(state[3] - 1e-5)) / 2e-5
    assert q[3, 3] == pytest.approx(2 * ocp.step * slope**2, rel=1e-6)
    assert np.linalg.eigvalsh(q).min() > -1e-9


def test_where_outputs_are_states_nothing_changes():
    problem = fp.load_problem("van_der_pol").problem
    assert problem.horizon is not None
    assert problem.cost is not None
    ocp = transcribe(problem.plant, problem.reference, problem.horizon, problem.cost, problem.limits)
    state, command, data = (part[:, 3] for part in ocp.nodes)
    arguments = state + 0.3, command, data, np.ones(len(state))
    for one, other in zip(
        hessian_stage(ocp, GaussNewton())(*arguments), hessian_stage(LINEAR.of(ocp), LINEAR)(*arguments), strict=True
    ):
        np.testing.assert_allclose(one.full(), other.full(), rtol=1e-12)
