"""One symbolic step: the loop and a Stepper, in the virtual machine and in C, give the same commands for the same measurements.

The laws of controllers say so of every controller on two masses between springs; here every kind of problem does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import abroad
import numpy as np
import pytest
from plants import pendulum

import fpirhc as fp
from fpirhc.conformance.controller import same_command_everywhere
from fpirhc.conformance.laws import keep
from fpirhc.conformance.loops import Trial
from fpirhc.controllers.base import Controller
from fpirhc.symbolic.native import find_compiler

Loop = tuple[fp.Problem, Controller]
FPI = fp.ComputedTorque(fp.Exponential(rate=0.5), fp.Affine(gain=-0.5))
SCALED = fp.Sigmoid(gain=-0.5, scale=50.0)
REFERENCED = fp.ModelReferenced(SCALED, lag=(1e-3, 0.0))
CYCLES = 40


def shipped(name: str, controller: str) -> Callable[[], Loop]:
    """A shipped problem and one of its controllers."""

    def make() -> Loop:
        task = fp.load_problem(name)
        return task.problem, task.controllers[controller]

    return make


def in_every_cycle(name: str, controller: str, growth: float = 1.0) -> Callable[[], Loop]:
    """A shipped problem whose stages last longer than a cycle, with a plan in every cycle."""

    def make() -> Loop:
        problem, chosen = shipped(name, controller)()
        assert problem.horizon is not None
        assert problem.horizon.step > 1.5 * problem.period
        lengths = tuple(growth**k for k in range(problem.horizon.stages)) if growth > 1 else ()
        return replace(problem, horizon=replace(problem.horizon, replan="cycle", lengths=lengths)), chosen

    return make


def believing(
    name: str, observer: Any, estimator: Any, measured: str, controller: Controller | str
) -> Callable[[], Loop]:
    """A plant of others of which one state is measured, late by two cycles, and the others are believed."""

    def make() -> Loop:
        task = abroad.load(name)
        problem = task.problem
        late = fp.DeadTime(measurement=2 * problem.period)
        sensing = fp.Sensing({}, estimator, measured=[measured], observer=observer)
        chosen = task.controllers[controller] if isinstance(controller, str) else controller
        return replace(problem, sensing=sensing, dead_time=late), chosen

    return make


def sensed(estimator: Any, controller: Controller) -> Callable[[], Loop]:
    """Two masses seen late by coarse encoders with noise that lose samples, through an estimator."""

    def make() -> Loop:
        problem = fp.load_problem("two_mass").problem
        sensor = fp.Sensor(noise=fp.ColouredNoise(1e-5, 1e-2), quantum=1e-5, dropout=0.1)
        late = fp.DeadTime(inputs={"Q1": 0.002, "Q2": 0.001}, measurement=0.0015)
        return replace(problem, sensing=fp.Sensing({"q1": sensor, "q2": sensor}, estimator), dead_time=late), controller

    return make


class Swing:
    """A pendulum outside."""

    def reset(self, seed: int) -> Any:
        """At rest."""
        del seed
        self.x = np.zeros(2)
        return np.array([0.0, 0.0, 0.0])

    def step(self, time: float, command: Any) -> Any:
        """One Euler step."""
        del time
        acceleration = command[0] / 0.36 - 16.35 * np.sin(self.x[0])
        self.x = self.x + 0.01 * np.array([self.x[1], acceleration])
        return np.array([*self.x, acceleration])


def outside() -> Loop:
    measures = {"angle": "rad", "angle'": "rad/s", "angle''": "rad/s^2"}
    problem = fp.Problem(
        plant=pendulum(),
        reference=fp.Trajectory(lambda t: {"angle": 0.3 + 0 * t}),
        start={"angle": 0.0},
        period=0.01,
        duration=1.0,
        reality=fp.ExternalPlant(Swing(), measures),
    )
    return problem, fp.ComputedTorque(fp.Exponential(rate=4.0), fp.Affine(gain=-0.5))


LOOPS: dict[str, Callable[[], Loop]] = {
    "outputs, outside signals": shipped("anaesthesia_stimulated", "RHC+FPI"),
    "map": shipped("fishery", "RHC+FPI"),
    "order zero, reality": shipped("freeway", "static map+FPI"),
    "map with signals": shipped("freeway_metering", "CTC+FPI"),
    "cascade": shipped("heat_exchanger", "Cascade"),
    "noise": shipped("noisy_motor", "RHC+FPI"),
    "plans between stages": in_every_cycle("noisy_motor", "RHC+FPI"),
    "growing stages": in_every_cycle("two_mass", "RHC+FPI", growth=1.1),
    "predicted plans between stages": in_every_cycle("delayed_mass", "RHC+FPI"),
    "prediction": shipped("delayed_mass", "RHC+FPI"),
    "slots": shipped("cart_pole_slots", "slots+FPI"),
    "learning": shipped("turbojet", "RHC offset-free"),
    "position difference": sensed(fp.PositionDifference(), fp.ComputedTorque(fp.Exponential(rate=6.0), SCALED)),
    "polynomials": sensed(fp.SavitzkyGolay(window=7, degree=4), fp.ComputedTorque(fp.Exponential(rate=6.0), SCALED)),
    "twin": sensed(fp.StateVariableFilter(bandwidth=300.0), fp.ComputedTorque(fp.Exponential(rate=6.0), REFERENCED)),
    "model's states": believing("drug_infusion", fp.ModelStates(), fp.VelocityDifference(), "C1", FPI),
    "Kalman": believing(
        "flexible_servo",
        fp.KalmanFilter(measured={"motor": 1e-3}, noise={"load": 1.0, "motor": 1.0}),
        fp.PositionDifference(),
        "motor",
        FPI,
    ),
    "outside": outside,
}


@pytest.mark.parametrize("name", LOOPS)
def test_every_kind_of_problem_has_one_step(name):
    """Bit by bit, but for C, which orders sums in its own way: the loop in C and a Stepper in C to 1e-9."""
    problem, controller = LOOPS[name]()
    problem = replace(problem, duration=CYCLES * problem.period, measure_from=0.0)
    trial = Trial(controller, problem, seed=1, left=1.0, compiled=True)
    keep(controller, trial, [same_command_everywhere], seed=1)
    run = fp.simulate(problem, controller, seed=1)
    assert run.compiled == (find_compiler() is not None)
    assert run.cycles == trial.run.cycles == CYCLES
    for signal in ("command", "state", "desired"):
        scale = np.abs(trial.run[signal]).max(initial=1e-300)
        np.testing.assert_allclose(run[signal], trial.run[signal], rtol=0, atol=1e-9 * scale)
