"""The plants of tests/abroad are those of their sources: published trajectories and rest points."""

import abroad
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fpirhc import Plant


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
