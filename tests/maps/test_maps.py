"""Maps x+ = f(x, u, p): plants that step, and have no differential equation."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import simulated
from scipy.optimize import least_squares

import fpirhc as fp
from fpirhc.contracts import Tracking
from fpirhc.errors import FpirhcError

T = 10.0  # s, one step
RATE = 0.04  # 1/s
REFERENCED = fp.ComputedTorque(fp.Exponential(rate=RATE), fp.ModelReferenced(fp.Affine(gain=-1.0)))
FISH = {
    "growth": fp.Parameter(approximate=0.02, exact=0.03, unit="1/s"),
    "caught": fp.Parameter(approximate=1.0, exact=0.7, unit="1"),
}


def grown(x: Any, u: Any, p: Any) -> dict[str, Any]:
    """A stock that grows to its limit of one and is caught: the logistic map with harvest."""
    return {"stock": x.stock + T * (p.growth * x.stock * (1 - x.stock) - p.caught * u.catch)}


def fishery(**changes: Any) -> fp.Plant:
    """The stock as a map with steps of 10 s."""
    given = {"states": {"stock": "1"}, "inputs": {"catch": "1/s"}, "parameters": FISH, "next": grown, "step": T}
    return fp.Plant.discrete(**{**given, "ranges": {"stock": (0.0, 2.0)}, **changes})


def task(plant: fp.Plant | None = None, **changes: Any) -> fp.Problem:
    """The stock follows a slow wave."""
    arguments: dict[str, Any] = {
        "plant": plant or fishery(),
        "reference": fp.Trajectory(lambda t: {"stock": 0.5 + 0.1 * ca.sin(2e-3 * t)}),
        "start": {"stock": 0.3},
        "period": T,
        "duration": 600.0,
    }
    return fp.Problem(**{**arguments, **changes})


def by_hand(cycles: int, steps: int, gain: float) -> tuple[np.ndarray, np.ndarray]:
    """States and commands of computed torque with the plain affine iteration, in numpy alone."""
    period = T * steps
    slow, fast = [(p.approximate, p.exact) for p in FISH.values()]

    def model(x: float, u: float, k: int) -> float:
        for _ in range(steps):
            x = x + T * ((slow[k]) * x * (1 - x) - fast[k] * u)
        return x

    def wanted(x: float, value: float) -> float:
        """The command with which the model is at the value one cycle later, by Newton's method."""
        u = 0.0
        for _ in range(50):
            slope = (model(x, u + 1e-7, 0) - model(x, u - 1e-7, 0)) / 2e-7
            u -= (model(x, u, 0) - value) / slope
        return u

    x, integral, before, last = 0.3, 0.0, 0.0, 0.0
    states, commands = [], []
    for k in range(cycles):
        now, later = (0.5 + 0.1 * np.sin(2e-3 * period * n) for n in (k, k + 1))
        error = now - x
        if k == 0:
            integral = -2 * error / RATE
        desired = (later - now) / period + 2 * RATE * error + RATE**2 * integral
        request = before + gain * (desired - (x - last) / period) if k and gain else desired
        u = wanted(x, x + period * request)
        states.append(x)
        commands.append(u)
        integral, before, last = integral + period * error, request, x
        x = model(x, u, 1)
    return np.array(states), np.array(commands)


@pytest.mark.parametrize("gain", [0.0, 0.5])
@pytest.mark.parametrize("steps", [1, 3])
def test_a_run_is_the_loop_by_hand(steps: int, gain: float) -> None:
    """With one step the response is affine, and with three steps Newton's method inverts it on both sides."""
    problem = task(period=T * steps, duration=20 * T * steps)
    rate = fp.Exponential(rate=RATE)
    run = simulated(problem, fp.ComputedTorque(rate, fp.Affine(gain=-2 * gain) if gain else fp.Identity()))
    states, commands = by_hand(20, steps, gain)
    assert run["status"].max() == 0
    tolerance = 1e-13 if steps == 1 else 1e-9  # Newton's method of both sides
    assert np.abs(run["state"][:, 0] - states).max() <= tolerance
    assert np.abs(run["command"][:, 0] - commands).max() <= tolerance


def test_disturbances_and_signals_act_as_in_the_loop_by_hand() -> None:
    """A disturbance of a state adds to its difference in every step; a signal has the sample of its step."""
    rain = [0.01, -0.02, 0.03, 0.0, 0.015, -0.01, 0.02, 0.005]

    def watered(x: Any, u: Any, p: Any) -> dict[str, Any]:
        return {"stock": x.stock + T * (p.growth * x.stock * (1 - x.stock) - p.caught * u.catch) + p.rain}

    plant = fishery(next=watered, parameters={**FISH, "rain": fp.outside(nominal=0.0, unit="1")})
    problem = task(
        plant,
        duration=70.0,
        signals={"rain": fp.Unknown(fp.Samples(T * np.arange(8), rain))},
        disturbances={"stock": fp.Step(at=30.0, size=2e-3)},
    )
    run = simulated(problem, fp.ComputedTorque(fp.Exponential(rate=RATE)))
    growth, caught = (p.exact for p in FISH.values())
    x = 0.3
    for k in range(7):
        assert run["plant_state"][k, 0] == pytest.approx(x, abs=1e-15)
        pushed = T * 2e-3 if k >= 3 else 0.0
        x = x + T * (growth * x * (1 - x) - caught * run["command"][k, 0]) + rain[k] + pushed


# A fishery, year by year


def test_the_shipped_fishery_is_the_recursion_of_its_source() -> None:
    loaded = fp.load_problem("fishery")
    run = simulated(loaded.problem, loaded.controllers["CTC+FPI"])
    adults, recruits = 60.0, 60.0
    for k, effort in enumerate(run["command"][:, 0]):
        assert run["plant_state"][k] == pytest.approx([adults, recruits], abs=1e-11)
        adults, recruits = (0.6 - 0.3 * effort) * adults + recruits, 2.0 * adults * np.exp(-adults / 100.0)


# Other ways to the controller


class Pond:
    """The stock as an object outside."""

    def reset(self, seed: int) -> np.ndarray:
        """The first measurement."""
        del seed
        self.stock = 0.3
        return np.array([self.stock])

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """One step of the map, in Python."""
        del time
        growth, caught = (p.exact for p in FISH.values())
        self.stock += T * (growth * self.stock * (1 - self.stock) - caught * float(command[0]))
        return np.array([self.stock])


def test_a_map_outside_is_the_map() -> None:
    """What is measured is the stock; the difference of the last cycle is the controller's own."""
    outside = simulated(task(reality=fp.ExternalPlant(Pond(), measures={"stock": "1"})), REFERENCED)
    assert np.abs(outside["command"] - simulated(task(), REFERENCED)["command"]).max() < 1e-12


# Relative orders above one: what is measured, what the model must predict, and when a pair is complete


def chain(order: int, wrong: float = 1.0) -> fp.Plant:
    """x1+ = x2, ..., xr+ = a x1 + xr^2 / 10 + b u, controlled at x1; the model's a and b are `wrong` times the plant's."""
    names = [f"x{k}" for k in range(1, order + 1)]

    def shifted(x: Any, u: Any, p: Any) -> dict[str, Any]:
        last = p.a * x.x1 + 0.1 * x[names[-1]] ** 2 + p.b * u.u
        return {**{n: x[m] for n, m in pairwise(names)}, names[-1]: last}

    return fp.Plant.discrete(
        states=dict.fromkeys(names, "m"),
        inputs={"u": "N"},
        parameters={"a": fp.Parameter(0.4 * wrong, 0.4, "1"), "b": fp.Parameter(2.0 * wrong, 2.0, "1")},
        next=shifted,
        step=T,
        outputs={"y": fp.Output("m", lambda x, p: x.x1)},
    )


def chained(order: int, wrong: float = 1.0, duration: float = 300.0, **changes: Any) -> fp.Problem:
    """The output of such a chain follows a slow wave."""
    wave = fp.Trajectory(lambda t: {"y": ca.sin(3e-3 * t)})
    start = {f"x{k}": 0.1 * k for k in range(1, order + 1)}
    return fp.Problem(chain(order, wrong), wave, start, period=T, duration=duration, **changes)


def error_of(problem: fp.Problem, law: Tracking) -> np.ndarray:
    """True errors of a run under computed torque."""
    run = simulated(problem, fp.ComputedTorque(law))
    assert run["status"].max() == 0
    return np.asarray(run["true_error"][:, 0])


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_order_is_counted_in_cycles(order: int) -> None:
    """In single steps it is the length of the chain; a cycle as long as the chain sees the input in one."""
    plant = chain(order)
    assert tuple(plant.chains.values()) == (order,)
    assert set(replace(plant, steps=order).chains.values()) == {1}


@pytest.mark.parametrize("order", [1, 2, 3])
def test_with_the_exact_model_it_is_deadbeat_in_r_steps(order: int) -> None:
    for law in (fp.Exponential(rate=1 / T, integral=False), fp.ShiftPolynomial(0.0, step=T, integral=False)):
        error = error_of(chained(order, duration=200.0), law)
        assert np.abs(error[order:]).max() < 1e-14
        assert np.abs(error[order - 1]) > 1e-3


@pytest.mark.parametrize("poles", [(0.5, 0.2, -0.3), (0.6 + 0.2j, 0.6 - 0.2j, 0.0)])
def test_the_poles_of_the_run_are_those_of_the_polynomial(poles: tuple[complex, ...]) -> None:
    """The errors of the run satisfy (z - z_1) (z - z_2) (z - z_3) e = 0, which is a recursion."""
    law = fp.ShiftPolynomial(poles, step=T, bumpless=False)
    error = error_of(chained(2), law)
    a = np.real(np.poly(poles))
    windows = np.lib.stride_tricks.sliding_window_view(error, 4)
    assert np.abs(windows @ a[::-1]).max() < 1e-14
    assert np.abs(error).max() > 0.05


@pytest.mark.parametrize("order", [1, 2, 3])
def test_with_the_exact_model_no_deformation_arises(order: int) -> None:
    run = simulated(chained(order, duration=600.0), REFERENCED)
    assert np.abs(run["deformed"] - run["desired"]).max() < 1e-16


def test_a_pair_is_complete_before_it_is_used() -> None:
    """The first r requests are the desired responses: no response to a request of this run is measured before cycle r."""
    run = simulated(chained(3, 1.3), REFERENCED)
    apart = np.abs(run["deformed"] - run["desired"])[:, 0]
    assert apart[:3].max() == 0
    assert apart[3:6].max() > 0


def in_shifts(cycles: int) -> np.ndarray:
    """Outputs of computed torque for order two with a wrong model, in shifts: no divided difference appears."""
    (a, b), (am, bm), z = (0.4, 2.0), (0.52, 2.6), 0.6
    x, outputs, expected = np.array([0.1, 0.2]), [], 0.0
    reference = np.sin(3e-3 * T * np.arange(cycles + 2))
    for k in range(cycles):
        # The next output: the model's x2, with the error of the last prediction of this output.
        ahead = x[1] + (x[0] - expected if k else 0.0)
        expected = x[1]
        wanted = reference[k + 2] + 2 * z * (ahead - reference[k + 1]) - z**2 * (x[0] - reference[k])
        # The divided difference that is asked for is that of the predicted output; the model makes it from its own.
        u = (wanted - ahead + x[1] + (x[1] - ahead) - am * x[0] - 0.1 * x[1] ** 2) / bm
        outputs.append(x[0])
        x = np.array([x[1], a * x[0] + 0.1 * x[1] ** 2 + b * u])
    return np.array(outputs)


def test_order_two_is_the_loop_by_hand_in_shifts() -> None:
    problem = chained(2, 1.3, duration=400.0)
    law = fp.ShiftPolynomial(0.6, step=T * (1 + 1e-15), integral=False)  # rounding is no other cycle
    run = simulated(problem, fp.ComputedTorque(law))
    assert np.abs(run["plant_output.y"] - in_shifts(40)).max() < 1e-13


def test_a_filter_of_late_responses_is_the_recursion_by_hand() -> None:
    """The response of order 2 is that of two cycles ago, to the state and the command of then; the disturbance is found."""
    filtering = fp.DisturbanceKalman({"x2": 0.02}, {"x1": 1e-2, "x2": 1e-2, "y''": 1e-4})
    problem = chained(2, duration=600.0, disturbances={"x2": fp.Step(0.0, 0.005)})
    controller = fp.Estimating(fp.ComputedTorque(fp.Exponential(rate=0.3 / T)), filtering)
    run, gain = simulated(problem, controller), filtering.gain(controller.inner_problem(problem))

    def after(x: np.ndarray, u: float, w: float) -> np.ndarray:
        return np.array([x[1], 0.4 * x[0] + 0.1 * x[1] ** 2 + 2.0 * u + T * w])

    def response(x: np.ndarray, u: float, w: float) -> float:
        later = after(x, u, w)
        return float((after(later, u, w)[0] - 2 * later[0] + x[0]) / T**2)

    state, disturbance, estimates = run["state"][0], 0.0, [0.0, 0.0]
    for k in range(2, run.cycles):
        x, u = run["state"][k - 2], float(run["command"][k - 2, 0])
        missing = np.append(x - state, run["realised"][k, 0] - response(state, u, disturbance))
        step = gain @ missing
        state, disturbance = state + step[:2], disturbance + float(step[2])
        estimates.append(disturbance)
        state = after(state, u, disturbance)
    np.testing.assert_allclose(run["estimate"][:, 0], estimates, atol=1e-12)
    assert run["estimate"][-1, 0] == pytest.approx(0.005, rel=1e-3)


# In a horizon and under learners

LAW = fp.Exponential(rate=3.0)


def harvested(x: Any, u: Any, p: Any) -> dict[str, Any]:
    """A stock that is caught; one step is a tenth of a unit of time."""
    return {"stock": x.stock + 0.1 * (p.growth * x.stock * (1 - x.stock) - u.catch)}


def stock(steps: int = 1) -> fp.Problem:
    """A stock with a horizon of six stages of two cycles, a cycle of `steps` maps."""
    plant = fp.Plant.discrete(
        states={"stock": "1"},
        inputs={"catch": "1"},
        parameters={"growth": fp.Parameter(0.8, 1.1, "1")},
        next=harvested,
        step=0.1,
    )
    period = 0.1 * steps
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"stock": 0.5 + 0.1 * ca.sin(0.3 * t)}),
        start={"stock": 0.3},
        period=period,
        duration=40 * period,
        measure_from=20 * period,
        horizon=fp.Horizon(stages=6, step=2 * period),
        cost=fp.Quadratic(states={"stock": 1.0}, deviation={"catch": 0.05}),
    )


def planned_by_hand(problem: fp.Problem, growth: float) -> float:
    """First input of the first plan: the sums of the cost written out, and minimised by scipy."""
    plant, steps = problem.plant, problem.plant.steps
    h = problem.horizon.step if problem.horizon else 0.0
    motion, inverse = problem.reference.function(plant), plant.equations.inverse
    times = h * np.arange(7)
    wanted = np.array([float(motion(t)[0]) for t in times])
    needed = np.array([float(inverse(motion(t)[0], motion(t)[1], growth)) for t in times])

    def residuals(inputs: np.ndarray) -> np.ndarray:
        x, parts = 0.3, []
        for k, u in enumerate(inputs):
            parts += [np.sqrt(h) * (x - wanted[k]), np.sqrt(0.05 * h) * (u - needed[k])]
            for _ in range(2 * steps):
                x = x + 0.1 * (growth * x * (1 - x) - u)
        return np.array([*parts, np.sqrt(h) * (x - wanted[6])])

    best = least_squares(residuals, needed[:6], jac="3-point", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return float(best.x[0])


@pytest.mark.parametrize("steps", [1, 3])
def test_a_plan_is_the_minimum_by_hand(steps: int) -> None:
    problem, optimiser = stock(steps), fp.FixedPointSolver(iterations=20, tolerance=1e-12)
    run = simulated(replace(problem, duration=problem.period * 4, measure_from=0.0), fp.RecedingHorizon(optimiser))
    assert run["planned"][0, 0] == pytest.approx(planned_by_hand(problem, 0.8), abs=1e-7)
    assert np.array_equal(run["planned"][0], run["planned"][1])  # a stage has two cycles


def test_least_squares_find_the_growth_of_a_map() -> None:
    """The response of a cycle belongs to the state of the cycle before; with that of the cycle itself growth is 1.091."""
    learner = fp.RecursiveLeastSquares({"growth": fp.Uncertain(0.1, 2.0, 0.3)}, {"stock": 0.01}, 5.0)
    run = simulated(replace(stock(), horizon=None, cost=None), fp.Estimating(fp.ComputedTorque(LAW), learner))
    assert run["estimate"][-1, 0] == pytest.approx(1.1, abs=3e-4)


def test_a_disturbance_of_a_map_is_the_growth_that_the_model_lacks() -> None:
    estimator = fp.DisturbanceKalman({"stock": 1.0}, {"stock": 1e-3})
    run = simulated(replace(stock(), horizon=None, cost=None), fp.Estimating(fp.ComputedTorque(LAW), estimator))
    lacking = 0.3 * run["plant_state"][:, 0] * (1 - run["plant_state"][:, 0])
    assert run["estimate"][-10:, 0] == pytest.approx(lacking[-11:-1], rel=0.01)


def test_a_receding_horizon_with_the_iteration_is_the_loop_by_hand() -> None:
    """From the planned inputs on: nominal response, deformation, command and stock, in numpy."""
    problem, few = stock(), fp.FixedPointSolver(iterations=4, tolerance=1e-6)
    run = simulated(problem, fp.RecedingHorizon(few, fp.ModelReferenced(fp.Affine(gain=-1.6))))

    def response(x: float, u: float, growth: float) -> float:
        return growth * x * (1 - x) - u

    x, last, before, delta = 0.3, 0.0, 0.0, 0.0
    for k, planned in enumerate(run["planned"][:, 0]):
        if k:
            modelled, realised = response(last, before, 0.8), (x - last) / 0.1
            delta = delta - 0.8 * (realised - (modelled - delta))
        request = response(x, planned, 0.8) + delta
        command = 0.8 * x * (1 - x) - request
        assert run["plant_state"][k, 0] == pytest.approx(x, abs=1e-13)
        assert run["command"][k, 0] == pytest.approx(command, abs=1e-12)
        last, before, x = x, command, x + 0.1 * response(x, command, 1.1)


# What does not fit

POLES: dict[str, tuple[Callable[[], Tracking], str]] = {
    "rate": (
        lambda: fp.Exponential(rate=0.2),
        r"has the pole z = -1 and does not decay; use a rate below 0.2 1/s \(0.1 is deadbeat\)",
    ),
    "step": (lambda: fp.ShiftPolynomial(0.5, step=1.0), r"the control cycle is 10 s, .* write step=10"),
    "number": (
        lambda: fp.ShiftPolynomial((0.5, 0.2), step=T),
        r"2 poles are given, .* relative order 2 has 3 modes with the sum",
    ),
    "outside": (lambda: fp.ShiftPolynomial(1.0, step=T), r"1 is not inside the unit circle"),
    "conjugate": (lambda: fp.ShiftPolynomial((0.5 + 0.1j,), step=T), "with its conjugate"),
    "fractional": (lambda: fp.Fractional(rate=0.2, order=0.8), r"has the pole z = -1 and does not decay"),
}
LAGGING = fp.ExternalPlant(make=lambda p, seed: None, measures={"stock": "1"}, lag={"catch": 1.0})
BAD: dict[str, tuple[Callable[[], Any], str]] = {
    "period": (
        lambda: task(period=15.0),
        r"period 15 s is no whole number of the plant's steps of 10 s; use 10 s or 20 s",
    ),
    "estimator": (
        lambda: task(sensing=fp.Sensing(estimator=fp.PositionDifference())),
        r"PositionDifference needs derivatives below the response, and discrete time has only differences; leave the estimator out",
    ),
    "next": (lambda: fishery(next=lambda x, u, p: {}), r"next does not give the value of state 'stock' one step later"),
    "stages": (lambda: task(horizon=fp.Horizon(2, 2 * T, lengths=(1.0, 1.5))), r"are whole steps, got lengths"),
    "lag": (lambda: task(reality=LAGGING), r"a discrete-time plant has no lag"),
    "no input": (
        lambda: fishery(next=lambda x, u, p: {"stock": x.stock}, outputs={"y": fp.Output("1", lambda x, p: x.stock)}),
        r"no input reaches 'y'",
    ),
    "later": (
        lambda: replace(chain(2), outputs={}, controlled=("x1",)),
        r"an input reaches state 'x1' only after 2 steps; write it as an output",
    ),
}


@pytest.mark.parametrize("what", [*BAD, *POLES])
def test_what_does_not_fit_a_map_is_refused(what: str) -> None:
    build, message = (BAD | POLES)[what]
    with pytest.raises(FpirhcError, match=message):
        error_of(chained(2), build())
