"""What is predicted before a run against the run: response errors, benefit, null runs, and the tube."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import abroad
import numpy as np
import pytest
from chains import chain
from forms import named_again
from kinds import slow_but

import fpirhc as fp
from fpirhc.contraction.delayed import least_product
from fpirhc.contraction.spectrum import response_jacobians
from fpirhc.errors import InvalidValue, NotSupported
from fpirhc.review.prediction import nominal_run, null_errors, response_errors
from fpirhc.review.response_prediction import majorant, tube
from fpirhc.simulation.linearise.asked_loop import AskedLoop
from fpirhc.simulation.model_as_plant import exactly, shortened

SCALES = {"two_mass": 20.0, "mrac_pendulum": 50.0}  # m/s^2, rad/s^2; 50 for the others


def undisturbed(name: str) -> fp.Problem:
    return replace(fp.load_problem(name).problem, disturbances={}, sensing=fp.Sensing(), dead_time=fp.DeadTime())


def controller(name: str, which: str, gain: float, form=lambda m: m) -> Any:
    """A controller of a shipped problem with the sigmoid of that gain."""
    controllers_value = fp.load_problem(name).controllers[which]
    return controllers_value.with_deformation(form(fp.Sigmoid(gain=gain, shift=0.3, scale=SCALES.get(name, 50.0))))


@cache
def nominal(name: str, which: str):
    return nominal_run(undisturbed(name), controller(name, which, -0.5))


def increment(map_):
    return fp.Increment(map_, cycles=0)


@pytest.mark.parametrize("gain", slow_but([-0.5, -1.5], -1.5))
@pytest.mark.parametrize("form", [lambda m: m, increment], ids=["plain", "increment"])
@pytest.mark.parametrize("which", ["CTC", "RHC"])
def test_recursion_predicts_the_loop(which, form, gain):
    """Two masses, a lambda up to 0.9: the largest and the rms response error of the run within 5 % of the prediction."""
    problem, tested = undisturbed("two_mass"), controller("two_mass", which, gain, form)
    run = fp.simulate(problem, tested, seed=0)
    predicted = response_errors(nominal("two_mass", which), deformation=tested.deformation).error[3000:]
    plant = problem.plant
    exact = np.repeat(plant.exact[:, None], run.cycles, axis=1)
    respond = plant.equations.controlled_response.map(run.cycles)
    real = (respond(run["state"].T, run["command"].T, exact).full().T - run["desired"])[3000:]
    for size in (lambda e: np.abs(e).max(axis=0), lambda e: np.sqrt(np.mean(e**2, axis=0))):
        np.testing.assert_allclose(size(predicted), size(real), rtol=0.05)


@pytest.mark.parametrize(
    ("name", "which"),
    [("two_mass", "CTC+FPI (eq 3)"), ("two_mass", "RHC+FPI"), ("crane_slots", "RHC+FPI"), ("planar_arm", "CT+FPI")],
)
def test_recursion_is_the_loop_led_along_the_nominal_states(name, which):
    """Commands of the loop itself, whose plant is put at the nominal state after every cycle, to rounding."""
    task = fp.load_problem(name)
    problem = replace(shortened(task.problem, 300), disturbances={}, sensing=fp.Sensing())
    model = nominal_run(problem, task.controllers[which], compiled=False)
    both = []
    for exact in (problem.plant.exact, model.believed):
        both.append(led_along(model, exact, "command"))
        predicted = response_errors(model, exact=exact).command[: len(both[-1])]
        np.testing.assert_allclose(predicted, both[-1], rtol=1e-9, atol=1e-9 * np.abs(both[-1]).max())
    assert np.abs(both[0][:40] - both[1][:40]).max() > 1e-3 * np.abs(both[0]).max()  # not without any adaptation


def led_along(model: Any, exact: np.ndarray, name: str) -> np.ndarray:
    """A signal of the loop whose plant is put at the nominal state after every cycle, to where the loop has come to rest."""
    loop = AskedLoop(model.problem, model.controller)
    trace = loop.run(loop.start(exact=exact), model.cycles, model.states[1:]).trace
    assert len(trace) > 40
    return trace[:, loop.loop.trace.slice(name)]


def test_led_map_answers_as_it_is_led():
    """The response of a map is its next state, so that a loop led along states shows no response of the plant: see 0092."""
    task = fp.load_problem("fishery")
    model = nominal_run(task.problem, task.controllers["CTC+FPI"], compiled=False)
    both = [led_along(model, exact, "realised") for exact in (task.problem.plant.exact, model.believed)]
    np.testing.assert_allclose(both[0], both[1], rtol=1e-9)
    errors = [response_errors(model, exact=exact).error for exact in (task.problem.plant.exact, model.believed)]
    assert np.abs(errors[0]).max() > 1e6 * np.abs(errors[1]).max()


def test_led_plant_shows_the_outputs_of_its_own_parameters():
    """Which are not those of the nominal run, so that the loop led along its states wants other responses: see 0092."""
    task = fp.load_problem("anaesthesia")
    model = nominal_run(shortened(task.problem, 300), task.controllers["CTC+FPI"], compiled=False)
    right = led_along(model, task.problem.plant.exact, "desired")
    np.testing.assert_allclose(right, model.desired[: len(right)], rtol=1e-9, atol=1e-9)
    null = led_along(model, model.believed, "desired")
    assert np.abs(null - model.desired[: len(null)]).max() > np.abs(model.desired).max()


@pytest.mark.parametrize(
    ("name", "which"),
    [("fishery", "CTC+FPI"), ("fishery", "RHC+FPI"), ("anaesthesia", "CTC+FPI"), ("stick_slip", "CTC+FPI")],
)
def test_recursion_predicts_what_no_led_loop_shows(name, which):
    """Rms response error of the run: a map, a plant of outputs, one with a state that moves by itself; see 0092."""
    task = fp.load_problem(name)
    problem, tested = replace(task.problem, disturbances={}, sensing=fp.Sensing()), task.controllers[which]
    model = nominal_run(problem, tested, compiled=False)
    wrong, right = (
        rms_of_run(p, tested) for p in (problem, replace(problem, plant=exactly(problem.plant, model.believed)))
    )
    first = round(problem.measure_from / problem.period)
    predicted = [float(np.sqrt(np.mean(e.error[first:] ** 2))) for e in (response_errors(model), null_errors(model))]
    assert predicted[0] == pytest.approx(wrong, rel=0.05)
    assert predicted[1] == pytest.approx(right, rel=0.05, abs=0.1 * wrong)


def rms_of_run(problem: fp.Problem, tested: Any) -> float:
    """Rms response error of a run, of plants with one response."""
    run, first = fp.simulate(problem, tested, seed=0), round(problem.measure_from / problem.period)
    exact = np.tile(problem.plant.exact, (run.cycles, 1))
    answers = problem.plant.equations.controlled_response.map(run.cycles)
    real = answers(run["state"][: run.cycles].T, run["command"][: run.cycles].T, exact.T).full().T
    return float(np.sqrt(np.mean((real - run["desired"][: run.cycles])[first:] ** 2)))


def test_recursion_is_the_formula_on_a_linear_plant():
    """Plain form, f = lambda r + c: e+ = (1 - a lambda) e - (1 - a lambda) (d+ - d), to rounding."""
    problem = replace(chain(2, 1.5), duration=0.5, reference=fp.Trajectory(lambda t: {"y": 0.1 * t**3}))
    model = nominal_run(problem, fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain=-0.8)), compiled=False)
    error = response_errors(model).error[:, 0]
    factor, change = 1 - 0.4 * 1.5, np.diff(model.desired[:, 0])
    assert error[0] == pytest.approx(0.5 * model.desired[0, 0], abs=1e-12)
    np.testing.assert_allclose(error[1:], factor * error[:-1] - factor * change, atol=1e-12)


def test_right_model_and_no_deformation_leave_no_error():
    """The null run without a deformation: the model answers as it was asked."""
    model = nominal("two_mass", "RHC")
    nothing = response_errors(model, deformation=fp.Identity(), exact=model.believed)
    assert np.abs(nothing.error).max() < 1e-9
    assert np.abs(nothing.force).max() < 1e-9


@pytest.mark.parametrize(("gain", "form"), [(-0.5, lambda m: m), (-0.5, increment), (-1.5, lambda m: m)])
def test_null_run_is_predicted(gain, form):
    """The model for the plant, with adaptation: the run's response error, which harms nobody but is not zero, within 5 %."""
    problem, tested = undisturbed("two_mass"), controller("two_mass", "RHC", gain, form)
    right = {n: replace(p, exact=p.approximate) for n, p in problem.plant.parameters.items()}
    exact = replace(problem, plant=replace(problem.plant, parameters=right))
    run, model = fp.simulate(exact, tested, seed=0), nominal("two_mass", "RHC")
    predicted = response_errors(model, deformation=tested.deformation, exact=model.believed).error[3000:]
    respond = exact.plant.equations.controlled_response.map(run.cycles)
    believed = np.repeat(exact.plant.exact[:, None], run.cycles, axis=1)
    real = (respond(run["state"].T, run["command"].T, believed).full().T - run["desired"])[3000:]
    assert np.sqrt(np.mean(real**2)) > 0.05
    assert np.sqrt(np.mean(predicted**2)) == pytest.approx(np.sqrt(np.mean(real**2)), rel=0.05)


def test_informed_controller_has_nothing_to_adapt_to():
    """Told the exact parameters, a controller with a deformation is its own null run."""
    diagnostics = fp.ExactModel(controller("two_mass", "CTC", -0.5))
    predicted = fp.predict_response(replace(undisturbed("two_mass"), duration=0.5, measure_from=0.2), diagnostics)
    np.testing.assert_allclose(predicted.adapted.error, predicted.null.error, rtol=0, atol=1e-13)
    assert max(predicted.rms(predicted.without).values()) < 1e-9
    assert not predicted.helps


INSIDE = {
    ("two_mass", "CTC"): (-1.5,),  # the others of the three gains are slow
    ("van_der_pol_duffing", "RHC"): (-1.5,),
    ("mrac_pendulum", "CTC"): (-1.5,),
    ("two_mass", "RHC"): (),
    ("two_link_arm", "RHC"): (),
    ("planar_arm", "CT"): (),
    ("puma560", "CT"): (),
    ("three_link_arm", "CT"): (),
}


@pytest.mark.parametrize(
    ("name", "which", "gain"),
    [
        pytest.param(*case, gain, marks=[pytest.mark.slow] * (gain not in quick))
        for case, quick in INSIDE.items()
        for gain in (-0.5, -1.0, -1.5)
    ],
)
def test_run_is_inside_its_tube(name, which, gain):
    """Every state from the settled part of the run on is inside the tube, widened by a tenth of its largest half-width.

    The first coordinate of PUMA 560 is 9.7 % outside at gain -0.5, so a tenth is what it takes.
    """
    problem, tested = undisturbed(name), controller(name, which, gain)
    predicted: Any = fp.predict_response(problem, tested)
    run = fp.simulate(problem, tested, seed=0)
    assert run.stop is None
    assert predicted.helps
    first = round(problem.measure_from / problem.period)
    deviation = np.abs(run["state"] - predicted.nominal.states)[first:]
    half = predicted.tube[first:]
    assert (deviation <= half + 0.1 * half.max(axis=0)).all()
    coordinates = [problem.plant.state.elements.index(c) for c in problem.plant.names]
    # Not empty words: the largest deviations are a good part of the tube, however alike the signs of its parts are.
    assert (deviation.max(axis=0) > half.max(axis=0) / 6)[coordinates].all()
    assert predicted.half_width[problem.plant.names[0]] == half.max(axis=0)[0]


def test_tube_of_outputs_is_that_of_the_same_coordinates():
    """For a tracking law, whose run of the right model is the same; to what a wrong model changes within a cycle."""
    problem, tested = (
        replace(undisturbed("two_mass"), duration=3.0, measure_from=1.0),
        controller("two_mass", "CTC", -0.5),
    )
    own, again = (fp.predict_response(p, tested, compiled=False) for p in (problem, named_again(problem)))
    assert again.tube is not None
    for name, half in own.half_width.items():
        assert again.half_width[name] == pytest.approx(half, rel=0.01)


def test_tube_of_a_tracking_law_has_its_closed_form():
    """A constant force w: 4 e^-2 w / Lambda^2 at the coordinate and 0.620 w / Lambda at its rate, three poles at -Lambda."""
    rate = 6.0
    problem = replace(chain(2, 1.0), duration=5.0)
    model = nominal_run(problem, fp.ComputedTorque(fp.Exponential(rate=rate), fp.Affine(gain=-0.5)), compiled=False)
    ones = replace(response_errors(model), error=np.ones((model.cycles, 1)), force=np.ones((model.cycles, 1)))
    half = tube(model, ones, 0.0)[-1]
    assert half[0] == pytest.approx(4 * np.exp(-2) / rate**2, rel=0.02)
    assert half[1] == pytest.approx(0.620 / rate, rel=0.02)


@pytest.mark.parametrize("gain", [-0.5, -2.52])
def test_majorant_is_above_the_error(gain):
    """At every cycle and for every coordinate, with alternating and with smooth errors."""
    model = nominal("two_mass", "RHC")
    sigmoid = fp.Sigmoid(gain=gain, shift=0.3, scale=20.0)
    errors = response_errors(model, deformation=sigmoid)
    bound = majorant(model, errors, sigmoid.effective_gain())
    assert (bound >= np.abs(errors.error) - 1e-12).all()
    assert bound.max() < 10 * np.abs(errors.error).max()


def test_majorant_is_the_largest_error_of_all_signs():
    """Parts p_k of alternating signs give errors below it, and the signs of the products of I - a J reach it in the last cycle."""
    model, gain = nominal("two_link_arm", "RHC"), -0.5
    sigmoid = fp.Sigmoid(gain=gain, shift=0.3, scale=50.0)
    errors = response_errors(model, deformation=sigmoid)
    bound = majorant(model, errors, sigmoid.effective_gain())
    rows = np.tile(model.problem.plant.exact, (model.cycles, 1))
    jacobians = response_jacobians(model.problem.plant, model.states[:-1], model.desired, rows, model.believed)
    factors = np.eye(2) - sigmoid.effective_gain() * jacobians
    parts, last = errors.error.copy(), model.cycles - 1
    parts[1:] -= np.einsum("kij,kj->ki", factors[1:], errors.error[:-1])
    carried, worst = np.eye(2), np.zeros(2)
    for k in range(last, last - 200, -1):
        worst += np.abs(carried) @ np.abs(parts[k])
        carried = carried @ factors[k]
    np.testing.assert_allclose(bound[last], worst, rtol=1e-4)
    assert (bound[last] <= (np.abs(factors[last]) @ bound[last - 1] + np.abs(parts[last])) * (1 + 1e-9)).all()


@pytest.mark.slow
def test_box_widens_the_tube():
    """With a box of parameters the tube is the largest of its draws, so nowhere narrower."""
    problem, selection = (
        replace(undisturbed("mrac_pendulum"), duration=2.0, measure_from=1.0),
        controller("mrac_pendulum", "CTC", -0.5),
    )
    own: Any = fp.predict_response(problem, selection)
    boxed: Any = fp.predict_response(problem, selection, mismatch=20.0)
    assert (boxed.tube >= own.tube - 1e-12).all()
    assert boxed.tube.max() > 1.05 * own.tube.max()
    assert "helps" in repr(own)
    assert "Predicted" in own._repr_html_()


def test_no_tube_where_the_loop_does_not_converge():
    """A plain form that is too slow for its tracking law: errors along the nominal run vanish, but the loop is unstable."""
    slow = fp.Affine(gain=-2 * 0.5 * least_product(3, 6.0, 1e-3))
    predicted = fp.predict_response(
        replace(chain(2, 1.5), duration=1.0), fp.ComputedTorque(fp.Exponential(rate=6.0), slow), compiled=False
    )
    assert predicted.tube is None
    assert "does not converge" in predicted.reason
    assert predicted.half_width == {}


def test_prediction_refuses_what_it_does_not_cover():
    """Dead time, estimated responses, no adaptation, a mismatch out of range; a coordinate that is not controlled has no tube."""
    problem, controllers_value = undisturbed("two_mass"), controller("two_mass", "CTC", -0.5)
    with pytest.raises(NotSupported, match="dead time"):
        fp.predict_response(replace(problem, dead_time=fp.DeadTime(inputs={"Q1": 1e-3})), controllers_value)
    with pytest.raises(NotSupported, match="estimated response"):
        fp.predict_response(replace(problem, sensing=fp.Sensing(estimator=fp.PositionDifference())), controllers_value)
    with pytest.raises(NotSupported, match="no deformation"):
        fp.predict_response(problem, fp.ComputedTorque(fp.Exponential(rate=6.0)))
    with pytest.raises(InvalidValue, match="mismatch"):
        fp.predict_response(problem, controllers_value, mismatch=-1.0)
    motor = fp.load_problem("mrac_pendulum")
    with pytest.raises(NotSupported, match="ForceMRAC"):
        fp.predict_response(motor.problem, motor.controllers["force MRAC"])
    servo = abroad.load("flexible_servo").problem
    predicted = fp.predict_response(
        replace(servo, duration=0.2, measure_from=0.0),
        fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain=-0.5)),
    )
    assert "not controlled" in predicted.reason
