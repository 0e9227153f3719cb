"""The shipped two-mass problem does what the method promises on it, and the plants of tests/abroad are those of their sources.

Reference numbers: the nominal motion (2.2, 5.4) + 0.3 (sin 2t, sin 3t) m with rate 6 1/s, D = 0.3, A_c = -0.5, 1 ms,
computed independently with numpy and scipy from the corrected equations; published trajectories and rest points.
"""

from dataclasses import replace

import abroad
import numpy as np
import pytest
from helpers import tasks
from scipy.integrate import solve_ivp

import fpirhc as fp
from fpirhc import Plant


def late_error(controller, problem=None, since=3.0):
    """(max |e|, rms e, rms response error) per coordinate from `since` on."""
    run = fp.simulate(problem or tasks.two_mass.problem, controller, seed=0)
    assert run.stop is None
    late = run.time >= since
    error = run["error"][late]
    response = (run["realised"][1:] - run["desired"][:-1])[late[1:]]
    return np.abs(error).max(axis=0), np.sqrt((error**2).mean(axis=0)), np.sqrt((response**2).mean(axis=0))


def sigmoid(gain, scale=1.0):
    """Computed torque with eq (6)."""
    return fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Sigmoid(gain=gain, shift=0.3, scale=scale))


@pytest.mark.parametrize(
    ("controller", "largest", "share", "response", "near"),
    [("CTC", [0.630, 0.271], 0.01, [39.0, 17.0], 0.02), ("CTC+FPI (eq 6)", [0.0061, 0.0033], 0.08, [0.35, 0.19], 0.05)],
)
def test_the_wrong_model_fails_and_equation_six_makes_it_precise(controller, largest, share, response, near):
    """With A_c = -0.5: 6 / 3 mm in place of 0.63 / 0.27 m, and the response error falls by a factor of a hundred."""
    errors, _, of_responses = late_error(tasks.two_mass.controllers[controller])
    np.testing.assert_allclose(errors, largest, rtol=share, equal_nan=False)
    np.testing.assert_allclose(of_responses, response, rtol=near, equal_nan=False)


def test_response_error_times_gain_over_period_is_constant():
    """First-order law of a slowly varying task: |h| |A_c| / period = const, within 10 %."""
    constants = []
    for period in (2e-3, 1e-3, 5e-4):
        for gain in (-0.25, -0.5, -1.0):
            problem = replace(tasks.two_mass.problem, period=period, horizon=None, cost=None)
            response = np.linalg.norm(late_error(sigmoid(gain), problem)[2])
            constants.append(response * abs(gain) / period)
    sizes = np.array(constants)
    assert np.abs(sizes / sizes.mean() - 1).max() < 0.10


def test_sector_bound():
    """Rms |h| falls up to the sector bound |A_c| = 2.82, and a bounded two-cycle appears above it."""
    below, above = (np.linalg.norm(late_error(sigmoid(gain))[2]) for gain in (-2.8, -2.95))
    assert below < 0.075
    assert above > 0.2


@pytest.fixture(scope="module")
def runs():
    """The plans with the wrong model, adapted, and with the exact one."""
    one = tasks.two_mass
    return {n: fp.simulate(one.problem, one.controllers[n], seed=0) for n in ("RHC", "RHC+FPI", "RHC exact model")}


def rms(run, since=2.0):
    """Rms error per coordinate after `since`."""
    return np.sqrt((run["error"][run.time >= since] ** 2).mean(axis=0))


def test_receding_horizon_with_a_wrong_model_fails_and_adaptation_cures_it(runs):
    """RHC 58 / 42 mm; RHC+FPI below 0.6 mm; the exact model 0.1 mm."""
    np.testing.assert_allclose(rms(runs["RHC"]), [0.0584, 0.0415], rtol=0.05, equal_nan=False)
    assert rms(runs["RHC+FPI"]).max() <= 6e-4
    assert rms(runs["RHC exact model"]).max() <= 2e-4


def test_real_plant_under_adaptation_moves_like_the_model(runs):
    """The law behind it: RHC+FPI on the exact plant follows RHC on the approximate model taken as the plant."""
    right = tasks.two_mass.problem.with_exact(tasks.two_mass.problem.plant.approximate)
    ideal = fp.simulate(right, tasks.two_mass.controllers["RHC"], seed=0)
    late = ideal.time >= 1.0
    away, wrong = ((runs[n]["state"] - ideal["state"])[late][:, :2] for n in ("RHC+FPI", "RHC"))
    assert np.abs(away).max() < 2e-3
    assert np.abs(away).max() < 0.05 * np.abs(wrong).max()


def rates(plant: Plant, state: list[float], inputs: list[float]) -> np.ndarray:
    """The derivative of the state with the exact parameters; every coordinate is of order one."""
    return np.asarray(plant.equations.response(state, inputs, plant.exact).full()).ravel()


def test_reactor_is_that_of_do_mpc():
    """Five recorded states of do-mpc's closed loop (testing/results/results_CSTR.pkl), to their printed digits."""
    states = [
        (0.8, 0.5, 134.14, 130.0),
        (0.79745, 0.54271, 133.9604, 131.3699),
        (0.77854, 0.57400, 134.0065, 132.1966),
        (0.74192, 0.59436, 134.1746, 132.7276),
        (0.71626, 0.60288, 134.3794, 133.0892),
    ]
    inputs = [(10.20775, -108.9138), (9.23542, -219.388), (8.03161, -334.013), (8.15335, -456.667)]
    plant = abroad.load("cstr").problem.plant
    for before, after, u in zip(states[:-1], states[1:], inputs, strict=True):
        run = solve_ivp(lambda _, x, u=u: rates(plant, x, u), (0, 0.005), before, rtol=1e-9, atol=1e-11)
        assert run.y[:, -1] == pytest.approx(after, abs=1e-4)


@pytest.mark.parametrize(
    ("variant", "voltage", "levels"),
    [("problem", 3.0, (12.26, 12.78, 1.63, 1.41)), ("nonminimum", 3.15, (12.44, 13.17, 4.73, 4.99))],
)
def test_tanks_rest_at_johanssons_levels(variant, voltage, levels):
    """At the published voltages the published models rest at these levels, cm."""
    plant = abroad.load("quadruple_tank", variant).problem.plant
    assert rates(plant, list(levels), [voltage, voltage]) == pytest.approx(np.zeros(4), abs=2e-3)


def test_infusion_that_holds_half_the_effect():
    """The nominal patient needs 8.32 mg/min for 4.37 mg/l at the effect site (Schnider's kinetics, Hill curve of patient 13)."""
    plant = abroad.load("drug_infusion").problem.plant
    assert rates(plant, [4.37] * 4, [8.32]) == pytest.approx(np.zeros(4), abs=5e-3)
