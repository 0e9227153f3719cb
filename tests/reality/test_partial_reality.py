"""A reality with other states than the model: it needs only what is measured, controlled or judged; the rest is believed."""

from __future__ import annotations

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidProblem

PERIOD, PARAMETERS = 0.05, {"b": fp.Parameter(approximate=1.0, exact=1.3, unit="1/l")}


def spinning(states: dict[str, str], rates) -> fp.Plant:
    """A mass of 1.3 kg behind a force of its own, with speeds that are states and not derivatives."""
    return fp.Plant.of_states(
        states={"y": "m", **states},
        inputs={"u": "N"},
        parameters={"mass": fp.Parameter(approximate=1.3, exact=1.3, unit="kg")},
        rates=rates,
        outputs={"place": fp.Output("m", lambda x, _: x.y)},
    )


def held_at_speed(plant: fp.Plant, **start: float) -> np.ndarray:
    """The first state of a reality whose model starts at 0.1 m with 0.2 m/s under 1 N."""
    model = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        order=2,
        parameters={"mass": fp.Parameter(approximate=1.0, exact=1.0, unit="kg")},
        response=lambda q, v, u, p: {"y": (u.u - 0.5 * v.y) / p.mass},
    )
    return fp.Reality(plant, start=start).start_state(model, np.array([0.1, 0.2]), np.array([1.0]))


def test_a_speed_that_is_a_state_starts_as_the_model():
    """It would settle at the 2 m/s that 1 N keeps up against the friction; the force behind it settles."""
    plant = spinning(
        {"speed": "km/h", "force": "N"},
        lambda x, u, p: {
            "y": x.speed / 3.6,
            "speed": 3.6 * (x.force - 0.5 * x.speed / 3.6) / p.mass,
            "force": (u.u - x.force) / 0.05,
        },
    )
    assert held_at_speed(plant) == pytest.approx([0.1, 0.72, 1.0])
    assert held_at_speed(plant, speed=0.5) == pytest.approx([0.1, 0.5, 1.0])  # what is stated is not asked for


def test_a_speed_of_two_states_is_asked_for():
    """Belt and slip together are the speed; one of them must be stated, the other follows."""
    plant = spinning(
        {"belt": "m/s", "slip": "m/s"},
        lambda x, u, p: {"y": x.belt - x.slip, "belt": (u.u - 0.5 * x.belt) / p.mass, "slip": -x.slip},
    )
    with pytest.raises(
        InvalidProblem,
        match=r"y' is 0.2 at the start of the model and depends on its states belt, slip; give .*'belt': \.\.\.",
    ):
        held_at_speed(plant)
    assert held_at_speed(plant, belt=0.5) == pytest.approx([0.1, 0.5, 0.3])


def test_two_speeds_of_one_state_are_refused():
    """The speed of two carts on one belt cannot start as that of both; a stated one starts as stated."""
    plant = fp.Plant.of_states(
        states={"y": "m", "z": "m", "belt": "m/s"},
        inputs={"u": "N"},
        parameters={"mass": fp.Parameter(approximate=1.3, exact=1.3, unit="kg")},
        rates=lambda x, u, p: {"y": x.belt, "z": -x.belt, "belt": (u.u - 0.5 * x.belt) / p.mass},
        outputs={"place": fp.Output("m", lambda x, _: x.y)},
    )
    model = fp.Plant(
        coordinates={"y": "m", "z": "m"},
        inputs={"u": "N"},
        order=2,
        parameters={"mass": fp.Parameter(approximate=1.0, exact=1.0, unit="kg")},
        response=lambda q, v, u, p: {"y": (u.u - 0.5 * v.y) / p.mass, "z": -u.u / p.mass},
        controlled=["y"],
    )
    start = np.array([0.1, 0.0, 0.2, 0.3])
    with pytest.raises(InvalidProblem, match=r"z' and another derivative .* its state belt is; give .*'belt': \.\.\."):
        fp.Reality(plant).start_state(model, start, np.array([1.0]))
    stated = fp.Reality(plant, start={"belt": 0.5}).start_state(model, start, np.array([1.0]))
    assert stated == pytest.approx([0.1, 0.0, 0.5])
