"""Plants with outputs behind dead time: outputs are predicted with the state, and keep their distance from the model's."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.of_outputs import curve, hill, planned, sedated
from helpers.plants import simulated

import fpirhc as fp
from fpirhc.errors import NotSupported

LAW = fp.Exponential(rate=1.0)
LATE = 0.2  # min, of the pump


def late(problem: fp.Problem, time: float = LATE) -> fp.Problem:
    return replace(problem, dead_time=fp.DeadTime(inputs={"u": time}))


def scaled(gain: float) -> Callable[..., Any]:
    return lambda q, v, p: gain * q.x


def waved(gain: float) -> Callable[..., Any]:
    return lambda t: {"y": gain * ca.sin(t)}


def test_the_residual_of_an_output_is_the_forcing_that_makes_it_up() -> None:
    """Y = 3 x of a tank with a wrong leak: the residual of y'' acts on the state as a third of it, as if x had been measured."""
    runs = []
    for gain, time in ((1.0, 0.5), (3.0, 0.5), (1.0, None)):
        plant = fp.Plant(
            coordinates={"x": "m"},
            inputs={"u": "N"},
            parameters={"a": fp.Parameter(1.0, 2.0, "1")},
            response=lambda q, v, u, p: {"x": u.u - p.a * q.x},
            outputs={"y": fp.Output("m", scaled(gain))},
        )
        problem = fp.Problem(
            plant=plant,
            reference=fp.Trajectory(waved(gain)),
            start={"x": 0.0, "x'": 1.0},
            period=0.02,
            duration=6.0,
            measure_from=4.0,
            dead_time=fp.DeadTime(inputs={"u": 0.1}),
        )
        runs.append(simulated(problem, fp.Predicted(fp.ComputedTorque(LAW), inputs=0.1, residual_time=time)))
    for signal in ("command", "state_ahead"):
        assert runs[1][signal] == pytest.approx(runs[0][signal], rel=1e-6, abs=1e-9)
    missed = [np.abs(run["state_ahead"][200:-5] - run["plant_state"][205:]).max() for run in runs]
    assert missed[0] < 0.5 * missed[2]


def test_outputs_ahead_of_a_right_model_are_those_that_come() -> None:
    """With the exact model, ahead is what is measured later, to the error of the integrator."""
    problem = late(sedated(hill(4.0)))
    run = simulated(problem, fp.Predicted(fp.ComputedTorque(LAW), inputs=LATE))
    cycles = round(LATE / problem.period)
    assert np.allclose(run["output_ahead"][:-cycles], run["output"][cycles:], atol=1e-6)
    assert np.abs(run["output_ahead"] - run["output"]).max() > 0.5


def test_the_distance_of_a_wrong_model_moves_as_a_polynomial() -> None:
    """Ahead is what the model has at the state ahead, and d + d' tau; d and d' are what is measured less the model's."""
    run = simulated(late(sedated(hill(5.5))), fp.Predicted(fp.ComputedTorque(LAW), inputs=LATE))

    def model(state: np.ndarray) -> np.ndarray:
        level, size = state[:, 1], 1e-6
        slope = (curve(level + size, 5.5) - curve(level - size, 5.5)) / (2 * size)
        return np.column_stack([curve(level, 5.5), slope * 0.5 * (state[:, 0] - level)])

    distance = run["output"] - model(run["state"])
    moved = np.column_stack([distance[:, 0] + LATE * distance[:, 1], distance[:, 1]])
    np.testing.assert_allclose(run["output_ahead"], model(run["state_ahead"]) + moved, atol=1e-6)
    assert np.abs(LATE * distance[:, 1]).max() > 0.1


def test_what_is_not_covered_says_so() -> None:
    desired = fp.Predicted(fp.ComputedTorque(LAW), inputs=LATE, by="desired")
    with pytest.raises(NotSupported, match=r"does not predict C, E, which no desired response moves; use by='model'"):
        simulated(late(planned()), desired)
