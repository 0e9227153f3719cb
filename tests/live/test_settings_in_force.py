"""Which live settings were in force when: in a run, in its file, and in what is measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers import tasks

import fpirhc as fp

NAME, GAIN, SCALE = "CTC+FPI (eq 6)", "deformation.gain", "deformation.scale"
CHANGES = {0.1: {GAIN: -0.9}, 0.2: {GAIN: -0.9, SCALE: 3.0}}


def test_limits_count_from_when_they_are_in_force():
    """The share of cycles at a limit is that of cycles that were clipped, also where the limit comes during the run."""
    problem = replace(tasks.two_mass.problem, duration=0.2, measure_from=0.05)
    ready = fp.simulator(problem, tasks.two_mass.controllers["CTC"], live=["limits.inputs.Q1"], compiled=False)
    free = ready.run(seed=0)["command.Q1"]
    run = ready.run(seed=0, changes={0.1: {"limits.inputs.Q1": (-200.0, float(free[len(free) // 2 :].min()))}})
    counts = run["clipped"][np.round(run.time / problem.period) >= round(0.05 / problem.period)]
    assert fp.measure(problem, run).at_limit == counts.mean() > 0.2


def test_a_run_knows_what_was_in_force_when(tmp_path):
    """Times of cycles and all numbers; a run without live settings has none; a file keeps them."""
    problem, controllers = replace(tasks.two_mass.problem, duration=0.3, measure_from=0.0), tasks.two_mass.controllers
    run = fp.simulate(problem, controllers[NAME], seed=0, compiled=False, changes=CHANGES)
    first = {p: getattr(controllers[NAME].deformation, p.partition(".")[2]) for p in (GAIN, SCALE)}
    expected = [(0.0, first), (0.1, first | {GAIN: -0.9}), (0.2, {GAIN: -0.9, SCALE: 3.0})]
    assert [(time, dict(numbers)) for time, numbers in run.in_force] == expected
    assert fp.simulate(problem, controllers["CTC"], seed=0, compiled=False).in_force == ()
    run.save(tmp_path / "run.npz")
    assert fp.load_run(tmp_path / "run.npz").in_force == run.in_force
