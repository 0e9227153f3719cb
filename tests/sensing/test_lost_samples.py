"""One gate, one behaviour: a run with lost samples, or samples out of range, is its replay through a Stepper, bit by bit."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc import Status
from fpirhc.errors import InvalidProblem, InvalidValue

TASK = fp.load_problem("two_mass")
# Of sin(c t) CasADi makes one product of c, the period and the number of the cycle, which rounds otherwise than the time of a step.
WAVES = fp.Trajectory(lambda t: {"q1": 1 + 0.2 * ca.sin(t), "q2": 0.3 * ca.cos(t)})
PROBLEM = replace(TASK.problem, duration=1.0, measure_from=0.0, reference=WAVES)
ADAPTIVE = TASK.controllers["CTC+FPI (eq 6)"]
LOSES = fp.Sensor(dropout=0.3)
NOISY = fp.Sensor(noise=fp.Noise(1e-6), dropout=0.2)
SENSING = {
    "measured": fp.Sensing({"q1": LOSES}),
    "noise": fp.Sensing({"q1'": NOISY, "q2": NOISY}),
    "differences": fp.Sensing({"q1": LOSES}, fp.PositionDifference()),
    "fitted": fp.Sensing({"q2": LOSES}, fp.SavitzkyGolay(7, 3)),
    "late": fp.Sensing({"q1": LOSES}, fp.PositionDifference()),
}


def problem_of(kind: str) -> fp.Problem:
    late = {"dead_time": fp.DeadTime(measurement=2 * PROBLEM.period)} if kind == "late" else {}
    return replace(PROBLEM, sensing=SENSING[kind], **late)


def replayed(problem: fp.Problem, controller, run: fp.Run, lost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Commands and statuses of a Stepper that is given the samples of a run, NaN where one is lost."""
    stepper = fp.Stepper(problem, controller, compiled=False)
    names = (
        ("state", "realised")
        if not stepper.estimates
        else ("arrived" if "arrived" in run.layout.names else "measured",)
    )
    memory, commands, statuses = stepper.start(), [], []
    for k in range(run.cycles):
        sample = [np.where(lost[k], np.nan, run[name][k]) for name in names]
        step = stepper.step_measured if stepper.estimates else stepper.step
        command, memory = step(run["time"][k].item(), *sample, memory)
        commands.append(command)
        statuses.append(stepper.trace()["status"])
    return np.array(commands), np.array(statuses)


@pytest.mark.filterwarnings("ignore::fpirhc.HarmfulAdaptation")
@pytest.mark.parametrize("kind", SENSING)
def test_a_run_with_lost_samples_is_its_replay_through_a_stepper(kind):
    problem = problem_of(kind)
    run = fp.simulate(problem, ADAPTIVE, seed=3, compiled=False)
    lost = run["lost_sample"].ravel() > 0
    commands, statuses = replayed(problem, ADAPTIVE, run, lost)
    assert run.stop is None
    assert np.array_equal(commands, run["command"])
    assert np.array_equal(statuses.ravel(), run["status"].ravel())
    assert (run["status"].ravel()[lost] == Status.BAD_SAMPLE).all()
    assert 0.1 < lost.mean() < 0.5


def test_lost_samples_cost_what_they_cost_a_machine():
    """Half of the samples lost: who believes the last value for a new one is metres away (6.6 m), and this controller is not."""
    sensing = fp.Sensing({"q1": LOSES, "q2": LOSES}, fp.PositionDifference())
    run = fp.simulate(replace(TASK.problem, duration=4.0, sensing=sensing), ADAPTIVE, seed=0)
    assert run.stop is None
    assert np.abs(run["true_error"][2000:]).max() < 0.01


def test_a_plan_is_held_over_lost_samples_as_on_a_machine():
    problem = replace(problem_of("measured"), duration=0.3)
    controller = TASK.controllers["RHC+FPI"]
    run = fp.simulate(problem, controller, seed=3, compiled=False)
    commands, _ = replayed(problem, controller, run, run["lost_sample"].ravel() > 0)
    assert np.array_equal(commands, run["command"])


@pytest.mark.parametrize("estimator", [fp.Measured(), fp.PositionDifference()])
def test_a_sample_out_of_range_is_skipped_for_as_long_as_it_is_outside(estimator):
    """A sensor at its rail for 200 cycles: the command is held, every cycle says so, and afterwards it goes on."""
    problem = replace(PROBLEM, sensing=fp.Sensing({"q1": fp.Sensor(range=(-2.0, 5.0))}, estimator))
    run = fp.simulate(problem, ADAPTIVE, seed=0, compiled=False)
    assert np.array_equal(
        run.log, fp.simulate(replace(PROBLEM, sensing=fp.Sensing({}, estimator)), ADAPTIVE, seed=0, compiled=False).log
    )
    stepper = fp.Stepper(problem, ADAPTIVE, compiled=False)
    memory, commands, statuses = stepper.start(), [], []
    for k in range(run.cycles):
        names = ("measured",) if stepper.estimates else ("state", "realised")
        sample = [run[name][k].copy() for name in names]
        if 300 <= k < 500:
            sample[0][0] = 5.1  # finite, and no position that the sensor can show
        command, memory = (stepper.step_measured if stepper.estimates else stepper.step)(
            run["time"][k].item(), *sample, memory
        )
        commands.append(command)
        statuses.append(int(stepper.trace()["status"].item()))
    assert np.ptp(commands[299:500], axis=0).max() == 0.0
    assert statuses[300:500] == [Status.BAD_SAMPLE] * 200
    assert statuses[500] != Status.BAD_SAMPLE
    assert stepper.skipped == 200


def test_a_range_and_its_quantity_are_checked_at_the_door():
    with pytest.raises(InvalidValue, match="lower < upper"):
        fp.Sensor(range=(1.0, 0.0))
    with pytest.raises(InvalidProblem, match="Did you mean 'q1'"):
        replace(PROBLEM, sensing=fp.Sensing({"q11": fp.Sensor(range=(0.0, 1.0))}))
