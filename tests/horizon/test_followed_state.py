"""Deviations of inputs on plants with outputs: allowed where all states follow from the outputs, refused by name elsewhere."""

from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import horizon_of

import fpirhc as fp
from fpirhc.errors import NotSupported

K = 3.0  # 1/s
REFERENCE = fp.Trajectory(lambda t: {"shown": 0.5 * ca.sin(t)})
HORIZON = fp.Horizon(stages=20, step=0.05)
COST: dict[str, Any] = {"outputs": {"shown": 1e3}}


def lags(shown, second=None) -> fp.Plant:
    """A' = u - a, b' = K (a - b), behind a display."""
    return fp.Plant.of_states(
        states={"a": "m", "b": "m"},
        inputs={"u": "m/s"} | ({"v": "m/s"} if second else {}),
        parameters={"k": fp.Parameter(K, 1.3 * K, "1/s")},
        rates=lambda x, u, p: {"a": u.u - x.a, "b": p.k * (x.a - x.b) if not second else u.v - x.b},
        outputs={"shown": fp.Output("m", shown)} | ({"other": fp.Output("m", second)} if second else {}),
    )


SCALED = lags(lambda x, _: 2 * x.b)


def test_the_input_along_the_reference_is_that_of_the_lags():
    """B = y / 2, a = b + b' / K, u = a' + a at every stage."""
    cost = fp.Quadratic(**COST, deviation={"u": 1e-2})
    ocp, data = horizon_of(SCALED, REFERENCE, HORIZON, cost, time=0.3)
    t = 0.3 + HORIZON.step * np.arange(HORIZON.stages + 1)
    b, b1, b2 = 0.25 * np.sin(t), 0.25 * np.cos(t), -0.25 * np.sin(t)
    needed = b1 + b2 / K + b + b1 / K
    np.testing.assert_allclose(data[ocp.data.slice("feedforward")][0], needed, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("shown", [lambda x, _: x.a, lambda x, _: x.b**3 + x.a * x.b])
def test_states_that_do_not_follow_are_refused_by_name(shown):
    """An inner state, which no output shows, and one that stands in it in a power: `rate` is named."""
    plant = lags(shown)
    with pytest.raises(
        NotSupported,
        match=r"needs the states .*, which are no outputs and do not follow from them by linear equations.*rate",
    ):
        horizon_of(plant, REFERENCE, HORIZON, fp.Quadratic(**COST, deviation={"u": 1e-2}), start={"a": 0.3, "b": 0.2})


FULL = {"upper": 0.2, "lower": 0.2}
G, A, HOLE = 9.81, 0.01, 1e-4  # m/s^2, m^2, m^2


def tanks(*, by_velocity: bool) -> fp.Plant:
    """Two tanks in a row, the lower level the output; the upper one as its level, or as the velocity w = sqrt(2 g h) of its jet."""

    def rates(x, u, p):
        jet = x.upper if by_velocity else ca.sqrt(2 * G * x.upper)
        filling = (u.flow - p.hole * jet) / A
        return {
            "upper": G / jet * filling if by_velocity else filling,
            "lower": p.hole * (jet - ca.sqrt(2 * G * x.lower)) / A,
        }

    return fp.Plant.of_states(
        states={"upper": "m/s" if by_velocity else "m", "lower": "m"},
        inputs={"flow": "m^3/s"},
        parameters={"hole": fp.Parameter(HOLE, 1.1 * HOLE, "m^2")},
        rates=rates,
        outputs={"shown": fp.Output("m", lambda x, _: x.lower)},
    )


def test_a_state_that_follows_one_to_one_can_be_written_so_that_it_is_linear():
    """The level is refused; its jet's velocity gives the flow that holds the lower level, hole sqrt(2 g h)."""
    cost = fp.Quadratic(**COST, deviation={"flow": 1.0})
    still = fp.Trajectory(lambda t: {"shown": 0.2 + 0 * t})
    with pytest.raises(NotSupported, match=r"needs the states upper.*rate"):
        horizon_of(tanks(by_velocity=False), still, HORIZON, cost, start=FULL)
    plant = tanks(by_velocity=True)
    ocp, data = horizon_of(plant, still, HORIZON, cost, start=FULL)
    needed = data[ocp.data.slice("feedforward")][0]
    np.testing.assert_allclose(needed, HOLE * np.sqrt(2 * G * 0.2), rtol=1e-12)
