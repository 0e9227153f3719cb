"""The state at which the model has the measured outputs: where it exists, what it does not depend on, and what replaces it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.horizon.nominal import consistent_state

patient = cache(lambda: fp.load_problem("anaesthesia").problem.plant)
LIGHT = np.array([2.0, 0.6, 0.1, 1.5])  # mg/l


def seen(plant: fp.Plant, x: Any, p: Any) -> np.ndarray:
    return np.asarray(plant.equations.output(x, 0, p, np.zeros(len(plant.names))).full()).ravel()


def found(plant: fp.Plant, x: Any, y: Any, p: Any = ()) -> np.ndarray:
    return np.asarray(consistent_state(plant)(x, y, p).full()).ravel()


def test_the_model_has_the_measured_outputs_there() -> None:
    """Of another patient, whose curve and whose speed the model has wrong: to the last digits that four steps give."""
    random = np.random.default_rng(4)
    for _ in range(20):
        x, other = LIGHT * random.lognormal(0, 0.4, 4), patient().exact * random.lognormal(0, 0.15, 4)
        y = seen(patient(), x, other)
        start = found(patient(), x, y, patient().approximate)
        assert np.abs(seen(patient(), x, patient().approximate) - y).max() > 0.01
        np.testing.assert_allclose(seen(patient(), start, patient().approximate), y, rtol=1e-6, atol=1e-6)


def test_the_state_of_a_right_model_stays_as_it_is() -> None:
    y = seen(patient(), LIGHT, patient().exact)
    assert np.array_equal(found(patient(), LIGHT, y, patient().exact), LIGHT)


def several(length: float = 1.0, seconds: float = 1.0) -> fp.Plant:
    """Orders 3, 1 and 2 of three coupled outputs, and a state beside them; in metres and seconds, or in other units."""

    def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
        s = {n: x[n] / length for n in names}
        moves = {
            "a": s["b"] + 0.2 * s["e"],
            "b": s["c"] - s["a"] ** 2,
            "c": u.u + 0.5 * u.v - s["b"] * s["d"],
            "d": u.v - 0.3 * u.w + ca.sin(s["a"]),
            "e": s["f"] - s["e"] + 0.1 * s["a"],
            "f": u.w + 0.4 * u.u * (1 + 0.1 * ca.cos(s["e"])) - s["g"],
            "g": s["f"] - s["g"],
        }
        return {n: moves[n] * length / seconds for n in names}

    names = "abcdefg"
    return fp.Plant.of_states(
        states=dict.fromkeys(names, "m"),
        inputs=dict.fromkeys("uvw", "1"),
        parameters={},
        rates=rates,
        outputs={n: fp.Output("m", lambda x, p, n=n: x[n]) for n in "ade"},
    )


STATE = np.array([0.3, -0.2, 0.4, 0.1, -0.5, 0.2, 0.6])


def test_outputs_of_unequal_orders_have_one_state() -> None:
    """As many directions as equations, whatever the orders: a, a', a'', d, e, e' are met, and the state beside them follows."""
    plant = several()
    assert tuple(plant.chains.values()) == (3, 1, 2)
    y = seen(plant, STATE, ()) + 0.1 * np.random.default_rng(2).standard_normal(plant.output.size)
    start = found(plant, STATE, y)
    np.testing.assert_allclose(seen(plant, start, ()), y, atol=1e-9)


def test_it_depends_on_no_unit() -> None:
    """Millimetres and minutes in place of metres and seconds are the same state."""
    one, other = several(), several(1e3, 1 / 60.0)
    y = seen(one, STATE, ()) + 0.1 * np.random.default_rng(2).standard_normal(one.output.size)
    scale = np.array([1e3 * 60.0 ** e.count("'") for e in one.output.elements])
    np.testing.assert_allclose(found(other, 1e3 * STATE, scale * y), 1e3 * found(one, STATE, y), rtol=1e-9)


def test_what_newton_does_not_find_is_left_without_a_jump() -> None:
    """From the measured bis to one that no concentration gives, in small steps: the state moves in small steps, and back home."""
    y = seen(patient(), LIGHT, patient().approximate)
    path = np.linspace(0.0, 1.0, 4001)
    function = consistent_state(patient())
    states = np.column_stack(
        [function(LIGHT, y + s * np.array([-y[0] + 1.0, 400.0]), patient().approximate).full() for s in path]
    )
    assert np.isfinite(states).all()
    assert np.array_equal(states[:, -1], LIGHT)
    moved = np.abs(states - LIGHT[:, None]).max(axis=0)
    assert moved.max() > 1
    assert np.abs(np.diff(states, axis=1)).max() < 0.1 * moved.max()


def test_it_does_not_leave_the_ranges_of_the_plant() -> None:
    """Towards a bis above that without any drug: the effect site is emptied to a part, and the others go the same share."""
    ranged = replace(patient(), ranges={"Ce": (1.2, 8.0), "C1": (0.0, 10.0)})
    y = seen(patient(), LIGHT, patient().approximate) + np.array([8.0, 0.0])
    free, kept = (found(plant, LIGHT, y, patient().approximate) for plant in (patient(), ranged))
    assert free[3] < 1.2 < kept[3] < LIGHT[3]
    share = (kept - LIGHT) / (free - LIGHT)
    np.testing.assert_allclose(share, share[3], rtol=1e-9)
    outside = np.array([2.0, 0.6, 0.1, 1.0])  # already beyond, and moving away
    assert np.array_equal(found(ranged, outside, y, patient().approximate), outside)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_a_number_moves_nothing(value: float) -> None:
    assert np.array_equal(found(patient(), LIGHT, [value, 0.0], patient().approximate), LIGHT)


def test_outputs_of_order_zero_are_left_out() -> None:
    """The command moves them at once, so no state has them."""
    both = fp.Plant.of_states(
        states={"x": "m", "w": "m"},
        inputs={"u": "1", "v": "1"},
        parameters={},
        rates=lambda x, u, p: {"x": x.w, "w": u.u + u.v - x.x},
        outputs={
            "y": fp.Output("m", lambda x, p: x.x + 0.5 * x.w**2),
            "now": fp.Output("1", lambda x, u, p: u.v + x.x),
        },
    )
    assert both.equations.output_orders["now"] == 0
    y = np.zeros(both.output.size)
    y[both.output.elements.index("y")] = 1.0
    start = found(both, [0.4, 0.8], y)
    assert start[0] + 0.5 * start[1] ** 2 == pytest.approx(1.0, abs=1e-9)
    static = replace(both, controlled=("now", "other"), outputs={
        "now": both.outputs["now"], "other": fp.Output("1", lambda x, u, p: u.u),
    })  # fmt: skip
    assert np.array_equal(found(static, [0.4, 0.8], np.zeros(static.output.size)), [0.4, 0.8])
