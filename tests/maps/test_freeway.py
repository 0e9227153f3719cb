"""The freeway: METANET against a published run, its ramp, and the emission that an iteration on targets holds.

The reference is a run of 900 steps of FilippoAiraldi/sym-metanet (MIT licence, tests/data/freeway/LICENSE), every twentieth row.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.plants import simulated

import fpirhc as fp

DATA = Path(__file__).parents[1] / "data" / "freeway" / "reference.csv"
T = 10 / 3600  # h
TOTAL_TIME_SPENT = 1433.7876921  # veh h


@cache
def task(name: str) -> Any:
    return fp.load_problem(name)


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
    plant = replace(problem.plant, steps=1)  # of 10 s, and not the six of a minute
    run = plant.equations.next.mapaccum(len(commands))
    still = np.zeros((len(plant.names), 1))
    return np.asarray(run(problem.start_state, commands.T, with_demands(plant, len(commands)).T, still).full()).T


def test_metanet_is_the_published_run() -> None:
    """Densities, speeds and queues to rounding, and the total time spent to every printed digit."""
    rows = np.loadtxt(DATA, delimiter=",", skiprows=1)
    states = driven("freeway_metering", np.ones((900, 1)))  # with an open ramp
    at, published = rows[:, 0].astype(int), rows[:, 1:]
    assert len(at) == 45
    np.testing.assert_allclose(states[at], published, rtol=1e-14, atol=2e-13)
    cars = 2 * states[:, :6].sum(axis=1) + states[:, 12:].sum(axis=1)
    assert T * cars.sum() == pytest.approx(TOTAL_TIME_SPENT, abs=1e-7)


# Metering


def test_an_exact_map_of_a_minute_has_no_error() -> None:
    """Six steps with the rate held are one map, whose inverse the controller has."""
    shipped = task("freeway_metering")
    run = simulated(shipped.problem, shipped.controllers["CTC exact model"])
    assert max(fp.measure(shipped.problem, run).rms_error.values()) < 1e-12


# The time spent


@pytest.mark.slow
@pytest.mark.parametrize("which", ["shipped", "one start"])
def test_an_economic_plan_is_the_published_run(which: str) -> None:
    """The rates of 17 minutes and the time spent after 96 steps of sym-metanet's metering; one start ends in another minimum."""
    shipped = task("freeway_economic")
    rates = np.loadtxt(DATA.with_name("metering.csv"), delimiter=",", skiprows=1)[:, 1]
    plans: Any = shipped.controllers["RHC"]
    own = plans.optimiser
    optimiser = {"shipped": own, "one start": replace(own, second_start=False)}[which]
    known = fp.ExactModel(fp.RecedingHorizon(optimiser))
    minutes = 7 if which == "one start" else 17
    run = fp.simulate(replace(shipped.problem, duration=minutes / 60), known, seed=0, compiled=False)
    if which == "one start":
        assert run["command.r"][6] > rates[6] + 0.1
        assert run["solve.stationarity"].max() < own.tolerance
        return
    assert run["command.r"] == pytest.approx(rates, abs=0.002)
    assert run["plant_state.spent"][16] == pytest.approx(96.813, abs=0.011)


def test_published_signs_and_rates_spend_the_published_time() -> None:
    """The map with its minimum, under the 100 steps of the source's coordinated run: 102.07711241922753 veh h."""
    commands = np.loadtxt(DATA.with_name("coordinated.csv"), delimiter=",", skiprows=1)[:, 1:]  # of 17 minutes
    states = driven("freeway_coordinated", np.repeat(commands, 6, axis=0))
    spent = task("freeway_coordinated").problem.plant.state.elements.index("spent")
    assert states[99, spent] == pytest.approx(102.07711241922753, abs=1e-9)


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
