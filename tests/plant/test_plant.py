"""Laws and mistakes of plants."""

from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import chain, linear, pendulum

import fpirhc as fp

TWO = {"m": fp.Parameter(1.5, 1.0, "kg"), "k": fp.Parameter(3.0, 2.0, "N/m")}


def two_mass_chain(controlled=None):
    """Force on the second mass only: the first is reached after four derivatives."""
    return fp.Plant(
        {"a": "m", "b": "m"},
        {"F": "N"},
        TWO,
        lambda q, v, u, p: {"a": p.k * (q.b - q.a) / p.m, "b": (u.F - p.k * (q.b - q.a)) / p.m},
        controlled=controlled,
    )


@pytest.mark.parametrize("plant", [pendulum(), linear(2.0, 3.0), chain(1), chain(3), chain(4)])
def test_inverse_undoes_response(plant):
    """f(x, f^-1(x, r)) = r: the model's inverse is an inverse."""
    random = np.random.default_rng(1)
    for _ in range(20):
        x, r = random.normal(size=plant.state.size), random.normal(size=1)
        u = plant.equations.inverse(x, r, plant.approximate)
        back = plant.equations.controlled_response(x, u, plant.approximate)
        np.testing.assert_allclose(back.full().ravel(), r, rtol=1e-12, atol=1e-12, equal_nan=False)


def test_state_is_derivative_major():
    assert two_mass_chain(("b",)).state.elements == ("a", "b", "a'", "b'")


def test_mixed_orders():
    """Orders are data: a coordinate of order 1 has no velocity in the state."""
    plant = fp.Plant(
        {"a": "m", "b": "rad"},
        {"u": "N", "w": "N"},
        {},
        lambda q, v, u, p: {"a": u.u - q.a, "b": u.w - v.b},
        order={"a": 1, "b": 2},
    )
    assert plant.state.elements == ("a", "b", "b'")
    assert plant.orders == (1, 2)


def test_non_affine_response_is_inverted_numerically():
    """U + u^3 = r has one real root; Newton finds it, and a missing root is NaN, never a wrong number."""
    cubic = fp.Plant({"y": "1"}, {"u": "1"}, {}, lambda q, u, p: {"y": u.u + u.u**3 - q.y}, order=1)
    assert not cubic.equations.affine
    assert float(cubic.equations.inverse([0.0], [2.0], [])) == pytest.approx(1.0, abs=1e-9)
    square = fp.Plant({"y": "1"}, {"u": "1"}, {}, lambda q, u, p: {"y": (u.u - 1) ** 2}, order=1)
    assert np.isnan(float(square.equations.inverse([0.0], [-1.0], [])))


def test_published_inertia_and_gravity_load_of_the_puma():
    """At the posture (0, 45, 180, 0, 45, 0) deg without load; numbers as P. Corke's toolbox prints them (from memory)."""
    plant = fp.load_problem("puma560").problem.plant
    p, x = plant.exact * [n != "load" for n in plant.parameters], np.zeros(12)
    x[[1, 2, 4]] = np.pi / 4, np.pi, np.pi / 4
    gravity, *columns = (plant.equations.inverse(x, r, p).full().ravel() for r in (np.zeros(6), *np.eye(6)))
    mass = np.column_stack(columns) - gravity[:, None]
    np.testing.assert_allclose(np.diag(mass), [3.6594, 4.4137, 0.9378, 0.1925, 0.1713, 0.1941], atol=6e-5)
    np.testing.assert_allclose([mass[0, 1], mass[0, 2], mass[1, 2]], [-0.4044, 0.1006, 0.3509], atol=6e-5)
    np.testing.assert_allclose(gravity, [0, 31.6399, 6.0351, 0, 0.0283, 0], atol=6e-5)


# The same physics in another unit has the same answer


LAW = fp.ComputedTorque(fp.Exponential(rate=1.0, integral=False))


@pytest.mark.parametrize("unit", [1.0, 1e-15, 1e9])
@pytest.mark.parametrize("size", [1.0, 1e-12, 1e9])
def test_an_input_found_by_newtons_method_is_that_of_the_response_in_another_unit(size, unit):
    plant = fp.Plant(
        coordinates={"V": "m^3"},
        inputs={"u": "1"},
        order=1,
        response=lambda q, u, p: {"V": p.k * (u.u / unit + (u.u / unit) ** 3)},
        parameters={"k": fp.Parameter(size, size, "m^3/s")},
    )
    assert float(plant.equations.inverse(0.0, 2 * size, size)) == pytest.approx(unit, rel=1e-9, abs=0)


def several(inputs: dict[str, str], response: Any, **settings: Any) -> Any:
    plant = fp.Plant({"x": "m", "heading": "rad"}, inputs, {}, response, **settings)
    return plant.controlled_names


def acting(second: Any, start: float) -> fp.Problem:
    """Two outputs of which the second has this expression."""
    plant = fp.Plant.of_states(
        states={"a": "m", "b": "m"},
        inputs={"u": "m/s", "v": "m/s"},
        parameters={"k": fp.Parameter(1.0, 1.2, "1")},
        rates=lambda _, u, p: {"a": p.k * u.u, "b": u.v},
        outputs={"first": fp.Output("m", lambda x, _: x.a), "second": fp.Output("m", second)},
    )
    reference = fp.Trajectory(lambda t: {"first": ca.sin(t), "second": 1 + ca.sin(t)})
    return fp.Problem(plant, reference, {"a": start, "b": start}, period=0.01, duration=1.0)


GOOD: dict[str, Any] = {
    "coordinates": {"y": "m"},
    "inputs": {"u": "N"},
    "parameters": TWO,
    "response": lambda q, v, u, p: {"y": u.u / p.m},
}
BAD: dict[str, dict[str, Any]] = {
    "has no unit": {"parameters": {**TWO, "m": fp.Parameter(1.0, 1.0, "")}},
    "Did you mean 'm'": {"response": lambda q, v, u, p: {"y": u.u / p.mm}},
    "does not give the derivative y''": {"response": lambda q, v, u, p: {}},
    "coordinate 'z' is unknown": {"response": lambda q, v, u, p: {"y": u.u, "z": u.u}},
    "order must be a whole number": {"order": 0},
    "order is 1000000000, and the highest possible is 20": {"order": 10**9},
    "must be one scalar": {"response": lambda q, v, u, p: {"y": ca.vertcat(u.u, u.u)}},
    "'y' names both an input and a coordinate; rename one": {"inputs": {"y": "N"}},
}
HARD: dict[str, Any] = {
    "number 4": lambda: two_mass_chain(("a",)),
    "controlled=": lambda: two_mass_chain().controlled_names,
    r"3 inputs \(left, right, bow\).*by weights.*docs/plants.md": lambda: several(
        {"left": "N", "right": "N", "bow": "N"},
        lambda q, v, u, p: {"x": u.left + u.right + u.bow, "heading": u.right - u.left},
    ),
    "'v' has no independent effect there; .* control what follows from the rate of b": lambda: acting(
        lambda x, _: 2 * x.a, 0.0
    ),
    "'v' has no independent effect there; start elsewhere": lambda: acting(lambda x, _: x.b**2, 0.0),
    "2 mistakes.*approximate.*unit": lambda: fp.Plant(
        {"y": "m"}, {"u": "N"}, {"m": fp.Parameter(float("inf"), 1.0, "")}, lambda q, v, u, p: {"y": u.u}
    ),
    "expected a whole number from 1 to": lambda: fp.RungeKutta4(0),
}


@pytest.mark.parametrize("message", [*BAD, *HARD])
def test_mistakes_are_named(message):
    if message in HARD:
        with pytest.raises(fp.FpirhcError, match=rf"(?s){message}"):
            HARD[message]()
        return
    with pytest.raises(fp.FpirhcError, match=r"(?s)" + message.replace("(", r"\(")):
        fp.Plant(**{**GOOD, **BAD[message]})
