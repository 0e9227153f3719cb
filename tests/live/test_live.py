"""Live settings: one compiled loop for every setting, bit by bit the loop that would be built with the number."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.errors import CompileError

brief = cache(lambda: replace(tasks.two_mass.problem, duration=0.3, measure_from=0.0))
by_torque = cache(lambda: tasks.two_mass.controllers["CTC+FPI (eq 6)"])
by_plan = cache(lambda: tasks.two_mass.controllers["RHC+FPI"])
FOUR = ["tracking.rate", "deformation.gain", "deformation.scale", "deformation.shift"]
FIVE = ["deformation.gain", "cost.states.q1", "cost.states.q2'", "cost.deviation.Q1", "limits.inputs.Q1.1"]


def rebuilt(ready, numbers, *, compiled):
    """The run of a loop that is built with these numbers."""
    problem, controller, _ = ready.live.changed(numbers)
    return fp.simulator(problem, controller, compiled=compiled).run(seed=0)


def random_numbers(rng):
    """Numbers for the settings of `FOUR` and `FIVE`."""
    four = dict(
        zip(FOUR, (rng.uniform(3, 9), -rng.uniform(0.1, 1.2), rng.uniform(0.8, 3), rng.uniform(0.05, 0.6)), strict=True)
    )
    five = (
        -rng.uniform(0.1, 1.2),
        rng.uniform(200, 2e3),
        rng.uniform(0.3, 3),
        rng.uniform(5e-4, 3e-3),
        rng.uniform(2, 40),
    )
    return four, dict(zip(FIVE, five, strict=True))


@pytest.mark.parametrize("compiled", [True, False], ids=["C", "VM"])
def test_a_changed_loop_is_the_rebuilt_one_bit_by_bit(compiled):
    """Formulas of settings round alike as numbers and as expressions; behind other weights plans keep the build's step length."""
    rng = np.random.default_rng(7)
    torque = fp.simulator(brief(), by_torque(), compiled=compiled, live=FOUR)
    planned = fp.simulator(brief(), by_plan(), compiled=compiled, live=FIVE)
    for k in range(3):
        four, five = random_numbers(rng)
        assert np.array_equal(torque.run(seed=0, settings=four).log, rebuilt(torque, four, compiled=compiled).log), four
        if k == 0:
            one, other = (
                planned.run(seed=0, settings=five)["command"],
                rebuilt(planned, five, compiled=compiled)["command"],
            )
            assert np.abs(one - other).max() <= 1e-4 * np.abs(other).max()


def test_a_change_during_a_run_is_that_of_a_loop_that_goes_on_with_the_number():
    """Before the change the run is the one without it; a change at the start is a run with the number."""
    ready = fp.simulator(brief(), by_plan(), live=FIVE)
    numbers = {"deformation.gain": -0.9, "cost.states.q1": 400.0}
    changed, plain = ready.run(seed=0, changes={0.1234: numbers}), ready.run(seed=0)
    assert np.array_equal(changed.log[:124], plain.log[:124])
    assert not np.array_equal(changed["deformed"][124:130], plain["deformed"][124:130])
    record: Any = changed.settings["live"]
    assert [time for time, _ in record] == [0.0, 0.124]
    assert record[1][1]["deformation.gain"] == -0.9


def test_a_compiler_that_fails_is_an_error(monkeypatch):
    """A loop without live settings runs in the virtual machine then; one with live settings must not hide what went wrong."""
    monkeypatch.setenv("FPIRHC_CC", "false")
    short = replace(brief(), duration=0.01)
    assert not fp.simulator(short, by_torque()).compiled
    with pytest.raises(CompileError):
        fp.simulator(short, by_torque(), live=["deformation.gain"])
    monkeypatch.setenv("FPIRHC_CC", "none")
    assert not fp.simulator(short, by_torque(), live=["deformation.gain"]).compiled


CHANGED = {0.1: {"deformation.gain": -0.9}, 0.2: {"deformation.gain": -0.9, "deformation.scale": 3.0}}


def test_a_run_knows_what_was_in_force_when(tmp_path):
    """Times of cycles and all numbers; a run without live settings has none; a file keeps them."""
    run = fp.simulate(brief(), by_torque(), seed=0, compiled=False, changes=CHANGED)
    gain, scale = CHANGED[0.2]
    first = {gain: by_torque().deformation.gain, scale: by_torque().deformation.scale}
    expected = [(0.0, first), (0.1, first | CHANGED[0.1]), (0.2, CHANGED[0.2])]
    assert [(time, dict(numbers)) for time, numbers in run.in_force] == expected
    run.save(tmp_path / "run.npz")
    assert fp.load_run(tmp_path / "run.npz").in_force == run.in_force
    controllers = tasks.two_mass.controllers
    assert fp.simulate(brief(), controllers["CTC"], seed=0, compiled=False).in_force == ()
