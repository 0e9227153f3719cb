"""Missing cycles are run afterwards: as good as if the samples between had come, the same in every backend, and bounded in time."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.lossy import Lossy

import fpirhc as fp
from fpirhc.conformance import examples, two_masses
from fpirhc.contracts import Controller, DerivativeEstimator, StateObserver

ESTIMATORS: tuple[DerivativeEstimator, ...] = examples("derivative estimators")
BELIEFS: tuple[StateObserver, ...] = examples("observers")
TRACK = fp.Exponential(rate=6.0)
GENTLE = fp.Affine(gain=-0.05)
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="this machine has no C compiler")


def motion_at(t: float, degree: int = 2) -> dict[str, float]:
    """Positions a and b on polynomials of this degree, with derivatives."""
    known: dict[str, float] = {}
    for name, numbers in {"a": [0.4, -0.7, 3.0], "b": [-0.1, 1.1, -2.0]}.items():
        polynomial = np.polynomial.Polynomial(numbers[: degree + 1])
        known |= {name + "'" * k: float(polynomial.deriv(k)(t) if k else polynomial(t)) for k in range(3)}
    return known


def estimated(number: int) -> fp.Problem:
    return replace(two_masses(), sensing=fp.Sensing(estimator=ESTIMATORS[number]))


LOOPS: dict[str, tuple[fp.Problem, Controller]] = {
    "paired": (
        replace(two_masses(), dead_time=fp.DeadTime(inputs={"Fa": 0.015, "Fb": 0.015})),
        fp.ComputedTorque(fp.Exponential(rate=4.0), fp.Paired(GENTLE, cycles=3)),
    ),
    "predicted": (
        replace(two_masses(), dead_time=fp.DeadTime(inputs={"Fa": 0.02, "Fb": 0.02})),
        fp.Predicted(fp.ComputedTorque(TRACK), inputs=0.02),
    ),
    "fractional": (two_masses(), fp.ComputedTorque(fp.Fractional(rate=4.0, order=0.8, memory=0.5), GENTLE)),
    "referenced": (
        replace(two_masses(), sensing=fp.Sensing(estimator=fp.PositionDifference())),
        fp.ComputedTorque(TRACK, fp.ModelReferenced(GENTLE)),
    ),
    "disturbance filter": (
        two_masses(),
        fp.Estimating(
            fp.ComputedTorque(TRACK),
            fp.DisturbanceKalman({"a": 1.0, "b": 1.0}, dict.fromkeys(("a", "b", "a'", "b'"), 1e-3)),
        ),
    ),
    "least squares": (
        replace(two_masses(), sensing=fp.Sensing(estimator=fp.SavitzkyGolay(window=5, degree=2))),
        fp.Estimating(
            fp.ComputedTorque(TRACK),
            fp.RecursiveLeastSquares({"m": fp.Uncertain(0.5, 3.0, 0.5)}, noise={"a": 0.1, "b": 0.1}, time=1.0),
        ),
    ),
    "cascade": (
        replace(two_masses(), sensing=fp.Sensing(estimator=fp.PositionDifference())),
        fp.Cascade(fp.ComputedTorque(TRACK), GENTLE, fp.ThroughModel(lag=0.01)),
    ),
    **{f"{type(e).__name__}": (estimated(k), fp.ComputedTorque(TRACK, GENTLE)) for k, e in enumerate(ESTIMATORS)},
}


def believed(number: int) -> fp.Problem:
    sensing = fp.Sensing(estimator=fp.Measured(), measured=["a", "b"], observer=BELIEFS[number])
    return replace(two_masses(), sensing=sensing)


@cache
def loop(name: str, bridged: int = 5) -> Lossy:
    return Lossy(*LOOPS[name], bridged=bridged)


@pytest.mark.parametrize("number", range(len(ESTIMATORS)), ids=[str(e) for e in ESTIMATORS])
@pytest.mark.parametrize("gap", [1, 5, 40])
def test_a_gap_in_a_polynomial_changes_nothing(number, gap):
    """The motion of a plant whose input is held: its estimates after a gap are those without it."""
    problem = estimated(number)
    stepper = fp.Stepper(problem, fp.ComputedTorque(TRACK), compiled=False)
    every, lossy = stepper.start(), stepper.start()
    for k in range(120 + gap):
        motion = motion_at(k * problem.period)
        sample = np.array([motion[n] for n in stepper.measures])
        _, every = stepper.step_measured(k * problem.period, sample, every)
        expected = stepper.trace()
        if 60 <= k < 60 + gap:
            continue
        _, lossy = stepper.step_measured(k * problem.period, sample, lossy)
        if k >= 60:
            names = {"state", "realised"} | ({"desired"} if gap <= 5 else set())  # an integral waits in a long gap
            for name in names & expected.keys():
                np.testing.assert_allclose(stepper.trace()[name], expected[name], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("name", LOOPS)
def test_a_missed_cycle_is_a_lost_sample(name):
    """Commands and memory are the same, bit by bit, for short gaps and for long ones; statuses tell them."""
    own = loop(name)
    for gap in (1, 5, 7, 55):
        lost, missing = own.run(80, range(12, 12 + gap)), own.trace[-1]
        told = own.statuses()
        assert told[12 : 12 + gap] == [fp.Status.BAD_SAMPLE] * gap
        assert told[12 + gap] == (fp.Status.BRIDGED if gap <= 5 else fp.Status.SETTLING)
        assert told[13 + gap] == fp.Status.OK
        missed = own.run(80, range(12, 12 + gap), "missed")
        assert np.array_equal(lost, missed)
        assert all(np.array_equal(own.trace[-1][n], missing[n]) for n in missing)


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("gap", [1, 5, 20, 50])
def test_the_command_comes_as_near_as_with_interpolated_samples(name, gap):
    """At most 1.5 times as far from the run without faults as a controller that is given the missing samples afterwards."""
    own, cycles, lost = loop(name, max(gap, 5)), 40 + gap + 60, range(40, 40 + gap)
    away = [np.abs(own.run(cycles, lost, how) - own.run(cycles)).max() for how in ("lost", "interpolated")]
    assert away[0] <= 1.5 * away[1]


@pytest.mark.parametrize("number", range(len(BELIEFS)), ids=[f"{type(b).__name__}-{k}" for k, b in enumerate(BELIEFS)])
def test_observers_go_over_a_gap(number):
    """With the right model and no noise the believed state after a gap is the plant's."""
    own = Lossy(believed(number), fp.ExactModel(fp.ComputedTorque(TRACK)), bounded=False)
    own.run(45, range(15, 20))
    error = [np.abs(row["state"] - x).max() for row, x in zip(own.trace, own.states, strict=True)]
    assert max(error[:15]) < 1e-9
    assert max(error[20:]) < 1e-3


def test_commands_on_their_way_are_those_that_were_held():
    """With the right model the state is predicted over the dead time, also after a gap."""
    problem, controller = LOOPS["predicted"]
    own = Lossy(problem, fp.ExactModel(controller))
    own.run(60, range(20, 25))
    ahead = np.array([row["state_ahead"] for row in own.trace])
    true = np.array(own.states)
    for k in [*range(5, 20), *range(25, 50)]:
        np.testing.assert_allclose(ahead[k], true[k + 4], atol=1e-7)


@needs_compiler
@pytest.mark.parametrize("name", ["SavitzkyGolay", "paired", "disturbance filter"])
def test_compiled_steps_go_over_gaps_alike(name):
    """C and the virtual machine agree after short gaps and long ones."""
    problem, controller = LOOPS[name]
    compiled, lost = Lossy(problem, controller, compiled=True), {10, 11, 12, *range(20, 75)}
    one, other = compiled.run(100, lost), loop(name).run(100, lost)
    assert compiled.stepper.compiled
    assert compiled.statuses() == loop(name).statuses()
    np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-7 * np.abs(other).max())


def test_a_repeated_time_is_no_missing_cycle():
    """The same cycle, given once more, is skipped and leaves no gap."""
    own = loop("PositionDifference")
    stepper, problem = own.stepper, own.problem
    memory = stepper.start()
    for k in range(10):
        _, memory = stepper.step_measured(k * problem.period, np.array([0.4 + 0.01 * k, -0.1]), memory)
    _, twice = stepper.step_measured(9 * problem.period, np.array([0.7, -0.1]), memory)
    assert fp.Status(int(stepper.trace()["status"][0])) == fp.Status.BAD_TIME
    sample = 10 * problem.period, np.array([0.5, -0.1])
    assert np.array_equal(stepper.step_measured(*sample, twice)[0], stepper.step_measured(*sample, memory)[0])
    assert fp.Status(int(stepper.trace()["status"][0])) == fp.Status.OK


def test_nothing_is_bridged_before_the_first_sample():
    own = loop("SavitzkyGolay")
    fresh = own.run(30)
    late = own.stepper.start()
    for k in range(5):
        _, late = own.stepper.step_measured((k - 5) * own.problem.period, np.full(2, np.nan), late)
    command, _ = own.stepper.step_measured(0.0, np.array([0.4, -0.1]), late)
    assert np.array_equal(command, fresh[0])
    assert fp.Status(int(own.stepper.trace()["status"][0])) == fp.Status.OK
