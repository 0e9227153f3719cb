"""Live settings: one compiled loop for every setting, bit by bit the loop that would be built with the number."""

from dataclasses import replace
from functools import cache

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
    four = rng.uniform((3, -1.2, 0.8, 0.05), (9, -0.1, 3, 0.6))
    five = rng.uniform((-1.2, 200, 0.3, 5e-4, 2), (-0.1, 2e3, 3, 3e-3, 40))
    return dict(zip(FOUR, four.tolist(), strict=True)), dict(zip(FIVE, five.tolist(), strict=True))


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
            runs = planned.run(seed=0, settings=five), rebuilt(planned, five, compiled=compiled)
            one, other = (run["command"] for run in runs)
            assert np.abs(one - other).max() <= 1e-4 * np.abs(other).max()


def test_a_compiler_that_fails_is_an_error(monkeypatch):
    """A loop without live settings runs in the virtual machine then; one with live settings must not hide what went wrong."""
    monkeypatch.setenv("FPIRHC_CC", "false")
    short = replace(brief(), duration=0.01)
    assert not fp.simulator(short, by_torque()).compiled
    with pytest.raises(CompileError):
        fp.simulator(short, by_torque(), live=["deformation.gain"])
    monkeypatch.setenv("FPIRHC_CC", "none")
    assert not fp.simulator(short, by_torque(), live=["deformation.gain"]).compiled


def test_a_run_keeps_the_numbers_that_it_was_given(tmp_path):
    """All live numbers and the limits in force are in the run's file; a run without live settings has none."""
    live, given = [*FOUR[1:3], FIVE[-1]], {"deformation.gain": -0.9, FIVE[-1]: 20.0}
    fp.simulator(brief(), by_torque(), compiled=False, live=live).run(seed=0, settings=given).save(tmp_path / "run.npz")
    kept = fp.load_run(tmp_path / "run.npz").settings
    assert kept["live"] == {"deformation.scale": by_torque().deformation.scale} | given
    assert kept["limits"][1][0] == given[FIVE[-1]]
    assert "live" not in fp.simulate(brief(), tasks.two_mass.controllers["CTC"], seed=0, compiled=False).settings
