"""The model-referenced form: an exact model is left alone; an estimate and incremental inversion are its cases; its worth."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.exchange import with_exact_model
from helpers.iteration import affine
from helpers.kinds import shipped

import fpirhc as fp
from fpirhc.errors import NotSupported

LAW = fp.Exponential(rate=6.0)


def short(problem: fp.Problem, cycles: int) -> fp.Problem:
    return replace(problem, duration=cycles * problem.period, measure_from=0.0)


def noisy(problem: fp.Problem, deviation: float = 1.0) -> fp.Problem:
    """White noise on the measured accelerations, m/s^2."""
    return replace(problem, sensing=fp.Sensing({q: fp.Sensor(noise=fp.Noise(deviation)) for q in ("q1''", "q2''")}))


def modelled(problem: fp.Problem, run: fp.Run) -> np.ndarray:
    """The model's response at every state of a run to the command of the cycle before."""
    plant = problem.plant
    x, u = ca.SX.sym("x", plant.state.size), ca.SX.sym("u", plant.input.size)
    response = ca.Function("f", [x, u], [plant.equations.controlled_response(x, u, ca.DM(plant.approximate))])
    before = np.vstack([np.zeros(plant.input.size), run["command"][:-1]])
    return np.asarray(response.map(len(before))(run["state"].T, before.T).full()).T


def commands(problem: fp.Problem, run: fp.Run, requests: np.ndarray) -> np.ndarray:
    """The commands that the model needs for these requests at the states of a run."""
    plant = problem.plant
    x, r = ca.MX.sym("x", plant.state.size), ca.MX.sym("r", len(plant.controlled_names))
    inverse = ca.Function("u", [x, r], [plant.equations.inverse(x, r, plant.approximate)])
    return np.asarray(inverse.map(len(requests))(run["state"].T, requests.T).full()).T


@pytest.mark.parametrize("gain", [0.1, 0.4, 1.0])
def test_affine_map_is_the_additive_disturbance_estimate(gain):
    """w+ = w + a (f - f^ - w), r = d - w, computed here from the run's signals alone, gives its commands to 1e-12, in noise."""
    problem = short(noisy(tasks.two_mass.problem), 2000)
    run = fp.simulate(problem, fp.ComputedTorque(LAW, fp.ModelReferenced(affine(gain))), seed=4, compiled=False)
    seen = run["realised"] - modelled(problem, run)
    estimate, requests = np.zeros(2), run["desired"].copy()
    for k in range(1, run.cycles):
        estimate = (1 - gain) * estimate + gain * seen[k]
        requests[k] -= estimate
    expected = commands(problem, run, requests)
    assert np.abs(run["command"] - expected).max() <= 1e-12 * np.abs(expected).max()


def test_unit_gain_is_incremental_inversion():
    """u_k = u_{k-1} + B^-1 (d_k - f_k): the model's drift cancels."""
    problem = short(noisy(tasks.two_mass.problem), 2000)
    run = fp.simulate(problem, fp.ComputedTorque(LAW, fp.ModelReferenced(affine(1.0))), seed=4, compiled=False)
    zero = commands(problem, run, np.zeros((run.cycles, 2)))
    moves = commands(problem, run, run["desired"] - run["realised"]) - zero
    expected = run["command"][:-1] + moves[1:]
    assert np.abs(run["command"][1:] - expected).max() <= 1e-12 * np.abs(expected).max()


# Plans that end at their tolerance, along a hard limit, tell rounding apart: of 3e-16 in a state the next ones make 1e-7, and
# 2e-5 where speed limits are planned too.
AMPLIFIED = {"freeway_economic": 1e-6, "freeway_coordinated": 1e-4}


@pytest.mark.parametrize(
    "name", shipped("building", "chain_of_masses", "anaesthesia", "noisy_motor", "delayed_mass", "freeway")
)
def test_exact_model_is_left_alone(name):
    """On every shipped problem, behind its sensors and dead time, quanta included: no state changes beyond rounding."""
    task: Any = fp.load_problem(name)
    adaptive = task.controllers[task.headline[1]]
    if not adaptive.deformation.adapts or adaptive.deforms != "response":
        pytest.skip("its headline deforms no response")
    if name == "diabetes_announced":
        pytest.skip("its meals end within a step of the model, which only its reality can have")
    late = task.problem.dead_time  # whole cycles, by which a model can be late
    late = replace(late, measurement=np.ceil(late.measurement / task.problem.period) * task.problem.period)
    problem = with_exact_model(replace(task.problem, dead_time=late))
    problem = short(problem, min(100, problem.cycles))
    sign = -1.0 if adaptive.deformation.effective_gain() < 0 else 1.0
    map = fp.Sigmoid(gain=-0.5 * sign, shift=0.3 * sign, scale=50.0)
    plain, run = (
        fp.simulate(problem, adaptive.with_deformation(d), seed=0, compiled=False)["plant_state"]
        for d in (fp.Identity(), fp.ModelReferenced(map))
    )
    assert np.abs(run - plain).max() <= AMPLIFIED.get(name, 1e-9) * np.abs(plain).max()


# Largest rms error of the coordinates in mm: controller, deformation, what an independent prototype found
TRACKING = (
    ("CTC", fp.Sigmoid(gain=-2.52, scale=50.0), 0.852),
    ("CTC", fp.ModelReferenced(fp.Sigmoid(gain=-2.52, scale=50.0)), 0.116),
    ("RHC", fp.Sigmoid(gain=-0.5, scale=20.0), 0.5255),
    ("RHC", fp.ModelReferenced(fp.Sigmoid(gain=-0.5, scale=20.0)), 0.401),
)


@pytest.mark.parametrize(("name", "deformation", "expected"), TRACKING)
def test_two_mass_figures(name, deformation, expected):
    """Tracking with the wrong model, against another implementation of the same formulas, within 5 %."""
    run = fp.simulate(tasks.two_mass.problem, tasks.two_mass.controllers[name].with_deformation(deformation), seed=0)
    errors = fp.measure(tasks.two_mass.problem, run).rms_error
    assert 1e3 * max(errors.values()) == pytest.approx(expected, rel=0.05)


CASES = (
    (
        fp.Filtered(fp.ModelReferenced(affine(0.5)), pole=0.5),
        r"Filtered around a model-referenced form.*ModelReferenced\(Filtered",
    ),
    (fp.Tuned(fp.ModelReferenced(affine(0.5)), largest_gain=0.9), "put it inside"),
    (fp.Paired(fp.ModelReferenced(affine(0.5)), cycles=2), "Paired around ModelReferenced: each of them says which"),
    (fp.ModelReferenced(fp.Paired(affine(0.5), cycles=2)), "ModelReferenced around Paired: each of them says which"),
    (
        fp.ModelReferenced(fp.Filtered(fp.Increment(affine(0.5), cycles=0), pole=0.5)),
        "ModelReferenced around Increment",
    ),
    (fp.Filtered(fp.Filtered(affine(0.5), pole=0.5), pole=0.5), "Filtered stands around another Filtered"),
    (fp.ModelReferenced(affine(0.5), lag=(0.1, 0.1, 0.1)), r"the plant has 2 inputs \(Q1, Q2\)"),
    (fp.ModelReferenced(affine(0.5), cycles=(1, 2, 3)), "3 dead times are given, but the plant has 2"),
    (fp.Affine(gain=-0.5, weights=(1.0, 2.0, 3.0)), r"3 weights are given, but the plant has 2 .* \(q1, q2\)"),
)


@pytest.mark.parametrize(("deformation", "sentence"), CASES)
def test_forms_that_cannot_be_used(deformation, sentence):
    with pytest.raises(NotSupported, match=sentence):
        fp.simulate(short(tasks.two_mass.problem, 10), fp.ComputedTorque(LAW, deformation), seed=0)
