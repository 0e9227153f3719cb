"""Laws and mistakes of plants."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import chain, linear, pendulum

import fpirhc as fp
from fpirhc.errors import InvalidProblem, NotInvertible
from fpirhc.plant.plant import structural_order

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


def test_user_inverse_is_used():
    plant = fp.Plant(
        {"y": "1"},
        {"u": "1"},
        {},
        lambda q, u, p: {"y": ca.exp(u.u)},
        order=1,
        inverse=lambda q, r, p: {"u": ca.log(r.y)},
    )
    assert float(plant.equations.inverse([0.0], [np.e], [])) == pytest.approx(1.0)


def test_structural_order_of_the_far_mass_is_four():
    """m1 <- spring <- m2 <- F: two integrations each."""
    assert structural_order(two_mass_chain(("b",)), "a") == 4
    assert structural_order(two_mass_chain(("b",)), "b") == 2


def test_wrong_order_names_the_right_one():
    """A coordinate whose response has no input cannot be controlled at that order."""
    with pytest.raises(InvalidProblem, match="number 4"):
        two_mass_chain(("a",))


def test_underactuated_plant_asks_for_a_choice():
    """One input cannot hold two coordinates."""
    with pytest.raises(NotInvertible, match="controlled="):
        _ = two_mass_chain().controlled_names


def test_more_inputs_than_coordinates_are_told_what_to_do():
    """To name the controlled one, as with fewer inputs, would be refused next."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"drive": "N", "brake": "N"},
        parameters={"m": fp.Parameter(1.0, 1.2, "kg")},
        response=lambda _, v, u, p: {"y": (u.drive - u.brake - v.y) / p.m},
    )
    with pytest.raises(
        NotInvertible, match=r"2 inputs \(drive, brake\) for 1 of the coordinates \(y\).*leave an input out"
    ) as told:
        _ = plant.controlled_names
    assert "controlled=" not in str(told.value)


def test_an_over_actuated_plant_is_one_command_with_shares():
    """What the refusal advises: two jets of 3 : 1 as one command have the errors of one jet of their sum."""

    def jets(share: float) -> fp.Plant:
        return fp.Plant(
            coordinates={"y": "m"},
            inputs={"thrust": "N"},
            order=2,
            parameters={"m": fp.Parameter(1.3, 1.0, "kg")},
            response=lambda _q, _v, u, p: {"y": (share * u.thrust + (1 - share) * u.thrust) / p.m},
        )

    errors = []
    for share in (1.0, 0.75):
        problem = fp.Problem(
            plant=jets(share),
            reference=fp.Trajectory(lambda t: {"y": ca.sin(t)}),
            start={"y": 0.0},
            period=0.01,
            duration=2.0,
        )
        law = fp.ComputedTorque(fp.Exponential(rate=5.0), fp.ModelReferenced(fp.Affine(gain=-1.0)))
        errors.append(fp.measure(problem, fp.simulate(problem, law, seed=0, compiled=False)).rms_error["y"])
    assert 0 < errors[1] < 0.1
    assert errors[1] == pytest.approx(errors[0], rel=1e-9)


@pytest.mark.parametrize(
    ("second", "start", "said"),
    [
        (lambda x, _: 2 * x.a, 0.0, "'v' has no independent effect there, nor near it. It moves the rate of b first"),
        (lambda x, _: x.b**2, 0.0, "'v' has no independent effect there; start elsewhere"),
    ],
)
def test_inputs_without_an_effect_of_their_own_are_told_where_they_act(second, start, said):
    """Another start helps only where the effect is lost at one point."""
    plant = fp.Plant.of_states(
        states={"a": "m", "b": "m"},
        inputs={"u": "m/s", "v": "m/s"},
        parameters={"k": fp.Parameter(1.0, 1.2, "1")},
        rates=lambda _, u, p: {"a": p.k * u.u, "b": u.v},
        outputs={"first": fp.Output("m", lambda x, _: x.a), "second": fp.Output("m", second)},
    )
    with pytest.raises(InvalidProblem) as told:
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"first": ca.sin(t), "second": 1 + ca.sin(t)}),
            start={"a": start, "b": start},
            period=0.01,
            duration=1.0,
        )
    assert said in str(told.value)


BAD: dict[str, dict[str, Any]] = {
    "parameter 'm': exact is inf, expected a finite number": {
        "parameters": {**TWO, "m": fp.Parameter(1.0, float("inf"), "kg")}
    },
    "parameter 'm': approximate is nan, expected a finite number": {
        "parameters": {**TWO, "m": fp.Parameter(float("nan"), 1.0, "kg")}
    },
    "has no unit": {"parameters": {**TWO, "m": fp.Parameter(1.0, 1.0, "")}},
    "Did you mean 'm'": {"response": lambda q, v, u, p: {"y": u.u / p.mm}},
    "does not give the derivative y''": {"response": lambda q, v, u, p: {}},
    "coordinate 'z' is unknown": {"response": lambda q, v, u, p: {"y": u.u, "z": u.u}},
    "takes 3 argument": {"response": lambda q, u, p: {"y": u.u}},
    "order must be a whole number": {"order": 0},
    "order is 1000000000, and the highest possible is 20": {"order": 10**9},
    "must be one scalar": {"response": lambda q, v, u, p: {"y": ca.vertcat(u.u, u.u)}},
    "no input reaches coordinate": {"response": lambda q, v, u, p: {"y": -q.y}},
}


@pytest.mark.parametrize("message", BAD)
def test_mistakes_are_named(message):
    good: dict[str, Any] = {
        "coordinates": {"y": "m"},
        "inputs": {"u": "N"},
        "parameters": TWO,
        "response": lambda q, v, u, p: {"y": u.u / p.m},
    }
    with pytest.raises(InvalidProblem, match=r"(?s)" + message.replace("(", r"\(")):
        fp.Plant(**{**good, **BAD[message]})


def test_all_mistakes_come_at_once():
    with pytest.raises(InvalidProblem, match=r"(?s)2 mistakes.*approximate.*unit"):
        fp.Plant({"y": "m"}, {"u": "N"}, {"m": fp.Parameter(float("inf"), 1.0, "")}, lambda q, v, u, p: {"y": u.u})
