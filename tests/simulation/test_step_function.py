"""The step as a CasADi Function: what a user's own loop and code generation from it do is what the stepper does, bit by bit."""

from functools import cache

import numpy as np
import pytest

import fpirhc as fp

CASES = {
    "CTC+FPI": ("two_mass", "CTC+FPI (eq 6)", ["deformation.gain", "limits.inputs.Q1.0", "limits.inputs.Q1.1"]),
    "RHC+FPI": ("two_mass", "RHC+FPI", ["deformation.gain", "cost.states.q1"]),
    "outputs": ("anaesthesia", "CTC+FPI", []),
    "map": ("fishery", "RHC+FPI", []),
}
CYCLES = 40


@cache
def case(name: str) -> tuple[fp.Stepper, np.ndarray]:
    """A stepper, and rows of what it reads: a run's samples, with faults in some of them."""
    of, controller, live = CASES[name]
    task = fp.load_problem(of)
    stepper = fp.Stepper(task.problem, task.controllers[controller], live=live, compiled=False, bridged=0)
    run = fp.simulate(task.problem, task.controllers[controller], seed=0, compiled=False)
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


def same(one: np.ndarray, other: np.ndarray) -> bool:
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
        assert same(command, expected), k
        assert same(own, memory), k
        # A status that tells of a gap is given by who calls the step.
        shown = {name: value for name, value in stepper.trace().items() if name != "status" or k < 10}
        places = dict(zip(stepper.trace(), np.cumsum([v.size for v in stepper.trace().values()]), strict=True))
        assert all(same(trace[places[n] - v.size : places[n]], v) for n, v in shown.items()), k


def _of(name: str):
    task = fp.load_problem(CASES[name][0])
    return task.problem, task.controllers[CASES[name][1]]


def test_bounds_are_where_the_check_begins_to_refuse():
    """Every number inside is accepted, and one a little beyond an end is refused; limits of inputs end at those of the build."""
    live = ["deformation.gain", "tracking.rate", "limits.inputs.Q1.0", "limits.inputs.Q1.1"]
    stepper = fp.Stepper(*_of("CTC+FPI"), live=live, compiled=False)
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
