"""One gate, one behaviour: a run with lost samples, or samples out of range, is its replay through a Stepper, bit by bit."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from helpers.lossy import Lossy
from helpers.machine import needs_compiler
from helpers.replay import replayed, samples, status

import fpirhc as fp
from fpirhc.conformance import examples, two_masses
from fpirhc.contracts import Controller

TASK = fp.load_problem("two_mass")
# Of sin(c t) CasADi makes one product of c, the period and the number of the cycle, which rounds otherwise than the time of a step.
WAVES = fp.Trajectory(lambda t: {"q1": 1 + 0.2 * ca.sin(t), "q2": 0.3 * ca.cos(t)})
PROBLEM = replace(TASK.problem, duration=0.5, measure_from=0.0, reference=WAVES)
ADAPTIVE = TASK.controllers["CTC+FPI (eq 6)"]
LOSES = fp.Sensor(dropout=0.3)
NOISY = fp.Sensor(noise=fp.Noise(1e-6), dropout=0.2)
SENSING = {
    "measured": fp.Sensing({"q1": LOSES}),
    "noise": fp.Sensing({"q1'": NOISY, "q2": NOISY}),
    "differences": fp.Sensing({"q1": LOSES}, fp.PositionDifference()),
    "fitted": fp.Sensing({"q2": LOSES}, fp.SavitzkyGolay(7, 3)),
    "late": fp.Sensing({"q1": LOSES}, fp.PositionDifference()),
    "plan": fp.Sensing({"q1": LOSES}),
}


@pytest.mark.filterwarnings("ignore::fpirhc.HarmfulAdaptation")
@pytest.mark.parametrize("kind", SENSING)
def test_a_run_with_lost_samples_is_its_replay_through_a_stepper(kind):
    late = {"dead_time": fp.DeadTime(measurement=2 * PROBLEM.period)} if kind == "late" else {}
    problem = replace(PROBLEM, sensing=SENSING[kind], **late)
    controller = TASK.controllers["RHC+FPI"] if kind == "plan" else ADAPTIVE
    run = fp.simulate(problem, controller, seed=3, compiled=False)
    lost = run["lost_sample"].ravel() > 0
    commands, statuses = replayed(fp.Stepper(problem, controller, compiled=False), run)
    assert run.stop is None
    assert np.array_equal(commands, run["command"])
    assert np.array_equal(statuses, run["status"].ravel())
    assert (statuses[lost] == fp.Status.BAD_SAMPLE).all()
    assert 0.1 < lost.mean() < 0.5


@pytest.mark.parametrize("estimator", [fp.Measured(), fp.PositionDifference()])
def test_a_sample_out_of_range_is_skipped_for_as_long_as_it_is_outside(estimator):
    """A sensor at its rail for 200 cycles: the command is held, every cycle says so, and afterwards it goes on."""
    bare = replace(PROBLEM, sensing=fp.Sensing({}, estimator))
    problem = replace(PROBLEM, sensing=fp.Sensing({"q1": fp.Sensor(range=(-2.0, 5.0))}, estimator))
    run = fp.simulate(problem, ADAPTIVE, seed=0, compiled=False)
    assert np.array_equal(run.log, fp.simulate(bare, ADAPTIVE, seed=0, compiled=False).log)
    stepper, rows = fp.Stepper(problem, ADAPTIVE, compiled=False), samples(run)
    rows[200:400, 0] = 5.1  # finite, and no position that the sensor can show
    commands, statuses = replayed(stepper, run, rows)
    assert np.ptp(commands[199:400], axis=0).max() == 0.0
    assert (np.flatnonzero(statuses == fp.Status.BAD_SAMPLE) == np.arange(200, 400)).all()
    assert stepper.skipped == 200


# Every part of a cycle that remembers earlier ones


TRACK, GENTLE = fp.Exponential(rate=6.0), fp.Affine(gain=-0.05)
ESTIMATORS, BELIEFS = examples("derivative estimators"), examples("observers")


def seen(**sensing) -> fp.Problem:
    return replace(two_masses(), sensing=fp.Sensing(**sensing))


def late(seconds: float) -> fp.Problem:
    return replace(two_masses(), dead_time=fp.DeadTime(inputs={"Fa": seconds, "Fb": seconds}))


LOOPS: dict[str, tuple[fp.Problem, Controller]] = {
    "paired": (late(0.015), fp.ComputedTorque(fp.Exponential(rate=4.0), fp.Paired(GENTLE, cycles=3))),
    "predicted": (late(0.02), fp.Predicted(fp.ComputedTorque(TRACK), inputs=0.02)),
    "fractional": (two_masses(), fp.ComputedTorque(fp.Fractional(rate=4.0, order=0.8, memory=0.5), GENTLE)),
    "referenced": (seen(estimator=fp.PositionDifference()), fp.ComputedTorque(TRACK, fp.ModelReferenced(GENTLE))),
    "disturbance filter": (
        two_masses(),
        fp.Estimating(
            fp.ComputedTorque(TRACK),
            fp.DisturbanceKalman({"a": 1.0, "b": 1.0}, dict.fromkeys(("a", "b", "a'", "b'"), 1e-3)),
        ),
    ),
    "least squares": (
        seen(estimator=fp.SavitzkyGolay(window=5, degree=2)),
        fp.Estimating(
            fp.ComputedTorque(TRACK),
            fp.RecursiveLeastSquares({"m": fp.Uncertain(0.5, 3.0, 0.5)}, noise={"a": 0.1, "b": 0.1}, time=1.0),
        ),
    ),
    "cascade": (
        seen(estimator=fp.PositionDifference()),
        fp.Cascade(fp.ComputedTorque(TRACK), GENTLE, lag=0.01),
    ),
    **{f"{type(b).__name__}-{k}": (seen(estimator=fp.Measured(), measured=["a", "b"], observer=b), fp.ComputedTorque(TRACK))
       for k, b in enumerate(BELIEFS)},
    **{type(e).__name__: (seen(estimator=e), fp.ComputedTorque(TRACK, GENTLE)) for e in ESTIMATORS},
}  # fmt: skip


@cache
def loop(name: str, bridged: int = 5) -> Lossy:
    return Lossy(*LOOPS[name], bounded=False, bridged=bridged)


@pytest.mark.parametrize("name", LOOPS)
def test_a_missed_cycle_is_a_lost_sample(name):
    """Commands and signals are the same, bit by bit, for short gaps and for long ones; every cycle is counted once, and told."""
    own = loop(name)
    for gap in (1, 5, 7, 55):
        lost, missing = own.run(80, range(12, 12 + gap)), own.trace[-1]
        told = own.statuses()
        assert told[12 : 12 + gap] == [fp.Status.BAD_SAMPLE] * gap
        assert told[12 + gap : 14 + gap] == [fp.Status.BRIDGED if gap <= 5 else fp.Status.SETTLING, fp.Status.OK]
        assert own.stepper.skipped == gap
        missed = own.run(80, range(12, 12 + gap), "missed")
        assert own.stepper.skipped == gap
        assert np.array_equal(lost, missed)
        assert all(np.array_equal(own.trace[-1][n], missing[n]) for n in missing)


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("gap", [5, 50])
def test_the_command_comes_as_near_as_with_interpolated_samples(name, gap):
    """At most twice as far from the run without faults as a controller that is given the missing samples afterwards."""
    own, cycles, lost = loop(name, max(gap, 5)), 40 + gap + 60, range(40, 40 + gap)
    away = [np.abs(own.run(cycles, lost, how) - own.run(cycles)).max() for how in ("lost", "interpolated")]
    assert away[0] <= 2 * away[1] + 1e-9


def motion_at(t: float, names: tuple[str, ...]) -> np.ndarray:
    """Positions a and b on polynomials of degree 2, with derivatives."""
    known: dict[str, float] = {}
    for name, numbers in {"a": [0.4, -0.7, 3.0], "b": [-0.1, 1.1, -2.0]}.items():
        polynomial = np.polynomial.Polynomial(numbers)
        known |= {name + "'" * k: float(polynomial.deriv(k)(t) if k else polynomial(t)) for k in range(3)}
    return np.array([known[n] for n in names])


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=str)
@pytest.mark.parametrize("gap", [1, 5, 40])
def test_a_gap_in_a_polynomial_changes_nothing(estimator, gap):
    """The motion of a plant whose input is held: its estimates after a gap are those without it."""
    problem = seen(estimator=estimator)
    stepper = fp.Stepper(problem, fp.ComputedTorque(TRACK), compiled=False)
    every, lossy = stepper.start(), stepper.start()
    for k in range(120 + gap):
        time = k * problem.period
        _, every = stepper.step_measured(time, motion_at(time, stepper.measures), every)
        expected = stepper.trace()
        if 60 <= k < 60 + gap:
            continue
        _, lossy = stepper.step_measured(time, motion_at(time, stepper.measures), lossy)
        names = {"state", "realised"} | ({"desired"} if gap <= 5 else set())  # an integral waits in a long gap
        for name in names & expected.keys() if k >= 60 else ():
            np.testing.assert_allclose(stepper.trace()[name], expected[name], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("name", [n for n in LOOPS if n.startswith(("KalmanFilter", "predicted"))])
def test_a_right_model_predicts_over_a_gap(name):
    """Without noise the believed state is the plant's, and the state ahead is the one that comes."""
    problem, controller = LOOPS[name]
    own = Lossy(problem, fp.ExactModel(controller), bounded=False)
    own.run(60, range(20, 25))
    signal, late = ("state_ahead", 4) if name == "predicted" else ("state", 0)
    error = [np.abs(own.trace[k][signal] - own.states[k + late]).max() for k in [*range(5, 20), *range(25, 50)]]
    assert max(error[:15]) < 1e-7
    assert max(error[15:]) < (1e-7 if late else 1e-3)


@needs_compiler
@pytest.mark.parametrize("name", ["SavitzkyGolay", "paired", "disturbance filter"])
def test_compiled_steps_go_over_gaps_alike(name):
    """C and the virtual machine agree after short gaps and long ones."""
    compiled, lost = Lossy(*LOOPS[name], compiled=True), {10, 11, 12, *range(20, 75)}
    one, other = compiled.run(100, lost), loop(name).run(100, lost)
    assert compiled.stepper.compiled
    assert compiled.statuses() == loop(name).statuses()
    np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-7 * np.abs(other).max())


def test_a_repeated_time_is_no_missing_cycle():
    """The same cycle, given once more, is skipped and leaves no gap."""
    own = loop("PositionDifference")
    stepper, period = own.stepper, own.problem.period
    memory = stepper.start()
    for k in range(10):
        _, memory = stepper.step_measured(k * period, np.array([0.4 + 0.01 * k, -0.1]), memory)
    _, twice = stepper.step_measured(9 * period, np.array([0.7, -0.1]), memory)
    assert status(stepper) == fp.Status.BAD_TIME
    sample = 10 * period, np.array([0.5, -0.1])
    assert np.array_equal(stepper.step_measured(*sample, twice)[0], stepper.step_measured(*sample, memory)[0])
    assert status(stepper) == fp.Status.OK
