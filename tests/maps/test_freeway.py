"""The freeway: METANET against a published run, its ramp, and the emission that an iteration on targets holds.

The reference is a run of 900 steps of FilippoAiraldi/sym-metanet (MIT licence, tests/data/freeway/LICENSE), every twentieth row.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.kinds import slow_but

import fpirhc as fp

DATA = Path(__file__).parents[1] / "data" / "freeway" / "reference.csv"
T = 10 / 3600  # h
TOTAL_TIME_SPENT = 1433.7876921  # veh h


@cache
def task(name: str) -> Any:
    return fp.load_problem(name)


@cache
def run_of(name: str, controller: str) -> fp.Run:
    """One run of a shipped task."""
    return fp.simulate(task(name).problem, task(name).controllers[controller], seed=0, compiled=False)


def error(name: str, controller: str) -> float:
    [value] = fp.measure(task(name).problem, run_of(name, controller)).rms_error.values()
    return float(value)


def stepper(plant: fp.Plant) -> ca.Function:
    """One step of 10 s, (state, inputs, parameters) -> state, and not the six of a minute."""
    x, u, p = replace(plant, steps=1).symbols()
    return ca.Function("step", [x, u, p], [plant.equations.next(x, u, p, ca.SX.zeros(len(plant.names)))])


def with_demands(plant: fp.Plant, steps: int) -> np.ndarray:
    """Exact parameters with the demands of the source at the beginning of each step, shape (steps, np)."""
    hours, values = T * np.arange(steps), np.tile(plant.exact, (steps, 1))
    demands = {
        "demand": np.interp(hours, [2, 2.25], [3500, 1000]),
        "ramp_demand": np.interp(hours, [0, 0.15, 0.35, 0.5], [500, 1500, 1500, 500]),
    }
    for name, column in demands.items():
        values[:, plant.parameter.elements.index(name)] = column
    return values


def driven(name: str, commands: np.ndarray) -> np.ndarray:
    """States after each step of 10 s under these commands (steps, nu), from the start of a task."""
    problem = task(name).problem
    plant = replace(problem.plant, steps=1)
    run = stepper(plant).mapaccum(len(commands))
    return np.asarray(run(problem.start_state, commands.T, with_demands(plant, len(commands)).T).full()).T


def open_loop() -> np.ndarray:
    """900 steps of 10 s with an open ramp and the demands of the source, shape (900, 14)."""
    return driven("freeway_metering", np.ones((900, 1)))


def test_metanet_is_the_published_run() -> None:
    """Densities, speeds and queues to rounding, and the total time spent to every printed digit."""
    states, rows = open_loop(), np.loadtxt(DATA, delimiter=",", skiprows=1)
    at, published = rows[:, 0].astype(int), rows[:, 1:]
    assert len(at) == 45
    np.testing.assert_allclose(states[at], published, rtol=1e-14, atol=2e-13)
    cars = 2 * states[:, :6].sum(axis=1) + states[:, 12:].sum(axis=1)
    assert T * cars.sum() == pytest.approx(TOTAL_TIME_SPENT, abs=1e-7)


def test_cars_are_conserved() -> None:
    """What has come is on the road, waits, or has left at the end, whatever the speeds are."""
    states, hours = open_loop(), T * np.arange(900)
    come = np.interp(hours, [2, 2.25], [3500, 1000]) + np.interp(hours, [0, 0.15, 0.35, 0.5], [500, 1500, 1500, 500])
    first = task("freeway_metering").problem.start_state[None, :]
    before = np.vstack([first, states[:-1]])
    left = 2 * before[:, 5] * before[:, 11]
    cars = [2 * s[:, :6].sum(axis=1) + s[:, 12:].sum(axis=1) for s in (before, states)]
    assert cars[1] - cars[0] == pytest.approx(T * (come - left), abs=1e-10)


# Metering


def test_an_exact_map_of_a_minute_has_no_error() -> None:
    """Six steps with the rate held are one map, whose inverse the controller has."""
    assert error("freeway_metering", "CTC exact model") < 1e-12


def test_the_run_is_a_loop_by_hand() -> None:
    """The rates of a run through METANET in numpy, six steps per minute, with the demands in the middle of every minute."""
    problem, run = task("freeway_metering").problem, run_of("freeway_metering", "CTC+FPI")
    state = np.array(problem.start_state)
    for k in range(run.cycles):
        assert run["state"][k] == pytest.approx(state, rel=1e-13, abs=1e-12)
        middle = (k + 0.5) * problem.period
        demands = (
            np.interp(middle, [2, 2.25], [3500, 1000]),
            np.interp(middle, [0, 0.15, 0.35, 0.5], [500, 1500, 1500, 500]),
        )
        for _ in range(6):
            state = by_hand(state, float(run["command.r"][k]), demands)


def by_hand(state: np.ndarray, rate: float, demands: tuple[float, float]) -> np.ndarray:
    """One step of METANET in numpy, with the published numbers."""
    rho, v, w = state[:6], state[6:12], state[12:]
    room = np.minimum(1, (180 - rho[[0, 4]]) / (180 - 33.5))
    main, ramp = np.array([1, rate]) * np.minimum(np.array(demands) + w / T, np.array([4000, 2000]) * room)
    flow, merging = 2 * rho * v, np.array([0, 0, 0, 0, ramp, 0])
    ahead, settling = np.append(rho[1:], min(rho[5], 33.5)), 102 * np.exp(-((rho / 33.5) ** 1.867) / 1.867)
    later = v + T / (18 / 3600) * (settling - v) + T * v * (np.append(v[0], v[:-1]) - v)
    later = later - 60 * T / (18 / 3600) * (ahead - rho) / (rho + 40) - 0.0122 * T / 2 * merging * v / (rho + 40)
    dense = rho + T / 2 * (np.append(main, flow[:-1]) - flow + merging)
    return np.concatenate([dense, later, w + T * (np.array(demands) - [main, ramp])])


def test_a_metered_ramp_saves_time() -> None:
    """An open ramp lets the density rise to 71, where traffic is slow; metered, all together spend less time, queue included."""
    metered, start = run_of("freeway_metering", "CTC+FPI")["state"], task("freeway_metering").problem.start_state
    free = np.vstack([start, open_loop()[:359]])
    spent = [hours * (2 * s[:, :6].sum() + s[:, 12:].sum()) for hours, s in ((T, free), (6 * T, metered))]
    assert spent == pytest.approx([570.8, 553.5], abs=0.2)
    assert free[:, 4].max() == pytest.approx(71, abs=0.5)
    assert metered[:, 4].max() < 33


# The time spent


@pytest.mark.parametrize("which", slow_but(("ipopt", "shipped", "one start"), "shipped"))
def test_an_economic_plan_is_the_published_run(which: str) -> None:
    """The rates of 17 minutes and the time spent after 96 steps of sym-metanet's metering, which IPOPT solves there.

    IPOPT here, and the shipped plan from two starts, have them. From the last plan alone another minimum is found in minute 6.
    """
    shipped, rates = (
        task("freeway_economic"),
        np.loadtxt(DATA.with_name("metering.csv"), delimiter=",", skiprows=1)[:, 1],
    )
    plans: Any = shipped.controllers["RHC"]
    own = plans.optimiser
    optimiser = {"ipopt": fp.Ipopt(), "shipped": own, "one start": replace(own, second_start=False)}[which]
    known = fp.ExactModel(fp.RecedingHorizon(optimiser))
    minutes = 7 if which == "one start" else 17
    run = fp.simulate(replace(shipped.problem, duration=minutes / 60), known, seed=0, compiled=False)
    if which == "one start":
        assert run["command.r"][6] > rates[6] + 0.1
        assert run["solve.stationarity"].max() < own.tolerance
        return
    assert run["command.r"] == pytest.approx(rates, abs=0.002)
    assert run["plant_state.spent"][16] == pytest.approx(96.813, abs=0.011)


def test_a_sign_limits_the_speed_at_which_traffic_settles() -> None:
    """One step of the map by hand: v moves towards 1.1 times what the sign shows where that is less, and nothing else changes."""
    plant = replace(task("freeway_coordinated").problem.plant, steps=1)
    state = np.array(task("freeway_coordinated").problem.start_state)
    step = plant.equations.next
    before = by_hand(state[:14], 0.4, tuple(plant.exact[-2:]))
    for shown, slower in (((90.0, 90.0), (0.0, 0.0)), ((50.0, 90.0), (1.0, 0.0)), ((50.0, 40.0), (1.0, 1.0))):
        after = np.ravel(step(state, [0.4, *shown], plant.exact, np.zeros(len(plant.names))).full())
        limited = [
            min(0.0, 1.1 * sign - 102 * np.exp(-((rho / 33.5) ** 1.867) / 1.867))
            for sign, rho in zip(shown, state[2:4], strict=True)
        ]
        wanted = before.copy()
        wanted[8:10] += T / (18 / 3600) * np.array(limited)
        assert after[:14] == pytest.approx(wanted, rel=1e-13)
        assert after[-2:] == pytest.approx(shown)
        assert (np.array(limited) < 0).tolist() == (np.array(slower) > 0).tolist()


PUBLISHED_SIGNS = DATA.with_name("coordinated.csv")  # minute, rate, two signs


def published_signs() -> np.ndarray:
    """Rate and signs of 17 minutes of the source's coordinated run, shape (17, 3)."""
    return np.loadtxt(PUBLISHED_SIGNS, delimiter=",", skiprows=1)[:, 1:]


def spent_in(commands: np.ndarray) -> np.ndarray:
    """Time spent after each step under commands by minute, veh h."""
    plant = task("freeway_coordinated").problem.plant
    return driven("freeway_coordinated", np.repeat(commands, 6, axis=0))[:, plant.state.elements.index("spent")]


def test_published_signs_and_rates_spend_the_published_time() -> None:
    """The map with its minimum, under the 100 steps of the source's coordinated run: 102.07711241922753 veh h."""
    assert spent_in(published_signs())[99] == pytest.approx(102.07711241922753, abs=1e-9)


# Emission


def settled_emission(flow: float, rate: float, p: dict[str, float]) -> float:
    """The model's map by bisection: LANES rho V(rho) = flow on the free branch."""

    def emitted(q: float) -> float:
        low, high = 0.0, p["rho_crit"]
        for _ in range(100):
            rho = (low + high) / 2
            speed = p["v_free"] * np.exp(-((rho / p["rho_crit"]) ** p["a"]) / p["a"])
            low, high = (rho, high) if 2 * rho * speed < q else (low, rho)
        return float(q * (1374 / speed + 47.5 + 0.00867 * speed**2) / 1000)

    return 4 * emitted(flow) + 2 * emitted(flow + 2000 * rate)


@pytest.mark.parametrize("which", ["approximate", "exact"])
def test_the_static_map_is_that_of_settled_traffic(which: str) -> None:
    """Eight steps of Newton's method inside the map against bisection, for all rates."""
    plant = task("freeway").problem.plant
    values = getattr(plant, which)
    p = dict(zip(plant.parameters, values, strict=True))
    for rate in np.linspace(0.0, 0.6, 13):
        mapped = float(plant.equations.controlled_response([50.0], rate, values))
        assert mapped == pytest.approx(settled_emission(2500.0, rate, p), rel=1e-9)


def test_the_iteration_holds_the_emission() -> None:
    """The figures of the description; the map alone stays at its largest rate."""
    assert error("freeway", "static map") == pytest.approx(71.8, rel=0.02)
    assert error("freeway", "static map+FPI") == pytest.approx(1.56, rel=0.02)
    assert run_of("freeway", "static map")["clipped"].all()
    assert run_of("freeway", "static map+FPI")["clipped"][30:].sum() == 0
    assert run_of("freeway", "static map+FPI")["reality_state.w2"].min() > 6  # so the ramp is never short of cars
    assert run_of("freeway", "static map+FPI")["reality_state.w2"].max() < 1760


def test_the_shift_of_the_target_is_that_of_a_loop_by_hand() -> None:
    """Half the map's gain times the measured error is taken off the target, once a minute, where the rate is inside its limits."""
    run, problem = run_of("freeway", "static map+FPI"), task("freeway").problem
    period, gain, shift = problem.period, 1.25, 0.0
    emission, free = run["output.emission"], run["clipped"] == 0
    for k in range(1, 120):
        wanted = shift - gain * (emission[k] - 2140 - 25 * np.sin(2 * np.pi * k * period))
        shift = float(run["shift.emission"][k])
        if free[k - 1] or abs(wanted) < abs(shift):
            assert shift == pytest.approx(wanted, abs=1e-8)


class Road:
    """METANET in numpy as a body outside: it measures the queue and the emission."""

    def __init__(self, problem: fp.Problem) -> None:
        self.problem = problem

    def reset(self, seed: int) -> list[float]:  # noqa: ARG002 -- nothing is random
        """Go to the start."""
        self.state = np.array(self.problem.real_start)
        return self.measured()

    def step(self, time: float, command: np.ndarray) -> list[float]:
        """Hold the rate for a minute; the demand is that of each of its steps."""
        steps = 6
        for j in range(steps):
            middle = time + (j + 0.5) / steps * self.problem.period
            demands = 2500 + 80 * np.sin(2 * np.pi * middle / 1.7), 1100.0
            self.state = by_hand(self.state, float(command[0]), demands)
        return self.measured()

    def measured(self) -> list[float]:
        """Queue and emission."""
        density, speed = self.state[:6], self.state[6:12]
        emitted = 2 * density * speed * (1374 / speed + 47.5 + 0.00867 * speed**2)
        return [float(self.state[13]), float(emitted.sum() / 1000)]


def test_a_body_outside_is_the_same_freeway() -> None:
    """Reset and step in place of the symbolic reality: the same commands. Without a lag nothing depends on the start before it."""
    problem = replace(task("freeway").problem, duration=1.0)
    roomy = replace(
        problem.plant, ranges={"w2": (0.0, 1000.0)}
    )  # else the gate of a body doubts a queue of 500 vehicles
    problem = replace(problem, plant=roomy)
    outside = replace(problem, reality=fp.ExternalPlant(Road(problem), measures={"w2": "veh", "emission": "kg/h"}))
    cascade = fp.Cascade(fp.FeedforwardOnly(), fp.Affine(gain=-1.0), fp.ThroughModel(lag=0.0))
    one, other = (fp.simulate(p, cascade, seed=0, compiled=False) for p in (problem, outside))
    for name in ("command.r", "output.emission", "shift.emission", "realised.emission"):
        assert other[name] == pytest.approx(one[name], rel=1e-9), name
