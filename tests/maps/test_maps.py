"""Maps x+ = f(x, u, p): plants that step, and have no differential equation."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import simulated

import fpirhc as fp
from fpirhc.errors import FpirhcError

T = 10.0  # s, one step
RATE = 0.04  # 1/s
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


def chain(order: int) -> fp.Plant:
    """x1+ = x2, x2+ = x3, ..., xr+ = a x1 + b u, controlled at x1."""
    names = [f"x{k}" for k in range(1, order + 1)]

    def shifted(x: Any, u: Any, p: Any) -> dict[str, Any]:
        return {**{n: x[m] for n, m in pairwise(names)}, names[-1]: p.a * x.x1 + p.b * u.u}

    parameters = {"a": fp.Parameter(0.4, 0.4, "1"), "b": fp.Parameter(2.0, 2.0, "1")}
    return fp.Plant.discrete(
        states=dict.fromkeys(names, "m"),
        inputs={"u": "N"},
        parameters=parameters,
        next=shifted,
        step=T,
        outputs={"y": fp.Output("m", lambda x, p: x.x1)},
    )


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_order_is_counted_in_cycles(order: int) -> None:
    """In single steps it is the length of the chain; a cycle as long as the chain sees the input in one."""
    plant = chain(order)
    assert tuple(plant.chains.values()) == (order,)
    assert set(replace(plant, steps=order).chains.values()) == {1}


LAGGING = fp.ExternalPlant(make=lambda p, seed: None, measures={"stock": "1"}, lag={"catch": 1.0})
BAD: dict[str, tuple[Callable[[], object], str]] = {
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


@pytest.mark.parametrize("what", BAD)
def test_what_does_not_fit_a_map_is_refused(what: str) -> None:
    build, message = BAD[what]
    with pytest.raises(FpirhcError, match=message):
        build()


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
    controller = fp.ComputedTorque(fp.Exponential(rate=RATE), fp.ModelReferenced(fp.Affine(gain=-1.0)))
    outside = simulated(task(reality=fp.ExternalPlant(Pond(), measures={"stock": "1"})), controller)
    assert np.abs(outside["command"] - simulated(task(), controller)["command"]).max() < 1e-12
