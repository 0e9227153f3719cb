"""Outputs that the wrong model computes, in a plan or in place of a measurement: what `anaesthesia` loses by them, by value."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.horizon.stage_data import shifted_reference

problem = cache(lambda: tasks.anaesthesia.problem)
plant = cache(lambda: tasks.anaesthesia.problem.plant)


@pytest.mark.parametrize(("name", "described"), [("RHC", 2.29), ("RHC+FPI", 0.00875)])
def test_a_plan_along_the_models_own_outputs_stays_at_the_wrong_one(name, described, monkeypatch):
    """Without d, the measured outputs minus the model's, a plan from the measured state ends where the wrong curve says that it is.

    A plan from the state at which the model has the measured outputs does not: there d is zero.
    """

    def unshifted(*arguments, **settings):
        function = shifted_reference(*arguments, **settings)
        symbols = [ca.MX.sym(function.name_in(k), *function.size_in(k)) for k in range(function.n_in())]
        return ca.Function("unshifted", symbols, symbols[:1])

    monkeypatch.setattr("fpirhc.controllers.receding_horizon.shifted_reference", unshifted)
    run = fp.simulate(problem(), tasks.anaesthesia.controllers[name], seed=0, compiled=False)
    assert fp.measure(problem(), run).rms_error["bis"] == pytest.approx(described, abs=0.01)


def judged_by(curve: np.ndarray, name: str) -> float:
    """Rms error of bis of a controller that is given the outputs and the response that a curve makes of the real states.

    Their derivatives are those along the real motion: an observer that is right about everything but the curve.
    """
    x, u, p, real = (ca.SX.sym(n, s) for n, s in (("x", 4), ("u", 1), ("p", 4), ("real", 4)))
    rate = plant().equations.rate(x, u, real)
    chain = [plant().equations.output(x, u, p, ca.SX.zeros(4))[0]]
    for _ in range(2):
        chain.append(ca.jtimes(chain[-1], x, rate))
    shown = ca.Function("shown", [x, u, p, real], [ca.vertcat(*chain)])
    wanted = problem().reference.function(plant())
    advance = problem().integrator.step(plant(), problem().period)
    stepper = fp.Stepper(problem(), tasks.anaesthesia.controllers[name], compiled=False)
    memory, state, command, realised = stepper.start(), problem().start_state.copy(), np.zeros(1), np.zeros(1)
    errors = []
    for k in range(problem().cycles):
        time, depth = k * problem().period, float(shown(state, command, plant().exact, plant().exact)[0])
        errors.append(depth - float(wanted(time)[0][0]))
        seen = np.asarray(shown(state, command, curve, plant().exact).full()).ravel()
        command, memory = stepper.step(time, state, realised, memory, output=seen[:2])
        state = np.asarray(advance(state, command, plant().exact, np.zeros(4)).full()).ravel()
        realised = np.asarray(shown(state, command, curve, plant().exact).full()).ravel()[2:]
    late = np.array(errors[round(problem().measure_from / problem().period) :])
    return float(np.sqrt(np.mean(late**2)))


def test_the_iteration_helps_with_measured_outputs_and_not_with_those_of_the_wrong_curve():
    """It corrects the derivative of what it is shown: eleven times better, and no better at all."""
    measured = [judged_by(plant().exact, name) for name in ("CTC", "CTC+FPI")]
    modelled = [judged_by(plant().approximate, name) for name in ("CTC", "CTC+FPI")]
    assert measured == pytest.approx([0.142, 0.0126], rel=0.01)
    assert modelled == pytest.approx([2.33, 2.34], rel=0.01)
