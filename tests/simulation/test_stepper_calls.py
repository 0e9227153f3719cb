"""What a call of a stepper takes and gives, on a small loop: nothing in it is shared, lost or left locked."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.replay import status

import fpirhc as fp
from fpirhc import Status
from fpirhc.controllers.contract import named_in_task
from fpirhc.errors import InvalidShape
from fpirhc.symbolic.native import find_compiler

PLANT = fp.Plant(
    coordinates={"y": "m"},
    inputs={"u": "N"},
    parameters={"m": fp.Parameter(1.2, 1.0, "kg")},
    response=lambda q, v, u, p: {"y": u.u / p.m - 2.0 * q.y},
)
PROBLEM = fp.Problem(
    plant=PLANT,
    reference=fp.Trajectory(lambda t: {"y": 0.2 + 0 * t}),
    start={"y": 0.1},
    period=0.01,
    duration=0.2,
    limits=fp.Limits(inputs={"u": (-20.0, 20.0)}),
)
CONTROLLER = fp.ComputedTorque(fp.Exponential(rate=4.0), fp.Affine(gain=-0.6))
SAMPLE = 0.0, np.array([0.1, 0.3]), np.array([0.7])


def stepper(problem=PROBLEM, controller=CONTROLLER, **settings) -> fp.Stepper:
    """In the virtual machine."""
    return fp.Stepper(problem, controller, compiled=False, **settings)


@cache
def plain() -> fp.Stepper:
    """One for tests that leave it as it is."""
    return stepper()


def test_it_says_what_it_is():
    one = plain()
    assert one.compiled is False
    assert repr(one) == "Stepper(problem, ComputedTorque, virtual machine)"
    assert one.why_failed == one.why_refused == ""
    assert one.refused == 0
    assert one.deadline is None
    assert "command" in one.signals
    assert repr(stepper(controller=named_in_task(CONTROLLER, "mine"))).startswith("Stepper(problem, mine, ")
    assert fp.Stepper(PROBLEM, CONTROLLER).compiled == (find_compiler() is not None)


def test_results_are_nobody_elses():
    """Neither the next call nor a change of the results changes what was given before."""
    one = plain()
    command, memory = one.step(*SAMPLE, one.start())
    kept = command.copy(), memory.copy()
    shown = one.trace()
    shown["command"][:] = 99.0
    assert one.trace()["command"] == pytest.approx(kept[0])
    one.step(0.01, np.array([0.5, -1.0]), np.array([3.0]), memory)
    np.testing.assert_array_equal(command, kept[0])
    np.testing.assert_array_equal(memory, kept[1])
    memory[:] = 5.0
    np.testing.assert_array_equal(one.step(*SAMPLE, one.start())[0], kept[0])


def test_the_command_is_that_of_the_law():
    """The law is q'' = w^2 e - 2 w q', the command u = m (q'' + 2 q), clipped at its limits."""
    law = fp.Exponential(rate=4.0, integral=False)
    one = stepper(controller=fp.ComputedTorque(law))
    command, memory = one.step(*SAMPLE, one.start())
    wanted = 16.0 * (0.2 - 0.1) - 8.0 * 0.3
    assert command == pytest.approx([1.2 * (wanted + 2.0 * 0.1)])
    far, _ = one.step(0.01, np.array([1.6, 0.3]), SAMPLE[2], memory)
    assert far == pytest.approx([-20.0])


def test_a_solver_that_fails_holds_the_command():
    """One that raises, and one that ends without having written a command."""
    one = stepper()
    command, memory = one.step(*SAMPLE, one.start())
    evaluate, one._may_fail, one._evaluate = one._evaluate, True, lambda: None
    np.testing.assert_array_equal(one.step(0.01, *SAMPLE[1:], memory)[0], command)
    assert (status(one), one.why_failed) == (Status.SOLVER_FAILED, "the compiled solver failed")
    one._may_fail, one._evaluate = False, evaluate

    def raising():
        raise RuntimeError("no convergence")

    one._evaluate = raising
    held, after = one.step(0.01, *SAMPLE[1:], memory)
    np.testing.assert_array_equal(held, command)
    assert status(one) == Status.SOLVER_FAILED
    assert one.why_failed == "no convergence"
    np.testing.assert_array_equal(after, memory)
    one._may_fail, one._evaluate = True, lambda: None
    held, _ = one.step(0.02, *SAMPLE[1:], after)
    np.testing.assert_array_equal(held, command)
    assert one.why_failed == "the compiled solver failed"
    assert one.trace()["skipped"] == 2


def test_raw_measurements_are_given_in_their_order():
    """States and then responses where nothing is estimated; with estimators what the sensors show."""
    one = plain()
    assert one.measures == ("y", "y'", "y''")
    assert not one.estimates
    expected = one.step(*SAMPLE, one.start())[0]
    np.testing.assert_array_equal(one.step_measured(0.0, np.array([0.1, 0.3, 0.7]), one.start())[0], expected)
    with pytest.raises(InvalidShape):
        one.step_measured(0.0, np.array([0.1, 0.3]), one.start())
    estimating = stepper(replace(PROBLEM, sensing=fp.Sensing({}, fp.PositionDifference())))
    assert estimating.measures == ("y",)
    assert estimating.estimates
    memory = estimating.start()
    for k in range(3):
        _, memory = estimating.step_measured(0.01 * k, np.array([0.1 + 0.02 * k]), memory)
    assert estimating.trace()["state"] == pytest.approx([0.14, 2.0])


def test_settings_and_set_points_of_a_call():
    """They hold from that step on; what is refused is counted and named, and the old ones stay."""
    one = stepper(live=["deformation.gain"])
    assert one.numbers == {"deformation.gain": -0.6}
    memory = one.step(*SAMPLE, one.start())[1]
    again = 0.01, np.array([0.2, 0.1]), np.array([0.4])
    before = one.step(*again, memory)[0]
    changed = one.step(*again, memory, settings={"deformation.gain": -0.3})[0]
    assert changed != before
    assert one.numbers == {"deformation.gain": -0.3}
    assert one.step(*again, memory)[0] == changed
    one.step(*again, memory, settings={"deformation.gain": 0.0})
    assert (one.refused, one.numbers) == (1, {"deformation.gain": -0.3})
    assert one.why_refused
    assert one.change({"deformation.gain": -0.6})
    assert one.step(*again, memory)[0] == before
    assert one.outdated() is not None


def test_time_stamps_are_read_where_their_age_counts():
    """`taken` is the time where it is not given; an old sample is a bad one."""
    one = stepper(max_age=0.05)
    _, memory = one.step(*SAMPLE, one.start())
    one.step(0.1, *SAMPLE[1:], memory, taken=0.02)
    assert status(one) == Status.BAD_SAMPLE
    one.step(0.01, *SAMPLE[1:], memory, taken=0.005)
    assert status(one) == Status.OK
    one.step(0.01, *SAMPLE[1:], memory)
    assert status(one) == Status.OK


def test_steps_are_timed_where_there_is_a_deadline():
    """By the clock that is given: the second step of three is late, and the text says so."""
    times = iter([0.0, 1e-4, 1.0, 1.5, 2.0, 2.0001])
    one = stepper(deadline=1e-3, clock=lambda: next(times))
    for _ in range(3):
        one.step(*SAMPLE, one.start())
    assert one.deadline is not None
    assert (one.deadline.cycles, one.deadline.late, one.deadline.worst) == (3, 1, 0.5)
    assert str(one.deadline) in repr(one)


def test_live_settings_are_named_with_the_interval_that_a_device_may_accept():
    """Gains from that at which 1 - a J = -1, with J = 1.2, up to none; an attribute that is not there is named."""
    one = stepper(live=["deformation.gain"])
    assert one.settings.names == ("setting.deformation.gain",)
    assert (one.parameters.columns, one.parameters.start().tolist()) == (("parameters.m",), [1.2])
    assert one.bounds()["deformation.gain"] == pytest.approx((-2 * 2 / 1.2, 0.0), abs=1e-5)
    assert plain().settings.names == ()
    assert plain().setpoints == plain().numbers == {}
    with pytest.raises(AttributeError, match="Stepper has no attribute 'mesures'"):
        one.mesures  # type: ignore[attr-defined]  # noqa: B018


def test_arrays_are_taken_as_they_are_and_anything_else_is_looked_at(monkeypatch):
    """Of each of the three: a masked array, whose numbers are not all there, is an array to a view."""
    one, looked = stepper(), []
    given = (*SAMPLE, one.start())
    monkeypatch.setattr(one._arguments, "accept", lambda *arguments: looked.append(arguments))
    monkeypatch.setattr(one, "_take", lambda *arguments: looked.append(arguments))
    one.step(*given)
    assert not looked
    for place in (1, 2, 3):
        time, state, realised, memory = (np.ma.asarray(v) if k == place else v for k, v in enumerate(given))
        one.step(time, state, realised, memory)  # type: ignore[arg-type]
        assert len(looked) == place


@pytest.mark.parametrize("cycles", [2, 3, 6])
def test_a_missed_cycle_is_one_without_a_sample(cycles):
    """The commands and memories after it are those of a caller who came in time and had nothing to show."""
    one = stepper()
    _, memory = one.step(*SAMPLE, one.start())
    by_hand = memory
    for k in range(1, cycles):
        _, by_hand = one.step(0.01 * k, np.full(2, np.nan), SAMPLE[2], by_hand)
    for expected, given in zip(
        one.step(0.01 * cycles, *SAMPLE[1:], by_hand), one.step(0.01 * cycles, *SAMPLE[1:], memory), strict=True
    ):
        np.testing.assert_allclose(given, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("cycles", "stepped"), [(30, 29), (5000, 500)])
def test_missed_cycles_are_counted_where_they_are_too_many_to_be_stepped_over(cycles, stepped, monkeypatch):
    """Each once, however often it happens; the time of a step has a bound."""
    one, evaluated = stepper(), []
    evaluate = one._evaluate
    monkeypatch.setattr(one, "_evaluate", lambda: evaluated.append(evaluate()))
    _, memory = one.step(*SAMPLE, one.start())
    for turn in (1, 2):
        evaluated.clear()
        _, memory = one.step(0.01 * cycles * turn, *SAMPLE[1:], memory)
        assert one.skipped == one.trace()["skipped"] == turn * (cycles - 1)
        assert len(evaluated) == stepped + 1


def test_a_solver_that_fails_in_a_missed_cycle_fails_the_step():
    """The command is held, all cycles count, and the stepper is as it was for the next one."""
    one = stepper()
    command, memory = one.step(*SAMPLE, one.start())
    evaluate, one._evaluate = one._evaluate, lambda: None
    held, after = one.step(0.03, *SAMPLE[1:], memory)
    one._evaluate = evaluate
    np.testing.assert_array_equal(held, command)
    assert (status(one), one.why_failed) == (Status.SOLVER_FAILED, "the compiled solver failed")
    assert one.trace()["skipped"] == 3
    one.step(0.04, *SAMPLE[1:], after)
    assert one.trace()["skipped"] == 3
    assert status(one) == Status.BRIDGED


def test_what_is_no_failure_of_a_solver_is_raised():
    """An interruption inside compiled code comes as its cause, and the stepper stays usable."""
    one = stepper()
    evaluate = one._evaluate

    def interrupted():
        raise SystemError("in a callback") from KeyboardInterrupt()

    one._evaluate = interrupted
    with pytest.raises(KeyboardInterrupt):
        one.step(*SAMPLE, one.start())
    one._evaluate = evaluate
    one.step(*SAMPLE, one.start())
    assert status(one) == Status.OK
