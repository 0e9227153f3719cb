"""Sensing and controller are one step: given the raw measurements of a run it gives the run's commands, and skips bad ones."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import abroad
import casadi as ca
import numpy as np
import pytest
from gaps import gone_on

import fpirhc as fp
from fpirhc.conformance.loops import two_masses
from fpirhc.controllers.contract import Controller
from fpirhc.errors import InvalidProblem, InvalidShape
from fpirhc.members import examples
from fpirhc.sensing.base import DerivativeEstimator
from fpirhc.simulation.sample import raw_measurements
from fpirhc.simulation.simulate import simulator
from fpirhc.status import Status

ESTIMATORS: tuple[DerivativeEstimator, ...] = examples("derivative estimators")
TRACK = fp.Exponential(rate=6.0)
GENTLE = fp.Affine(gain=-0.05)
PLAN = fp.FixedPoint(iterations=1, tolerance=1e-3)
CONTROLLERS: dict[str, Controller] = {
    "computed torque": fp.ComputedTorque(TRACK, GENTLE),
    "referenced": fp.ComputedTorque(TRACK, fp.ModelReferenced(GENTLE)),
    "plan": fp.RecedingHorizon(PLAN, GENTLE),
    "predicted plan": fp.Predicted(fp.RecedingHorizon(PLAN, GENTLE), inputs=0.0, measurement=0.0125),
}
LATE = {"at once": 0.0, "2.5 cycles late": 0.0125}


def problem(estimator: DerivativeEstimator, late: float = 0.0) -> fp.Problem:
    """Two masses whose first position is noisy, rounded and sometimes lost."""
    sensor = fp.Sensor(noise=fp.Noise(1e-6), quantum=1e-7, dropout=0.05)
    sensing = fp.Sensing({"a": sensor}, estimator)
    return replace(two_masses(), duration=0.2, sensing=sensing, dead_time=fp.DeadTime(measurement=late))


@cache
def case(number: int, name: str, late: float = 0.0) -> tuple[fp.Stepper, fp.Run]:
    """A stepper and a run of the same loop."""
    task, controller = problem(ESTIMATORS[number], late), CONTROLLERS[name]
    run = fp.simulate(task, controller, seed=3, compiled=False)
    return fp.Stepper(task, controller, compiled=False, plausible=anything(task)), run


def anything(task: fp.Problem) -> dict[str, tuple[float, float]]:
    plant = task.plant
    names = task.sensing.measures(plant) if task.sensing.estimates else plant.state.elements
    return dict.fromkeys(names, (-np.inf, np.inf))


def replayed(stepper: fp.Stepper, run: fp.Run) -> np.ndarray:
    memory, commands, measured = stepper.start(), np.empty_like(run["command"]), raw_measurements(run)
    for k in range(run.cycles):
        commands[k], memory = stepper.step_measured(float(run.time[k]), measured[k], memory)
    return commands


by_name = pytest.mark.parametrize("name", CONTROLLERS)
# A twin has an estimator of its own, so it meets every one; an estimator is the same block before every other controller.
WINDOW = next(k for k, e in enumerate(ESTIMATORS) if isinstance(e, fp.SavitzkyGolay))
PAIRS = [(k, "referenced") for k in range(len(ESTIMATORS))] + [(WINDOW, n) for n in CONTROLLERS if n != "referenced"]
by_pair = pytest.mark.parametrize(("number", "name"), PAIRS, ids=[f"{ESTIMATORS[k]}-{name}" for k, name in PAIRS])


@by_pair
@pytest.mark.parametrize("late", LATE)
def test_raw_measurements_of_a_run_give_its_commands(number, name, late):
    """Bit by bit: both are the same composed step, with noise, lost samples, dead time, and the wait at the start."""
    stepper, run = case(number, name, LATE[late])
    assert np.array_equal(replayed(stepper, run), run["command"])
    assert np.ptp(run["command"], axis=0).max() > 0


def anaesthesia() -> tuple[fp.Problem, Controller]:
    task = abroad.load("drug_infusion")
    sensing = fp.Sensing({"C1": fp.Sensor(noise=fp.Noise(1e-3))}, fp.LowPassDifference(time_constant=1.0))
    return replace(task.problem, duration=10.0, measure_from=0.0, sensing=sensing), fp.ComputedTorque(
        fp.Exponential(rate=0.5), fp.Affine(gain=-0.05)
    )


def tanks() -> tuple[fp.Problem, Controller]:
    task = abroad.load("quadruple_tank")
    sensing = fp.Sensing({"h1": fp.Sensor(quantum=1e-3)}, fp.SavitzkyGolay(window=5, degree=2))
    short = 100 * task.problem.period
    return replace(task.problem, duration=short, measure_from=0.0, sensing=sensing), task.controllers["RHC"]


def servo() -> tuple[fp.Problem, Controller]:
    task = abroad.load("flexible_servo")
    sensing = fp.Sensing({}, fp.StateVariableFilter(bandwidth=60.0))
    late = fp.DeadTime(measurement=0.02)
    return replace(task.problem, duration=1.0, measure_from=0.0, sensing=sensing, dead_time=late), task.controllers[
        "RHC"
    ]


@pytest.mark.parametrize("make", [anaesthesia, tanks, servo])
def test_raw_measurements_of_plants_of_others(make):
    """Compartments in minutes, tanks, and a flexible servo with a plan: the commands of the run, bit by bit."""
    task, controller = make()
    run = fp.simulate(task, controller, seed=1, compiled=False)
    stepper = fp.Stepper(task, controller, compiled=False, plausible=anything(task))
    assert run.stop is None
    assert np.array_equal(replayed(stepper, run), run["command"])


# Bad samples

GO_ON = {"estimate_past", "filter_stages", "filter_inputs", "filter_stages_of_power", "filter_inputs_of_power", "sent"}
GO_ON |= {
    "mirror_state",
    "mirror_cycles",
    "mirror_commands",
    "mirror_deformations",
}  # of the twin, and its own estimator
GO_ON |= {"mirror_estimate_past", "mirror_filter_stages", "mirror_filter_inputs", "mirror_estimate_before"}
GO_ON |= {"mirror_estimate_smooth"}


@by_pair
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_raw_sample_is_a_skipped_tick(number, name, bad):
    """Nothing but filters and queues goes on, and afterwards everything is as if the tick had been missed."""
    stepper, run = case(number, name)
    measured, memory = raw_measurements(run), stepper.start()
    for k in range(12):
        command, memory = stepper.step_measured(float(run.time[k]), measured[k], memory)
    wrong = measured[12].copy()
    wrong[0] = bad
    held, after = stepper.step_measured(float(run.time[12]), wrong, memory)
    assert Status(int(stepper.trace()["status"][0])) == Status.BAD_SAMPLE
    assert np.array_equal(held, command)
    assert gone_on(stepper, memory, after) <= GO_ON
    for k in range(13, 25):
        with_fault, after = stepper.step_measured(float(run.time[k]), measured[k], after)
        without, memory = stepper.step_measured(float(run.time[k]), measured[k], memory)
        assert np.array_equal(with_fault, without)


def test_first_good_sample_begins_the_estimates():
    """Lost samples before it leave the start's motion in the window, as if the run had begun later."""
    stepper, run = case(WINDOW, "computed torque")
    measured, fresh, late = raw_measurements(run), stepper.start(), stepper.start()
    for k in range(3):
        held, late = stepper.step_measured(float(run.time[k]), measured[k] + np.nan, late)
        assert np.isfinite(held).all()
    for k in range(3, 15):
        one, fresh = stepper.step_measured(float(run.time[k]), measured[k], fresh)
        other, late = stepper.step_measured(float(run.time[k]), measured[k], late)
        assert np.array_equal(one, other)


def test_implausible_position_is_skipped():
    """The range is that of the measured quantity: the automatic one of a position, and one of the user's own."""
    task = problem(fp.PositionDifference())
    run = fp.simulate(task, CONTROLLERS["computed torque"], seed=3, compiled=False)
    measured = raw_measurements(run)[0]
    for own in (None, {"a": (measured[0] - 0.1, measured[0] + 0.1)}):
        stepper = fp.Stepper(task, CONTROLLERS["computed torque"], compiled=False, plausible=own)
        stepper.step_measured(0.0, measured, stepper.start())
        assert stepper.trace()["status"][0] != int(Status.BAD_SAMPLE)
        stepper.step_measured(0.0, measured + np.array([1e3, 0.0]), stepper.start())
        assert stepper.trace()["status"][0] == int(Status.BAD_SAMPLE)


# What is given, and mistakes


def test_measured_state_and_response_are_taken_as_one_vector_too():
    """Where nothing is estimated, step_measured is step with both one after the other."""
    task = replace(two_masses(), duration=0.2)
    stepper = fp.Stepper(task, CONTROLLERS["computed torque"], compiled=False)
    assert stepper.measures == ("a", "b", "a'", "b'", "a''", "b''")
    state, realised = np.array([0.1, 0.2, 0.0, 0.1]), np.array([0.3, -0.1])
    first = stepper.step(0.0, state, realised, stepper.start())
    second = stepper.step_measured(0.0, np.concatenate([state, realised]), stepper.start())
    assert all(np.array_equal(one, other) for one, other in zip(first, second, strict=True))


def test_estimates_are_refused_where_raw_measurements_are_expected():
    estimating = next(k for k, e in enumerate(ESTIMATORS) if e == fp.PositionDifference())
    stepper, run = case(estimating, "computed torque")
    assert stepper.measures == ("a", "b")
    with pytest.raises(InvalidShape, match=r"from a, b: use step_measured\(time, measured, memory\)"):
        stepper.step(0.0, run["state"][0], run["realised"][0], stepper.start())
    with pytest.raises(InvalidShape, match="'measured' has 2 entries"):
        stepper.step_measured(0.0, np.zeros(3), stepper.start())


def test_a_range_of_what_nobody_measures_is_refused():
    with pytest.raises(InvalidProblem, match=r"measured quantity \"?'?a'.*Did you mean 'a'"):
        fp.Stepper(problem(fp.PositionDifference()), CONTROLLERS["plan"], plausible={"a'": (-1.0, 1.0)})


@by_name
def test_another_reality_begins_with_its_own_estimates(name):
    """A simulator that is given other exact parameters starts its estimator where a simulator built for them does.

    The position is measured through a slow sensor, which at the start rests at gain times position; the gain is varied.
    """
    task, controller = sensed_slowly(gain=1.0), CONTROLLERS[name]
    other = sensed_slowly(gain=1.3)
    shared = simulator(task, controller, compiled=False).run(seed=0, variant=other)
    own = fp.simulate(other, controller, seed=0, compiled=False)
    assert np.array_equal(shared["state"], own["state"])
    assert np.array_equal(shared["command"], own["command"])
    assert abs(shared["state.y"][0] - 1.3 * 0.1) < 1e-12


def sensed_slowly(gain: float) -> fp.Problem:
    """Y'' = u / m, whose position is seen through s' = (g y - s) / 20 ms; the sensor rests at the start."""
    mass = {"m": fp.Parameter(1.0, 1.0, "kg")}
    plant = fp.Plant({"y": "m"}, {"u": "N"}, mass, lambda q, v, u, p: {"y": u.u / p.m})
    real = fp.Plant(
        coordinates={"y": "m", "s": "m"},
        inputs={"u": "N"},
        order={"y": 2, "s": 1},
        parameters={**mass, "g": fp.Parameter(1.0, gain, "1")},
        response=lambda q, v, u, p: {"y": u.u / p.m, "s": (p.g * q.y - q.s) / 0.02},
        controlled=("y",),
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"y": 0.1 + 0.05 * ca.sin(t)}),
        start={"y": 0.1},
        period=5e-3,
        duration=0.1,
        limits=fp.Limits(inputs={"u": (-50.0, 50.0)}),
        horizon=fp.Horizon(stages=5, step=0.01),
        cost=fp.Quadratic(states={"y": 1e2}, deviation={"u": 0.1}),
        sensing=fp.Sensing(estimator=fp.PositionDifference()),
        reality=fp.Reality(real, seen={"y": "s"}),
    )
