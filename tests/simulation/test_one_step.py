"""One symbolic step: loop, Stepper and a user's own loop give the same commands for the same samples, in Python and in C."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from helpers.forms import FORMS
from helpers.machine import COMPILER
from helpers.replay import replayed, samples, status

import fpirhc as fp
from fpirhc.conformance import examples
from fpirhc.contracts import Controller

Loop = tuple[fp.Problem, Controller]
FPI = fp.ComputedTorque(fp.Exponential(rate=3.0), fp.Affine(gain=-0.2))
REFERENCED = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.ModelReferenced(fp.Affine(gain=-0.05), lag=(1e-3, 0.0)))
CYCLES = 40


def shipped(name: str, controller: str) -> Loop:
    """A shipped problem and one of its controllers."""
    task = fp.load_problem(name)
    return task.problem, task.controllers[controller]


def in_every_cycle(name: str, controller: str, growth: float = 1.0) -> Loop:
    """A shipped problem whose stages last longer than a cycle, with a plan in every cycle."""
    problem, chosen = shipped(name, controller)
    assert problem.horizon is not None
    assert problem.horizon.step > 1.5 * problem.period
    lengths = tuple(growth**k for k in range(problem.horizon.stages)) if growth > 1 else ()
    return replace(problem, horizon=replace(problem.horizon, replan="cycle", lengths=lengths)), chosen


def sensed(estimator: Any, lost: float = 0.0) -> Loop:
    """Two masses seen late by coarse encoders with noise, which may lose samples, through an estimator."""
    problem = fp.load_problem("two_mass").problem
    sensor = fp.Sensor(noise=fp.Noise(1e-5, 1e-2), quantum=1e-5, dropout=lost)
    late = fp.DeadTime(inputs={"Q1": 0.002, "Q2": 0.001}, measurement=0.0015)
    return replace(problem, sensing=fp.Sensing({"q1": sensor, "q2": sensor}, estimator), dead_time=late), REFERENCED


def on_form(name: str) -> Loop:
    """A form of the problem of one moved thing, with adaptation where its output has an order."""
    problem, order = FORMS[name]
    return problem, FPI if order else fp.Cascade(fp.FeedforwardOnly(), fp.Affine(gain=-0.3), lag=0.0)


LOOPS: dict[str, Callable[[], Loop]] = {
    "outputs, outside signals": partial(shipped, "anaesthesia_stimulated", "RHC+FPI"),
    "map": partial(shipped, "fishery", "RHC+FPI"),
    "order zero, reality": partial(shipped, "freeway", "static map+FPI"),
    "map with signals": partial(shipped, "freeway_metering", "CTC+FPI"),
    "cascade": partial(shipped, "heat_exchanger", "Cascade"),
    "noise": partial(shipped, "noisy_motor", "RHC+FPI"),
    "plans between stages": partial(in_every_cycle, "noisy_motor", "RHC+FPI"),
    "growing stages": partial(in_every_cycle, "two_mass", "RHC+FPI", growth=1.1),
    "predicted plans between stages": partial(in_every_cycle, "delayed_mass", "RHC+FPI"),
    "prediction": partial(shipped, "delayed_mass", "RHC+FPI"),
    "slots": partial(shipped, "cart_pole_slots", "slots+FPI"),
    "learning": partial(shipped, "turbojet", "RHC offset-free"),
    "lost": partial(sensed, fp.PositionDifference(), lost=0.1),
}
INTERPRETED = {
    **{name: partial(on_form, name) for name in FORMS},
    **{str(e): partial(sensed, e) for e in examples("derivative estimators")},
}


@dataclass(frozen=True, eq=False)
class Trial:
    """A short loop: its run in the virtual machine, and a stepper that is given its samples."""

    problem: fp.Problem
    controller: Controller
    run: fp.Run
    stepper: fp.Stepper
    in_c: bool


@pytest.fixture(scope="module", params=LOOPS | INTERPRETED)
def trial(request) -> Trial:
    """A short loop of every kind."""
    problem, controller = (LOOPS | INTERPRETED)[request.param]()
    problem = replace(problem, duration=CYCLES * problem.period, measure_from=0.0)
    run = fp.simulate(problem, controller, seed=1, compiled=False)
    assert run.cycles == CYCLES
    stepper = fp.Stepper(problem, controller, compiled=False, bounded=False)
    return Trial(problem, controller, run, stepper, request.param in LOOPS)


class Fed:
    """The stepper of a trial, given the samples of its run one after the other."""

    def __init__(self, trial: Trial, memory: np.ndarray | None = None) -> None:
        self.stepper, self.run, self.measured = trial.stepper, trial.run, samples(trial.run)
        self.memory = self.stepper.start() if memory is None else memory

    def __call__(self, cycle: int, bad: float | None = None, place: int = 0) -> np.ndarray:
        """The command of a cycle, after a sample with a bad number at a place."""
        sample = self.measured[cycle].copy()
        sample[place] = sample[place] if bad is None else bad
        command, self.memory = self.stepper.step_measured(float(self.run.time[cycle]), sample, self.memory)
        return command

    @property
    def status(self) -> fp.Status:
        return status(self.stepper)


def test_every_kind_of_problem_has_one_step(trial):
    """The loop and a Stepper, and of those that are shipped both in C, which orders sums in its own way."""
    assert len(trial.stepper.measures) == samples(trial.run).shape[1]

    def same(found: Any, signal: str) -> None:
        scale = np.abs(trial.run[signal]).max(initial=1e-300)
        np.testing.assert_allclose(found, trial.run[signal], rtol=0, atol=1e-9 * scale)

    same(replayed(trial.stepper, trial.run)[0], "command")
    if trial.in_c:
        compiled = fp.simulate(trial.problem, trial.controller, seed=1)
        assert compiled.compiled == (COMPILER is not None)
        same(replayed(fp.Stepper(trial.problem, trial.controller, bounded=False), trial.run)[0], "command")
        for signal in ("command", "state", "desired"):
            same(compiled[signal], signal)
    lost = replayed(trial.stepper, trial.run)[1] == fp.Status.BAD_SAMPLE
    np.testing.assert_array_equal(lost, trial.run["status"].ravel() == fp.Status.BAD_SAMPLE)


@pytest.mark.parametrize(("bad", "place"), [(np.nan, 0), (np.inf, -1)])
def test_a_bad_sample_is_a_skipped_tick(trial, bad, place):
    """The command is the last one, and everything is as if the tick had been missed."""
    fed = Fed(trial)
    command = [fed(k) for k in range(12)][-1]
    missed, skipped = Fed(trial, fed.memory), trial.stepper.trace()["skipped"][0]
    assert np.array_equal(fed(12, bad, place), command)
    assert fed.status == fp.Status.BAD_SAMPLE
    assert trial.stepper.trace()["skipped"] == skipped + 1
    assert all(np.array_equal(fed(k), missed(k)) for k in range(13, 25))


def test_a_run_begins_at_the_first_good_sample(trial):
    """Bad samples before it leave no trace but their count."""
    fresh, late = Fed(trial), Fed(trial)
    assert all(np.isfinite(late(k, np.nan)).all() for k in range(5))
    assert all(np.array_equal(fresh(k), late(k)) for k in range(5, 20))


def test_a_poisoned_memory_is_that_of_the_start(trial):
    """The first good sample is then the first cycle of a run; with a bad one the start's command is held."""
    good = next(k for k in range(3, 40) if np.isfinite(samples(trial.run)[k : k + 2]).all())
    poisoned = np.full(trial.stepper.memory.size, np.nan)
    fresh, fed = Fed(trial), Fed(trial, poisoned)
    expected, begun = fresh(good), fresh.status
    assert np.array_equal(fed(good), expected)
    assert fed.status == max(fp.Status.RESTARTED, begun, key=lambda s: s.severity)
    assert np.array_equal(fed.memory, fresh.memory)
    fed = Fed(trial, poisoned)
    assert np.isfinite(fed(good, np.nan)).all()
    assert np.array_equal(fed(good + 1), Fed(trial)(good + 1))


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


# The step as a CasADi Function, which a loop of a user's own calls
CASES = {
    "CTC+FPI": ("two_mass", "CTC+FPI (eq 6)", ["deformation.gain", "limits.inputs.Q1.0", "limits.inputs.Q1.1"]),
    "RHC+FPI": ("two_mass", "RHC+FPI", ["deformation.gain", "cost.states.q1"]),
    "outputs": ("anaesthesia", "CTC+FPI", []),
    "map": ("fishery", "RHC+FPI", []),
}


@cache
def case(name: str) -> tuple[fp.Stepper, np.ndarray]:
    """A stepper, and rows of what it reads: a run's samples, with faults in some of them."""
    of, controller, live = CASES[name]
    stepper = fp.Stepper(*shipped(of, controller), live=live, compiled=False, bridged=0)
    run = fp.simulate(*shipped(of, controller), seed=0, compiled=False)
    rows = np.tile(stepper.reads.start(), (CYCLES, 1))
    for signal in stepper.reads.signals:
        if signal.name in ("time", "state", "output", "realised", "measured"):
            values = run.time if signal.name == "time" else run[signal.name]
            rows[:, stepper.reads.slice(signal.name)] = np.reshape(values[:CYCLES], (CYCLES, -1))
    first = stepper.reads.slice("time").stop
    if name != "map":  # after a gap the stepper of a map fills its windows, which a Function alone does not
        rows[10, first], rows[15, first], rows[20:22, first] = np.nan, np.inf, 1e9
    return stepper, rows


def stepped(stepper: fp.Stepper, row: np.ndarray, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The stepper's own cycle with one row of what it reads."""
    measured = row[stepper.reads.slice("time").stop :][: len(stepper.measures)]  # samples come first, as in `measures`
    return stepper.step_measured(row[stepper.reads.slice("time")][0], measured, memory)


def same_bits(one: np.ndarray, other: np.ndarray) -> bool:
    return np.array_equal(one, other, equal_nan=True)


@pytest.mark.parametrize("name", CASES)
def test_a_loop_of_ones_own_is_the_stepper_bit_by_bit(name):
    """Command, memory and every signal, with faults, where no missing cycles are run afterwards."""
    stepper, rows = case(name)
    own = memory = stepper.start()
    for k, row in enumerate(rows):
        arguments = stepper.reads.unpack(row).values()
        own, trace, command = (v.full().ravel() for v in stepper.function(own, *arguments))
        expected, memory = stepped(stepper, row, memory)
        assert same_bits(command, expected), k
        assert same_bits(own, memory), k
        # A status that tells of a gap is given by who calls the step.
        shown = {name: value for name, value in stepper.trace().items() if name != "status" or k < 10}
        places = dict(zip(stepper.trace(), np.cumsum([v.size for v in stepper.trace().values()]), strict=True))
        assert all(same_bits(trace[places[n] - v.size : places[n]], v) for n, v in shown.items()), k


def test_bounds_are_where_the_check_begins_to_refuse():
    """Every number inside is accepted, and one a little beyond an end is refused; limits of inputs end at those of the build."""
    live = ["deformation.gain", "tracking.rate", "limits.inputs.Q1.0", "limits.inputs.Q1.1"]
    stepper = fp.Stepper(*shipped("two_mass", "CTC+FPI (eq 6)"), live=live, compiled=False)
    bounds, build = stepper.bounds(), dict(stepper.numbers)
    assert list(bounds) == live
    for path in ("deformation.gain", "tracking.rate"):
        for end, away in zip(bounds[path], (-1, 1), strict=True):
            size = max(abs(build[path]), abs(end)) if np.isfinite(end) else 1.0
            assert stepper.change({path: end if np.isfinite(end) else away * 1e200})
            assert np.isinf(end) or not stepper.change({path: end + away * 1e-5 * size}), (path, end)
            assert stepper.change({path: build[path]})
    assert bounds["limits.inputs.Q1.0"][0] == build["limits.inputs.Q1.0"]
    assert bounds["limits.inputs.Q1.1"][1] == build["limits.inputs.Q1.1"]
    assert bounds["limits.inputs.Q1.0"][1] == pytest.approx(build["limits.inputs.Q1.1"], rel=1e-4)
    assert bounds["deformation.gain"][1] == pytest.approx(0.0, abs=1e-5)
