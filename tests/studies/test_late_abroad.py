"""A heated tank behind a pipe, with a slow valve that its model does not have, beside an integration of its own."""

from __future__ import annotations

from pathlib import Path

import abroad
import numpy as np
import pytest
from scipy.linalg import expm

import fpirhc as fp

K, TAU, LAG, LATE, PERIOD, RATE, GAIN, POLE = 2.0, 10.0, 0.5, 10, 0.1, 0.2, 0.1, 0.95  # GAIN: half of the map's own
K_MODEL, TAU_MODEL = 1.4, 14.0


@pytest.fixture(scope="module")
def tank():
    return fp.load_problem(Path(abroad.__file__).parent / "heated_tank.py")


def rms(tank, controller):
    return fp.measure(tank.problem, fp.simulate(tank.problem, controller, seed=0, compiled=False)).rms_error["T"]


def by_hand(*, adapts: bool) -> float:
    """The rms error from 40 min on: the exact step of tank and valve under a held command, the law and the iteration as formulas.

    d_k = T^N' + 2 rate e_k + rate^2 (sum of e_j h, j < k, less 2 e_0 / rate),  e = T^N - T,
    r_k = d_k + delta_k,  u_k = (tau^ r_k + T) / K^,
    delta_k = p delta_{k-1} + (1 - p) (delta_{k-1-D} - a (f_k - f^_k + delta_{k-1-D})).
    """
    rates = np.array([[-1 / TAU, K / TAU, 0.0], [0.0, -1 / LAG, 1 / LAG], [0.0, 0.0, 0.0]])
    move = expm(rates * PERIOD)
    temperature, valve = 20.0, 10.0
    commands, deltas, errors = [10.0] * (LATE + 1), [0.0] * (LATE + 1), []
    integral = -2 * 10.0 / RATE  # the law begins with the reference's own response
    for k in range(1200):
        t = k * PERIOD
        wanted, slope = 30 + 10 * np.sin(0.1 * t), np.cos(0.1 * t)
        errors.append(wanted - temperature)
        acted = commands[-1 - LATE]
        late = deltas[-1 - LATE]
        apart = (K * valve - temperature) / TAU - (K_MODEL * acted - temperature) / TAU_MODEL
        new = POLE * deltas[-1] + (1 - POLE) * (late - GAIN * (apart + late))
        deltas.append(new if adapts and k else 0.0)
        request = slope + 2 * RATE * errors[-1] + RATE**2 * integral + deltas[-1]
        integral += PERIOD * errors[-1]
        commands.append(float(np.clip((TAU_MODEL * request + temperature) / K_MODEL, 0, 100)))
        temperature, valve, _ = move @ [temperature, valve, commands[-1 - LATE]]
    return float(np.sqrt(np.mean(np.square(errors[400:]))))


@pytest.mark.parametrize("adapts", [False, True])
def test_dead_time_and_lag_are_those_of_an_independent_integration(tank, adapts):
    controller = tank.controllers["CTC+FPI" if adapts else "CTC"]
    assert rms(tank, controller) == pytest.approx(by_hand(adapts=adapts), rel=1e-3)
