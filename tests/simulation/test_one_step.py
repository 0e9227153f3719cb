"""One symbolic step: the loop and a Stepper, in the virtual machine and in C, give the same commands for the same measurements.

The laws of controllers say so of every controller on two masses between springs; here every kind of problem does, and none of
them remembers a bad sample or a poisoned memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import abroad
import numpy as np
import pytest
from helpers.gaps import gone_on
from helpers.plants import pendulum

import fpirhc as fp
from fpirhc import Status
from fpirhc.conformance.controller import same_command_everywhere
from fpirhc.conformance.laws import keep
from fpirhc.conformance.loops import Trial
from fpirhc.contracts import Controller
from fpirhc.members import examples
from fpirhc.simulation.step_arguments import raw_measurements
from fpirhc.symbolic.native import find_compiler

Loop = tuple[fp.Problem, Controller]
FPI = fp.ComputedTorque(fp.Exponential(rate=0.5), fp.Affine(gain=-0.5))
REFERENCED = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.ModelReferenced(fp.Affine(gain=-0.05), lag=(1e-3, 0.0)))
COMPARTMENTS: dict[str, Any] = {"measured": {"bis": 0.5}, "noise": {"C1": 0.3, "C2": 0.02, "C3": 0.02, "Ce": 0.1}}
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


def of_outputs(estimator: Any, observer: Any = None, late: float = 0.0) -> Callable[[], Loop]:
    """A noisy output that is estimated, beside states that are given, or whose states are believed."""

    def make() -> Loop:
        task = fp.load_problem("anaesthesia")
        measured = None if observer is None else ["bis"]
        sensing = fp.Sensing({"bis": fp.Sensor(noise=fp.Noise(0.3))}, estimator, measured=measured, observer=observer)
        dead_time = fp.DeadTime(measurement=late * task.problem.period)
        chosen = task.controllers["CTC"].with_deformation(fp.Affine(gain=-0.1))
        return replace(task.problem, sensing=sensing, dead_time=dead_time), chosen

    return make


def sensed(estimator: Any, controller: Controller, lost: float = 0.0) -> Callable[[], Loop]:
    """Two masses seen late by coarse encoders with noise, which may lose samples, through an estimator."""

    def make() -> Loop:
        problem = fp.load_problem("two_mass").problem
        sensor = fp.Sensor(noise=fp.ColouredNoise(1e-5, 1e-2), quantum=1e-5, dropout=lost)
        late = fp.DeadTime(inputs={"Q1": 0.002, "Q2": 0.001}, measurement=0.0015)
        return replace(problem, sensing=fp.Sensing({"q1": sensor, "q2": sensor}, estimator), dead_time=late), controller

    return make


class Swing:
    """A pendulum outside."""

    def reset(self, seed: int) -> Any:
        del seed
        self.x = np.zeros(2)
        return np.array([0.0, 0.0, 0.0])

    def step(self, time: float, command: Any) -> Any:
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
    "Kalman": believing(
        "flexible_servo",
        fp.KalmanFilter(measured={"motor": 1e-3}, noise={"load": 1.0, "motor": 1.0}),
        fp.PositionDifference(),
        "motor",
        FPI,
    ),
    "plans of believed tanks": believing(
        "quadruple_tank",
        fp.KalmanFilter(measured={"h1": 1e-2}, noise=dict.fromkeys(("h1", "h3", "h4"), 0.01)),
        fp.VelocityDifference(),
        "h1",
        "RHC",
    ),
    "differences of outputs": of_outputs(fp.PositionDifference()),
    "polynomials of outputs": of_outputs(fp.SavitzkyGolay(window=5, degree=3)),
    "late velocities of outputs": of_outputs(fp.VelocityDifference(), late=1.5),
    "Kalman behind outputs": of_outputs(fp.PositionDifference(), fp.KalmanFilter(**COMPARTMENTS)),
    "outside": outside,
} | {str(e): sensed(e, REFERENCED) for e in examples("derivative estimators")}
GO_ON = ("observe", "estimate_", "filter_", "mirror_", "queue_", "pair_", "delay_", "sent")  # without a sample


def short(loop: Callable[[], Loop]) -> Trial:
    problem, controller = loop()
    problem = replace(problem, duration=CYCLES * problem.period, measure_from=0.0)
    return Trial(controller, problem, seed=1, left=1.0, compiled=True)


@pytest.fixture(scope="module", params=LOOPS)
def trial(request) -> Trial:
    """A short loop of every kind."""
    return short(LOOPS[request.param])


class Fed:
    """The stepper of a trial, given the samples of its run one after the other."""

    def __init__(self, trial: Trial, memory: np.ndarray | None = None) -> None:
        self.stepper, self.run, self.measured = trial.stepper, trial.run, raw_measurements(trial.run)
        self.memory = self.stepper.start() if memory is None else memory

    def __call__(self, cycle: int, bad: float | None = None, place: int = 0) -> np.ndarray:
        """The command of a cycle, after a sample with a bad number at a place."""
        sample = self.measured[cycle].copy()
        sample[place] = sample[place] if bad is None else bad
        command, self.memory = self.stepper.step_measured(float(self.run.time[cycle]), sample, self.memory)
        return command

    @property
    def status(self) -> Status:
        return Status(int(self.stepper.trace()["status"][0]))


def test_every_kind_of_problem_has_one_step(trial):
    """Bit by bit, but for C, which orders sums in its own way: the loop in C and a Stepper in C to 1e-9."""
    keep(trial.controller, trial, [same_command_everywhere], seed=1)
    run = fp.simulate(trial.problem, trial.controller, seed=1)
    assert run.compiled == (find_compiler() is not None)
    assert run.cycles == trial.run.cycles == CYCLES
    assert len(trial.stepper.measures) == raw_measurements(trial.run).shape[1]
    for signal in ("command", "state", "desired"):
        scale = np.abs(trial.run[signal]).max(initial=1e-300)
        np.testing.assert_allclose(run[signal], trial.run[signal], rtol=0, atol=1e-9 * scale)


def test_a_run_with_lost_samples_has_one_step():
    """The rows that its measurements have for a Stepper are NaN where one was lost."""
    trial = short(sensed(fp.PositionDifference(), REFERENCED, lost=0.1))
    assert np.isnan(raw_measurements(trial.run)).any(axis=1).any()
    keep(trial.controller, trial, [same_command_everywhere], seed=1)


@pytest.mark.parametrize(("bad", "place"), [(np.nan, 0), (np.inf, -1)])
def test_a_bad_sample_is_a_skipped_tick(trial, bad, place):
    """The command is the last one. Estimators and queues go on, and everything is as if the tick had been missed."""
    fed = Fed(trial)
    command = [fed(k) for k in range(12)][-1]
    missed = Fed(trial, fed.memory)
    assert np.array_equal(fed(12, bad, place), command)
    assert fed.status == Status.BAD_SAMPLE
    assert trial.stepper.trace()["skipped"] == 1
    changed = gone_on(trial.stepper, missed.memory, fed.memory)
    assert all(name.startswith(GO_ON) for name in changed), changed
    assert all(np.array_equal(fed(k), missed(k)) for k in range(13, 25))


def test_a_run_begins_at_the_first_good_sample(trial):
    """Bad samples before it leave no trace but their count."""
    fresh, late = Fed(trial), Fed(trial)
    assert all(np.isfinite(late(k, np.nan)).all() for k in range(5))
    assert all(np.array_equal(fresh(k), late(k)) for k in range(5, 20))


def test_a_poisoned_memory_is_that_of_the_start(trial):
    """The first good sample is then the first cycle of a run; with a bad one the start's command is held."""
    poisoned = np.full(trial.stepper.memory.size, np.nan)
    fresh, fed = Fed(trial), Fed(trial, poisoned)
    expected, begun = fresh(3), fresh.status
    assert np.array_equal(fed(3), expected)
    assert fed.status == max(Status.RESTARTED, begun, key=lambda s: s.severity)
    assert np.array_equal(fed.memory, fresh.memory)
    fed = Fed(trial, poisoned)
    assert np.isfinite(fed(3, np.nan)).all()
    assert np.array_equal(fed(4), Fed(trial)(4))


def test_one_poisoned_number_never_stays(trial):
    """One NaN anywhere in the memory, such as in the plan's counter."""
    before = Fed(trial)
    for k in range(5):
        before(k)
    for place in range(1, before.memory.size):
        fed = Fed(trial, before.memory.copy())
        fed.memory[place] = np.nan
        assert np.isfinite(fed(5)).all()
        assert np.isfinite(fed.memory).all(), trial.stepper.memory.columns[place]
