"""Short runs are not worth a compiler: `compiled=None` chooses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import fpirhc as fp


def test_a_short_run_is_not_compiled_unless_it_is_asked_for():
    """None chooses by cycles and stages; the run says why, and is that of the virtual machine."""
    task = fp.load_problem("two_mass")
    short = replace(task.problem, duration=20 * task.problem.period, measure_from=0.0)
    law = task.controllers["CTC"]
    chosen = fp.simulate(short, law, seed=0, compiled=None)
    assert chosen.settings["why not compiled"] == "compiled=None was given, and the run is short"
    assert np.array_equal(chosen.log, fp.simulate(short, law, seed=0, compiled=False).log)
    long = replace(task.problem, duration=200_000 * task.problem.period)
    ready = fp.simulator(long, law, compiled=None)
    assert ready.compiled or "short" not in ready.why_not_compiled
