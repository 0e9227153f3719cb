"""Laws and mistakes of plants, of their integrators, and of what a mismatch of P percent means."""

import math
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import chain, linear, pendulum
from helpers.tasks import made
from scipy import stats
from scipy.integrate import solve_ivp

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


def test_states_are_derivative_major_and_orders_mix():
    """Orders are data: a coordinate of order 1 has no velocity in the state."""
    assert two_mass_chain(("b",)).state.elements == ("a", "b", "a'", "b'")
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


# Integrators: order of convergence, and methods of scipy that control their error


def _after(integrator, period, cycles):
    plant = pendulum()
    step, x = integrator.step(plant, period), np.array([1.0, 0.5])
    for _ in range(cycles):
        x = step(x, [0.3], plant.exact, [0.0]).full().ravel()
    return x


def _truth(plant, start, command, time, method="DOP853"):
    def rate(_, x):
        return plant.equations.rate(x, command, plant.exact).full().ravel()

    return solve_ivp(rate, (0.0, time), start, method, rtol=1e-12, atol=1e-13).y[:, -1]


def test_runge_kutta_has_order_four():
    """Halving the step divides the error by 2^4."""
    truth = _truth(pendulum(), [1.0, 0.5], [0.3], 1.0)
    errors = [np.linalg.norm(_after(fp.RungeKutta4(n), 0.1, 10) - truth) for n in (1, 2, 4, 8)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 4.0, atol=0.25, equal_nan=False)


def test_forcing_adds_to_the_response():
    """A forcing w on a free double integrator moves it by w t^2 / 2."""
    plant = pendulum()
    rate = plant.equations.forced_rate
    free, forced = rate([0, 0], [0], plant.exact, [0]), rate([0, 0], [0], plant.exact, [2.5])
    np.testing.assert_allclose((forced - free).full().ravel(), [0.0, 2.5], equal_nan=False)


@pytest.mark.parametrize(("degree", "order"), [(2, 3.0), (3, 5.0)])
def test_methods_have_their_order(degree, order):
    """Halving the step divides the error by 2^order, of collocation at d points 2 d - 1."""
    truth, counts = _truth(pendulum(), [1.0, 0.5], [0.3], 2.0), (1, 2, 4) if degree == 3 else (4, 8, 16)
    methods = [fp.Collocation(n, degree, newton=5) for n in counts]
    errors = [np.linalg.norm(_after(method, 0.5, 4) - truth) for method in methods]
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, atol=0.2, equal_nan=False)


STIFF = fp.Plant(
    coordinates={"slow": "K", "fast": "K"},
    inputs={"u": "K"},
    controlled=("fast",),
    order=1,
    response=lambda q, u, p: {"slow": -q.slow + q.fast, "fast": -p.rate * (q.fast - ca.cos(q.slow) - u.u)},
    parameters={"rate": fp.Parameter(1e5, 1e5, "1/s")},
)


def test_a_stiff_plant_is_sent_to_collocation_which_follows_it():
    """A mode of 1e5 1/s over steps of 50 ms: within 1e-4 of the truth; sub-steps of Runge-Kutta would be 2 500."""
    step, x = fp.Collocation().step(STIFF, 0.05), np.array([0.5, 0.0])
    for _ in range(20):
        x = step(x, [0.1], STIFF.exact, [0.0, 0.0]).full().ravel()
    np.testing.assert_allclose(x, _truth(STIFF, [0.5, 0.0], [0.1], 1.0, "Radau"), atol=1e-4, equal_nan=False)
    reference = fp.Trajectory(lambda t: {"slow": 0.5 + 0 * t, "fast": 1.0 + 0 * t})
    limits = fp.Limits(inputs={"u": (-2.0, 2.0)})
    asked = STIFF, reference, {"slow": 0.5, "fast": 0.9}, 0.05, 1.0
    with pytest.raises(fp.FpirhcError, match=r"use Reality\(..., integrator=Collocation\(\)\)"):
        fp.Problem(*asked, limits=limits, reality=fp.Reality(STIFF))
    fp.Problem(*asked, limits=limits, reality=fp.Reality(STIFF), integrator=fp.Collocation())


# What a mismatch of P percent means, with a spread and without one


def plant(**parameters: fp.Parameter) -> fp.Plant:
    """A mass on a line that ignores its further parameters."""
    return fp.Plant(
        {"y": "m"}, {"u": "N"}, {"b": fp.Parameter(1.0, 1.0, "1/kg"), **parameters}, lambda q, v, u, p: {"y": p.b * u.u}
    )


def parameter(exact: float, spread: Any, **changes) -> fp.Parameter:
    return fp.Parameter(approximate=exact, exact=exact, unit="1", spread=spread, **changes)


def test_distributions_are_those_of_scipy():
    """Quantiles of the uniform, and of the normal and log-normal cut off at two standard deviations."""
    shares, cut = np.linspace(0.02, 0.98, 15), stats.truncnorm(-2.0, 2.0)
    for spread, known in (
        (fp.Uniform(absolute=0.4), stats.uniform(2.6, 0.8).ppf(shares)),
        (fp.Normal(absolute=0.3), 3.0 + 0.3 * cut.ppf(shares)),
        (fp.LogNormal(factor=1.3), 3.0 * np.exp(math.log(1.3) * cut.ppf(shares))),
    ):
        assert [spread.quantile(3.0, 1.0, s) for s in shares] == pytest.approx(known)


def drawn(one: fp.Plant, percent: float) -> np.ndarray:
    """Exact parameters of 200 plants that a study draws, shape (200, parameters)."""
    reference = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    problem = fp.Problem(plant=one, reference=reference, start={"y": 0.0}, period=0.01, duration=1.0)
    task = made(problem, {"CTC": fp.ComputedTorque(fp.Exponential(rate=6.0))})
    return np.array([v.problem.real_plant.exact for v in fp.Draws(200, percent, 1).of(task)])


def fills(values: np.ndarray, low: float, high: float) -> bool:
    """Whether the values stay within an interval and come near both of its ends."""
    near = 0.1 * (high - low)
    return bool(low <= values.min() <= low + near and high - near <= values.max() <= high)


def test_the_option_scales_spreads_and_keeps_its_meaning_elsewhere():
    """50 %: half of an absolute width of 4, the square root of a factor at two deviations, and 50 % of what has no spread."""
    wide, factor, zero = fp.Uniform(absolute=4.0), fp.LogNormal(factor=1.2), fp.Parameter(0.0, 0.0, "1")
    b, a, k, none = drawn(plant(a=parameter(300.0, wide), k=parameter(-5.0, factor), zero=zero), 50.0).T
    assert fills(b, 0.5, 1.5)
    assert fills(a, 298.0, 302.0)
    assert fills(k, -5.0 * 1.2, -5.0 / 1.2)
    assert not none.any()


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
    # Spreads. 100 % has no meaning for a parameter that could change its sign; with spreads everywhere it has.
    "absolute: expected a finite number above 0, got -1.0": lambda: fp.Uniform(absolute=-1.0),
    "a number above 1": lambda: fp.LogNormal(factor=0.9),
    "parameter 'z': spread: it has the value 0.*use Uniform or Normal": lambda: plant(
        z=parameter(0.0, fp.LogNormal(factor=2.0))
    ),
    "expected a Spread or None, got 0.3": lambda: plant(z=parameter(1.0, 0.3)),
    "less than 100": lambda: drawn(plant(a=parameter(2.0, fp.Uniform(absolute=0.1))), 100.0),
    "at least 0": lambda: drawn(plant(), -1.0),
    # 0.5 -+ 0.3 leaves (0.35, 1): half of the spread stays inside.
    "parameter 'c'.*at most 50 % stay inside": lambda: drawn(
        plant(c=parameter(0.5, fp.Uniform(absolute=0.3), bounds=(0.35, 1.0))), 60.0
    ),
}


@pytest.mark.parametrize("message", [*BAD, *HARD])
def test_mistakes_are_named(message):
    if message in HARD:
        with pytest.raises(fp.FpirhcError, match=rf"(?s){message}"):
            HARD[message]()
        return
    with pytest.raises(fp.FpirhcError, match=r"(?s)" + message.replace("(", r"\(")):
        fp.Plant(**{**GOOD, **BAD[message]})
