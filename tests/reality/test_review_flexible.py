"""A motor behind a flexible shaft, written by its states: speeds are states of their own, the motor turns with its load."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidProblem

K, R, L, MOTOR, LOAD, C, B = 0.05, 1.0, 5e-4, 5e-4, 5e-4, 20.0, 5e-3  # N m/A, ohm, H, kg m^2 twice, N m/rad, N m s
NAMES = ("motor", "motor_speed", "angle", "load_speed", "current")
MATRIX = np.array(
    [
        [0, 1, 0, 0, 0],
        [-C / MOTOR, -B / MOTOR, C / MOTOR, B / MOTOR, K / MOTOR],
        [0, 0, 0, 1, 0],
        [C / LOAD, B / LOAD, -C / LOAD, -B / LOAD, 0],
        [0, -K / L, 0, 0, -R / L],
    ]
)


def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
    column = ca.vertcat(*(x[n] for n in NAMES))
    values = ca.mtimes(ca.DM(MATRIX), column) + ca.vertcat(0, 0, 0, 0, u.voltage / L)
    return dict(zip(NAMES, ca.vertsplit(values), strict=True))


def servo(start: float = 0.0) -> fp.Problem:
    """The model is rigid: J angle'' = K / R voltage - K^2 / R angle'."""
    model = fp.Plant(
        {"angle": "rad"},
        {"voltage": "V"},
        {"J": fp.Parameter(1.2e-3, 1e-3, "kg m^2")},
        lambda q, v, u, p: {"angle": (K / R * u.voltage - K**2 / R * v.angle) / p.J},
    )
    units = ("rad", "rad/s", "rad", "rad/s", "A")
    real = fp.Plant.of_states(
        states=dict(zip(NAMES, units, strict=True)),
        inputs={"voltage": "V"},
        rates=rates,
        outputs={"angle": fp.Output("rad", lambda x, p: x.angle)},
        parameters={},
    )
    return fp.Problem(
        plant=model,
        reality=fp.Reality(
            real, start={"motor": start, **dict.fromkeys(("motor_speed", "load_speed", "current"), 0.0)}
        ),
        reference=fp.Trajectory(lambda t: {"angle": 1 - ca.cos(3 * t)}),
        start={"angle": 0.0},
        period=1e-3,
        duration=3.0,
    )


def law(gain: float) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate=10.0), fp.Sigmoid(gain=gain, scale=1e9) if gain else fp.Identity())


# A reality may show a coordinate of the model as an output: a load's angle of a servo whose states have other names


STATES = {"motor": "rad", "motor_speed": "rad/s", "load": "rad", "load_speed": "rad/s", "current": "A"}


def renamed(unit: str = "rad") -> fp.Reality:
    """The flexible servo whose load angle is called 'load' and shown as 'angle'."""

    def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
        values = ca.mtimes(ca.DM(MATRIX), ca.vertcat(*(x[n] for n in STATES))) + ca.vertcat(0, 0, 0, 0, u.voltage / L)
        return dict(zip(STATES, ca.vertsplit(values), strict=True))

    outputs = {"angle": fp.Output(unit, lambda x, p: x.load)}
    plant = fp.Plant.of_states(states=STATES, inputs={"voltage": "V"}, rates=rates, outputs=outputs, parameters={})
    return fp.Reality(plant, start=dict.fromkeys(STATES, 0.0))


def test_an_output_in_place_of_a_coordinate_changes_no_signal() -> None:
    problem = replace(servo(), duration=0.5)
    both = problem, replace(problem, reality=renamed())
    one, other = (fp.simulate(p, law(-0.05), seed=0, compiled=False) for p in both)
    shared = [name for name in one.layout.names if name != "reality_state"]
    assert [name for name in shared if not np.array_equal(one[name], other[name])] == []


def test_an_output_in_another_unit_is_refused() -> None:
    with pytest.raises(InvalidProblem, match=r"'angle' is in deg, the model's 'angle' in rad; write both in one unit"):
        replace(servo(), reality=renamed("deg"))
