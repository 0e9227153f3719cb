"""Lost samples: estimators, queues and observers go on, and are moved over the gap; missed cycles are gaps too."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, cast

import casadi as ca
import numpy as np
import pytest
from helpers.lossy import Lossy

import fpirhc as fp
from fpirhc import Status, Uncertain
from fpirhc.conformance.loops import two_masses
from fpirhc.contracts import Block, Controller, DerivativeEstimator, Signal, StateObserver
from fpirhc.members import examples
from fpirhc.simulation.clock import missed_cycles
from fpirhc.symbolic.block import LONG, bridged, shares
from fpirhc.symbolic.expression import FINITE
from fpirhc.symbolic.layout import Expression
from fpirhc.symbolic.native import find_compiler

ESTIMATORS: tuple[DerivativeEstimator, ...] = examples("derivative estimators")
BELIEFS: tuple[StateObserver, ...] = examples("observers")
GAPS = (1, 5, 20, 50)
TRACK = fp.Exponential(rate=6.0)
GENTLE = fp.Affine(gain=-0.05)
by_estimator = pytest.mark.parametrize("number", range(len(ESTIMATORS)), ids=[str(e) for e in ESTIMATORS])
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")


class Alone:
    """An estimator's block as it is where samples may be lost, fed by hand."""

    def __init__(self, estimator: DerivativeEstimator, *, lost: bool) -> None:
        task = two_masses()
        self.plant, self.period, self.names = task.plant, task.period, estimator.measures(task.plant)
        motion = motion_at(0.0)
        start = np.array([motion[e] for e in self.plant.state.elements])
        block = estimator.block(self.plant, self.period, start, Signal("seen", self.names))
        self.block = bridged(block) if lost else block
        self.memory: dict[str, Any] = {s.name: s.start_vector() for s in self.block.memory.signals}

    def fed(self, cycle: int, gap: float = 0.0, degree: int = 2) -> np.ndarray:
        motion = motion_at(cycle * self.period, degree)
        sample = {"seen": np.array([motion[n] for n in self.names]), "gap": gap}
        results: Any = self.block.function(*(sample[r] for r in self.block.reads.names), *self.memory.values())
        state, response, *after = results
        self.memory = dict(zip(self.memory, after, strict=True))
        return np.concatenate([np.asarray(v.full()).ravel() for v in (state, response)])

    def waits(self, gap: float) -> None:
        block: Block | None = self.block.waits
        if block is not None:
            after = block.function(*({"gap": gap}[r] for r in block.reads.names), *self.memory.values())
            column: Any = after if isinstance(after, tuple) else (after,)
            self.memory = dict(zip(self.memory, column, strict=True))


def motion_at(t: float, degree: int = 2) -> dict[str, float]:
    """Positions a and b on polynomials of this degree, with derivatives."""
    known: dict[str, float] = {}
    for name, numbers in {"a": [0.4, -0.7, 3.0], "b": [-0.1, 1.1, -2.0]}.items():
        polynomial = np.polynomial.Polynomial(numbers[: degree + 1])
        known |= {name + "'" * k: float(polynomial.deriv(k)(t) if k else polynomial(t)) for k in range(3)}
    return known


# What is exact


@by_estimator
@pytest.mark.parametrize("gap", GAPS)
def test_a_gap_in_a_polynomial_changes_nothing(number, gap):
    """The motion of a plant whose input is held: its estimates after the gap are those without it, at once and later."""
    estimator = ESTIMATORS[number]
    whole, lossy = Alone(estimator, lost=False), Alone(estimator, lost=True)
    for k in range(40):
        np.testing.assert_array_equal(whole.fed(k), lossy.fed(k))  # without a gap bit by bit
    for k in range(40, 40 + gap):
        whole.fed(k)
        lossy.waits(k - 40)
    for k in range(40 + gap, 80 + gap):
        expected, result = whole.fed(k), lossy.fed(k, gap if k == 40 + gap else 0)
        np.testing.assert_allclose(result, expected, rtol=1e-6, atol=1e-6)


@by_estimator
def test_a_long_gap_holds_the_derivatives(number):
    """The sample after it is displaced: position and nothing else follows at once."""
    estimator = ESTIMATORS[number]
    lossy = Alone(estimator, lost=True)
    for k in range(400):
        before = lossy.fed(k, degree=1)
    for k in range(60):
        lossy.waits(k if k <= 50 else LONG)
    after = lossy.fed(4000, LONG, degree=1)
    speeds = [k for k, e in enumerate(lossy.plant.state.elements) if e.endswith("'")]
    np.testing.assert_allclose(after[speeds], before[speeds], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(after[4:], 0.0, atol=1e-4)
    assert np.all(np.abs(after[[0, 1]] - before[[0, 1]]) > 1)


def numbers(gap: float, count: int, degree: int) -> np.ndarray:
    return np.array([float(s) for s in shares(cast(Expression, ca.DM(gap)), count, degree)])


def test_shares_of_a_gap():
    """None without one; a straight line for the first order; all for a long gap; the motion of a held input for the second."""
    assert np.array_equal(numbers(0.0, 4, 2), np.zeros(4))
    np.testing.assert_allclose(numbers(3.0, 5, 1), np.array([0.75, 0.5, 0.25, 0.0, 0.0]))
    np.testing.assert_allclose(numbers(LONG, 5, 3), np.ones(5))
    past = np.arange(1.0, 6.0)
    np.testing.assert_allclose(numbers(4.0, 5, 2), (5 - past) * (6 - past) / 30)


# Closed loops


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
            fp.RecursiveLeastSquares({"m": Uncertain(0.5, 3.0, 0.5)}, noise={"a": 0.1, "b": 0.1}, time=1.0),
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
def loop(name: str) -> Lossy:
    return Lossy(*LOOPS[name])


@pytest.mark.parametrize("name", LOOPS)
def test_a_missed_cycle_is_a_lost_sample(name):
    """Commands and memory are the same, bit by bit, for short gaps and for long ones; statuses tell them."""
    own = loop(name)
    for gap in (1, 7, 55):
        lost, missing = own.run(80, lost := range(12, 12 + gap)), own.trace[-1]
        told = own.statuses()
        assert told[12 : 12 + gap] == [Status.BAD_SAMPLE] * gap
        assert Status.OK in told[:12]
        assert told[12 + gap] in ({Status.BRIDGED} if gap < 51 else {Status.BRIDGED, Status.SETTLING})
        missed = own.run(80, range(12, 12 + gap), "missed")
        assert np.array_equal(lost, missed)
        assert all(np.array_equal(own.trace[-1][n], missing[n]) for n in missing)


@pytest.mark.parametrize("name", [type(e).__name__ for e in ESTIMATORS])
@pytest.mark.parametrize("gap", GAPS)
def test_the_command_comes_as_near_as_with_interpolated_samples(name, gap):
    """At most twice as far from the run without faults as a controller that is given the missing samples afterwards."""
    own, cycles, lost = loop(name), 40 + gap + 60, range(40, 40 + gap)
    away = [np.abs(own.run(cycles, lost, how) - own.run(cycles)).max() for how in ("lost", "interpolated")]
    assert away[0] <= 2 * away[1]


STILL = replace(two_masses(), reference=fp.Trajectory(lambda t: {"a": 0.2 + 0 * t, "b": 0.1 + 0 * t}))


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize(("gain", "rise", "first"), [(0.02, 0.0, 3), (0.3, 0.0, 3), (1.4, 0.0, 3), (0.3, 2e-5, 150)])
def test_the_held_request_teaches_as_much_as_repeated_ones(gap, gain, rise, first):
    """A response that is off by a constant, or by a line, is learned over a gap as without one.

    The plant answers r - c, with c on a line once the error of the iteration has settled, or constant from the start on.
    """
    law = fp.Exponential(rate=6.0, integral=False)
    stepper = fp.Stepper(STILL, fp.ComputedTorque(law, fp.Affine(gain=-2 * gain)), compiled=False)
    shifts: list[list[np.ndarray]] = []
    for lost in (0, gap):
        memory, request, learned = stepper.start(), np.zeros(2), list[np.ndarray]()
        for k in range(first + gap + 5):
            realised = request - np.array([0.7, -1.1]) - rise * k
            row = np.full(2, np.nan) if first <= k < first + lost else realised
            _, memory = stepper.step(k * STILL.period, np.array(STILL.start_state), row, memory)
            if not np.isnan(row).any():
                request = stepper.trace()["deformed"]
            learned.append(request - stepper.trace()["desired"])
        shifts.append(learned[first + gap :])
    np.testing.assert_allclose(shifts[1], shifts[0], rtol=1e-7, atol=1e-9)
    assert np.abs(shifts[0][-1]).min() > 0.05


@pytest.mark.parametrize("gap", GAPS)
def test_the_integral_of_an_error_has_the_missing_cycles(gap):
    """An error on a line is integrated over a gap, and beyond the bridged length no further."""
    speed = np.array([0.02, -0.05])
    results = {}
    for what, lost, longest in (("clean", 0, 50), ("short", gap, 50), ("long", gap, 0)):
        stepper = fp.Stepper(STILL, fp.ComputedTorque(TRACK), compiled=False, bridged=longest)
        memory = stepper.start()
        for k in range(gap + 6):
            state = np.array(STILL.start_state)
            state[:2] += speed * k * STILL.period
            row = state * np.nan if 3 <= k < 3 + lost else state
            _, memory = stepper.step(k * STILL.period, row, np.zeros(2), memory)
        results[what] = stepper.trace()["integral"]
    mean = np.array([0.2, 0.1]) - STILL.start_state[:2] - speed * (3 + gap / 2) * STILL.period
    tolerance = gap**2 * STILL.period**2 * np.abs(speed)  # of a line that begins a cycle earlier
    assert np.all(np.abs(results["short"] - results["clean"]) <= tolerance)
    lacks = results["clean"] - results["long"]
    np.testing.assert_allclose(lacks, (gap - 1) * STILL.period * mean, rtol=0.03, atol=1e-4)


@pytest.mark.parametrize("number", range(len(BELIEFS)), ids=[f"{type(b).__name__}-{k}" for k, b in enumerate(BELIEFS)])
def test_observers_predict_over_a_gap(number):
    """With the right model and no noise the believed state after a gap is the plant's."""
    own = Lossy(believed(number), fp.ExactModel(fp.ComputedTorque(TRACK)), bounded=False)
    own.run(45, range(15, 30))
    error = [np.abs(row["state"] - x).max() for row, x in zip(own.trace, own.states, strict=True)]
    assert max(error[:15] + error[30:]) < 1e-9


def test_the_disturbance_filter_predicts_over_a_gap():
    """With the right model it finds no disturbance, also after a gap."""
    problem, controller = LOOPS["disturbance filter"]
    own = Lossy(problem, fp.ExactModel(controller))
    own.run(60, range(20, 40))
    assert max(np.abs(row["estimate"]).max() for row in own.trace[40:]) < 1e-6


def test_commands_on_their_way_are_those_that_were_held():
    """With the right model the state is predicted over the dead time, also after a gap."""
    problem, controller = LOOPS["predicted"]
    own = Lossy(problem, fp.ExactModel(controller))
    own.run(60, range(20, 30))
    ahead = np.array([row["state_ahead"] for row in own.trace])
    true = np.array(own.states)
    for k in [*range(5, 20), *range(30, 50)]:
        np.testing.assert_allclose(ahead[k], true[k + 4], atol=1e-7)


def test_the_deformation_is_held_while_estimates_settle():
    """After a gap that is too long, for the samples that a window needs; then the map goes on from there."""
    estimator = fp.SavitzkyGolay(window=11, degree=4)
    problem = replace(two_masses(), sensing=fp.Sensing(estimator=estimator))
    own = Lossy(problem, fp.ComputedTorque(TRACK, GENTLE), bridged=5)
    own.run(80, range(40, 50))
    learned = np.array([row["deformed"] - row["desired"] for row in own.trace])
    assert own.statuses()[50:61] == [Status.SETTLING] * 10 + [Status.OK]
    np.testing.assert_allclose(learned[50:60], np.broadcast_to(learned[39], (10, 2)), atol=1e-12)
    assert np.abs(learned[39]).max() > 0.01
    assert np.any(learned[60] != learned[39])


# Steps


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


@pytest.mark.parametrize("time", [0.0, 1e9, -3.0])
def test_cycles_between_two_times(time):
    """Whole ones; a time that cannot follow leaves no gap, and the first step has none before it."""
    for period in (1e-3, 0.25, 7.0):
        for cycles in (1, 2, 3, 50, 4000):
            assert missed_cycles(time + (cycles + 0.3) * period, time, period) == cycles - 1
    assert missed_cycles(time, time, 1.0) == missed_cycles(time - 5, time, 1.0) == 0
    assert missed_cycles(time, -FINITE, 1.0) == missed_cycles(np.nan, time, 1.0) == missed_cycles(1e18, time, 1.0) == 0


def test_a_repeated_time_is_no_missing_cycle():
    """The same cycle, given once more, is skipped and leaves no gap."""
    own = loop("PositionDifference")
    stepper, problem = own.stepper, own.problem
    memory = stepper.start()
    for k in range(10):
        _, memory = stepper.step_measured(k * problem.period, np.array([0.4 + 0.01 * k, -0.1]), memory)
    _, twice = stepper.step_measured(9 * problem.period, np.array([0.7, -0.1]), memory)
    assert Status(int(stepper.trace()["status"][0])) == Status.BAD_TIME
    sample = 10 * problem.period, np.array([0.5, -0.1])
    assert np.array_equal(stepper.step_measured(*sample, twice)[0], stepper.step_measured(*sample, memory)[0])
    assert Status(int(stepper.trace()["status"][0])) == Status.OK


def test_nothing_is_bridged_before_the_first_sample():
    own = loop("SavitzkyGolay")
    fresh = own.run(30)
    late = own.stepper.start()
    for k in range(5):
        _, late = own.stepper.step_measured((k - 5) * own.problem.period, np.full(2, np.nan), late)
    command, _ = own.stepper.step_measured(0.0, np.array([0.4, -0.1]), late)
    assert np.array_equal(command, fresh[0])
    assert Status(int(own.stepper.trace()["status"][0])) == Status.OK
