"""Parameter regressors: Y theta + Q0 is the inverse dynamics, C is Christoffel's, and what is not linear is refused by name."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest
from helpers.plants import pendulum
from hypothesis import given, settings
from hypothesis import strategies as st

import fpirhc as fp
from fpirhc.errors import InvalidName, InvalidValue, NotSupported
from fpirhc.plant.motion import places
from fpirhc.plant.regressor import Combination, Regressor, linear_parameters

INERTIAS = {
    "a1": Combination(lambda p: p.I1 + p.m1 * p.lc1**2 + p.Ie + p.me * (p.lce**2 + p.l1**2), "kg m^2"),
    "a2": Combination(lambda p: p.Ie + p.me * p.lce**2, "kg m^2"),
    "a3": Combination(lambda p: p.me * p.l1 * p.lce * ca.cos(p.delta), "kg m^2"),
    "a4": Combination(lambda p: p.me * p.l1 * p.lce * ca.sin(p.delta), "kg m^2"),
}


@cache
def regressor(name):
    """The shipped arms' regressors; the two-link arm's model is nonlinear in its parameters and needs combinations."""
    plant = fp.load_problem(name).problem.plant
    if name == "two_link_arm":
        return Regressor(plant, (*INERTIAS, "b"), INERTIAS)
    nonlinear = {"planar_arm": {"vs"}}.get(name, set())
    return Regressor(plant, [n for n in plant.parameters if n not in nonlinear])


ARMS = ("two_link_arm", "planar_arm", "three_link_arm", "puma560")
numbers = st.lists(st.floats(-2, 2), min_size=80, max_size=80)


def drawn(values, name):
    """State, response, a second velocity, theta and parameters from one list of numbers."""
    model = regressor(name)
    n, plant = len(model.plant.names), model.plant
    values = np.array(values)
    x, r, v = values[: 2 * n], 5 * values[20 : 20 + n], values[30 : 30 + n]
    p = plant.exact * (1 + 0.2 * values[40 : 40 + plant.exact.size])
    return model, x, r, v, p, model.theta_function(p).full().ravel()


@pytest.mark.parametrize("name", ARMS)
@settings(max_examples=15, deadline=None, derandomize=True)
@given(values=numbers)
def test_regressor_is_the_inverse_dynamics(name, values):
    """Y theta + Q0 = Q at any state, response and parameters, to rounding."""
    model, x, r, _, p, theta = drawn(values, name)
    y, rest = model.function(x, r, p)
    wanted = model.plant.equations.inverse(x, r, p).full().ravel()
    np.testing.assert_allclose(
        (y @ theta + rest).full().ravel(), wanted, rtol=1e-8, atol=1e-8 * (1 + np.abs(wanted).max())
    )


@pytest.mark.parametrize("name", ARMS)
@settings(max_examples=10, deadline=None, derandomize=True)
@given(values=numbers)
def test_split_with_the_actual_velocity_is_the_inverse_dynamics(name, values):
    """Y_s(q, q', q', q'') = Y(q, q', q''), and it is linear in v with slope C."""
    model, x, r, v, p, theta = drawn(values, name)
    own = x[places(model.plant, 1)]

    def force(velocity):
        y, rest = model.split_function(x, velocity, r, p)
        return (y @ theta + rest).full().ravel()

    wanted = model.plant.equations.inverse(x, r, p).full().ravel()
    scale = 1e-8 * (1 + np.abs(wanted).max())
    np.testing.assert_allclose(force(own), wanted, atol=scale)
    coriolis = model.coriolis_function(x, theta, p).full()
    np.testing.assert_allclose(force(own + v) - wanted, coriolis @ v, atol=scale + 1e-8 * np.abs(coriolis).max())


@pytest.mark.parametrize("name", ARMS)
@settings(max_examples=10, deadline=None, derandomize=True)
@given(values=numbers)
def test_coriolis_matrix_makes_the_change_of_mass_skew(name, values):
    """M' - 2 C + (M' - 2 C)^T = 0, with M' by a central difference along q' (error of order h^2 = 1e-10)."""
    model, x, _, _, p, theta = drawn(values, name)
    n, h = len(model.plant.names), 1e-5
    along = np.concatenate([x[n:], np.zeros(n)])
    ahead, behind = (model.mass_function(x + s * h * along, theta, p).full() for s in (1, -1))
    skew = (ahead - behind) / (2 * h) - 2 * model.coriolis_function(x, theta, p).full()
    np.testing.assert_allclose(skew + skew.T, 0, atol=1e-6 * (1 + np.abs(skew).max()))


def test_published_regressor_of_the_two_link_arm():
    """Slotine and Li (1991), section 9.2 (from memory): a = (3.34, 0.97, 1.04, 0.6), and their regressor."""
    model = regressor("two_link_arm")
    theta = model.theta_function(model.plant.exact).full().ravel()
    np.testing.assert_allclose(theta[:4], [3.34, 0.97, 1.0392, 0.6], atol=5e-5)
    q, w, v, s = np.random.default_rng(0).standard_normal((4, 2))
    y, rest = (m.full() for m in model.split_function([*q, *w], v, s, model.plant.approximate))
    cosine, sine = np.cos(q[1]), np.sin(q[1])
    cross = w[1] * v[0] + w[0] * v[1] + w[1] * v[1]
    printed = [
        [s[0], s[1], (2 * s[0] + s[1]) * cosine - cross * sine, (2 * s[0] + s[1]) * sine + cross * cosine],
        [0, s[0] + s[1], s[0] * cosine + w[0] * v[0] * sine, s[0] * sine - w[0] * v[0] * cosine],
    ]
    np.testing.assert_allclose(y[:, :4], printed, atol=1e-10)
    np.testing.assert_allclose(rest, 0, atol=1e-10)


def test_published_inertia_and_gravity_load_of_the_puma():
    """At the posture (0, 45, 180, 0, 45, 0) deg without load; numbers as P. Corke's toolbox prints them (from memory)."""
    model = regressor("puma560")
    p = model.plant.exact * [n != "load" for n in model.plant.parameters]
    x = np.zeros(12)
    x[[1, 2, 4]] = np.pi / 4, np.pi, np.pi / 4
    mass = model.mass_function(x, model.theta_function(p), p).full()
    np.testing.assert_allclose(np.diag(mass), [3.6594, 4.4137, 0.9378, 0.1925, 0.1713, 0.1941], atol=6e-5)
    np.testing.assert_allclose([mass[0, 1], mass[0, 2], mass[1, 2]], [-0.4044, 0.1006, 0.3509], atol=6e-5)
    gravity = model.plant.equations.inverse(x, np.zeros(6), p).full().ravel()
    np.testing.assert_allclose(gravity, [0, 31.6399, 6.0351, 0, 0.0283, 0], atol=6e-5)


def test_more_combinations_than_parameters():
    """A pendulum of mass m and length l: inertia m l^2 and weight m l; three functions of two parameters need two points."""
    plant = pendulum()
    combinations = {
        "inertia": Combination(lambda p: p.m * p.l**2, "kg m^2"),
        "weight": Combination(lambda p: p.m * p.l, "kg m"),
        "square": Combination(lambda p: p.m**2, "kg^2"),
    }
    result = Regressor(plant, ("inertia", "weight"), combinations)
    y, rest = (m.full() for m in result.function([0.3, 0.7], [2.0], plant.approximate))
    np.testing.assert_allclose(y, [[2.0, 9.81 * np.sin(0.3)]], atol=1e-9)
    np.testing.assert_allclose(rest, [[0.07]], atol=1e-9)
    with pytest.raises(InvalidValue, match="'square' does not enter"):
        Regressor(plant, ("inertia", "weight", "square"), combinations)
    with pytest.raises(InvalidValue, match=r"not linear in inertia.*'l' enter"):
        Regressor(plant, ("inertia",), combinations)


def test_linear_parameters_are_found():
    """Linear jointly with all others; a Stribeck level is one only where its velocity is not learned."""
    assert linear_parameters(pendulum()) == ()
    result = linear_parameters(fp.load_problem("planar_arm").problem.plant)
    assert result == ("J1", "k1", "m2", "I2", "load", "b1", "b2", "c1", "c2")
    with pytest.raises(NotSupported, match="fully actuated"):
        linear_parameters(fp.load_problem("cart_pole").problem.plant)


def test_parameters_that_enter_nonlinearly_are_refused_by_name():
    with pytest.raises(InvalidValue, match=r"'l' enter\(s\) nonlinearly; in products: 'm' with 'l'.*Combination"):
        Regressor(pendulum(), ("m", "l"))
    plant = fp.load_problem("planar_arm").problem.plant
    with pytest.raises(InvalidValue, match=r"'vs' enter.*'s1' with 'vs'"):
        Regressor(plant, tuple(plant.parameters))
    with pytest.raises(InvalidName, match="Did you mean 'load'"):
        Regressor(plant, ("lod",))
    double = {"twice": Combination(lambda p: 2 * p.load, "kg")}
    with pytest.raises(InvalidValue, match="depend on each other"):
        Regressor(plant, ("load", "twice"), double)
