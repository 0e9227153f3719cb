"""Maps beside what is known of them: exact discretisations of linear plants, the limit of short steps, and plans by hand."""

from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import simulated
from scipy.optimize import least_squares
from scipy.signal import cont2discrete

import fpirhc as fp
from fpirhc.contracts import Controller

A = np.array([[-1.0, 1.0], [-2.0, -0.6]])  # y' = v - y, v' = -2 y - 0.6 v + 1.5 u
B = np.array([[0.0], [1.5]])
WRONG = 0.7  # of the plant's input effect, the model's
EFFECT = {"effect": fp.Parameter(WRONG, 1.0, "1")}
SPEED = {"v": fp.Output("m/s", lambda x, _: x.v)}
NAMES: dict[str, Any] = {"states": {"y": "m", "v": "m/s"}, "inputs": {"force": "N"}, "parameters": EFFECT}


def discretised(period: float) -> fp.Plant:
    """The linear plant with the command held over the period, as scipy has it."""
    a, b, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), period)

    def next_state(x: Any, u: Any, p: Any) -> dict[str, Any]:
        after = ca.DM(a) @ ca.vertcat(x.y, x.v) + ca.DM(b) * p.effect * u.force
        return {"y": after[0], "v": after[1]}

    return fp.Plant.discrete(**NAMES, next=next_state, step=period, outputs=SPEED)


def differential(period: float) -> fp.Plant:
    """The same plant as a differential equation."""
    del period

    def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
        return {"y": x.v - x.y, "v": -2.0 * x.y - 0.6 * x.v + 1.5 * p.effect * u.force}

    return fp.Plant.of_states(**NAMES, rates=rates, outputs=SPEED)


def euler(period: float) -> fp.Plant:
    """A mass on a spring in Euler's steps, controlled in its position, which its input reaches after two steps."""

    def next_state(x: Any, u: Any, p: Any) -> dict[str, Any]:
        return {"y": x.y + period * x.v, "v": x.v + period * (-2.0 * x.y - 0.6 * x.v + 1.5 * p.effect * u.force)}

    return fp.Plant.discrete(**NAMES, next=next_state, step=period, outputs={"y": fp.Output("m", lambda x, _: x.y)})


def spring(period: float) -> fp.Plant:
    """The mass on a spring as a differential equation of second order."""
    del period
    return fp.Plant(
        coordinates={"y": "m"},
        inputs={"force": "N"},
        parameters=EFFECT,
        response=lambda q, v, u, p: {"y": -2.0 * q.y - 0.6 * v.y + 1.5 * p.effect * u.force},
    )


def task(plant: fp.Plant, period: float, **changes: Any) -> fp.Problem:
    """Six seconds of a wave, from rest."""
    start, name = dict.fromkeys(plant.names, 0.0), plant.controlled_names[0]
    arguments: dict[str, Any] = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {name: 0.5 * ca.sin(0.8 * t)}),
        "start": start,
        "period": period,
        "duration": 6.0,
    }
    return fp.Problem(**{**arguments, **changes})


def test_with_the_same_commands_the_states_are_the_same_at_the_samples() -> None:
    """The differential equation of a run, integrated in fine steps, is at the samples where the map is."""
    period = 0.1
    problem = task(differential(period), period, integrator=fp.RungeKutta4(100))
    run = simulated(problem, fp.ComputedTorque(fp.Exponential(rate=1.0)))
    step = discretised(period).equations.next
    pairs = zip(run["state"], run["command"], strict=True)
    after = np.array([step(x, u, 1.0, np.zeros(2)).full().ravel() for x, u in pairs])
    assert np.abs(after[:-1] - run["state"][1:]).max() < 1e-9


LAW = fp.Exponential(rate=3.0)
FORMS = {"none": fp.Identity(), "model-referenced": fp.ModelReferenced(fp.Affine(gain=-1.0))}


PAIRS = {"exact": (discretised, differential), "order two": (euler, spring)}


def error_of(problem: fp.Problem, controller: Controller) -> np.ndarray:
    """True errors of a run."""
    run = simulated(problem, controller)
    return np.asarray(run["true_error" if "true_error" in run.layout else "error"][:, 0])


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("form", FORMS)
def test_for_short_steps_the_map_is_the_differential_equation(form: str, pair: str) -> None:
    """The same law, with derivatives and with differences: halving the step halves what is between the errors."""
    between = []
    for period in (0.04, 0.02, 0.01):
        controller = fp.ComputedTorque(LAW, FORMS[form])
        discrete, of_rates = (error_of(task(make(period), period), controller) for make in PAIRS[pair])
        between.append(float(np.abs(discrete - of_rates).max()))
    assert between[0] < 0.04
    ratios = np.array(between[:-1]) / between[1:]
    assert np.all((ratios > 1.6) & (ratios < 2.4)), (between, ratios)


# Plans


def harvested(x: Any, u: Any, p: Any) -> dict[str, Any]:
    """A stock that is caught; one step is a tenth of a unit of time."""
    return {"stock": x.stock + 0.1 * (p.growth * x.stock * (1 - x.stock) - u.catch)}


@cache
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


OPTIMISER = fp.FixedPointSolver(iterations=20, tolerance=1e-12)


@pytest.mark.parametrize("steps", [1, 3])
def test_a_plan_is_the_minimum_by_hand(steps: int) -> None:
    problem = stock(steps)
    run = simulated(replace(problem, duration=problem.period * 4, measure_from=0.0), fp.RecedingHorizon(OPTIMISER))
    assert run["planned"][0, 0] == pytest.approx(planned_by_hand(problem, 0.8), abs=1e-7)
    assert np.array_equal(run["planned"][0], run["planned"][1])  # a stage has two cycles


# Ways of running


GROWTH = {"growth": fp.Uncertain(0.1, 2.0, 0.3)}


LEARNERS = {"least squares": fp.RecursiveLeastSquares(GROWTH, {"stock": 0.01}, 5.0)}


@pytest.mark.parametrize("name", LEARNERS)
def test_estimators_find_the_growth_of_a_map(name: str) -> None:
    """The response of a cycle belongs to the state of the cycle before; with that of the cycle itself growth is 1.091."""
    run = simulated(replace(stock(), horizon=None, cost=None), fp.Estimating(fp.ComputedTorque(LAW), LEARNERS[name]))
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
