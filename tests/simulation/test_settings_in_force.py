"""Which live settings were in force when: in a run, in its file, in pictures and in the report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tasks

import fpirhc as fp
from fpirhc.errors import InvalidProblem
from fpirhc.studies.comparison.compare import compare

NAME, GAIN, SCALE = "CTC+FPI (eq 6)", "deformation.gain", "deformation.scale"
CHANGES = {0.1: {GAIN: -0.9}, 0.2: {GAIN: -0.9, SCALE: 3.0}}


def test_changes_of_unknown_controllers_are_refused():
    with pytest.raises(InvalidProblem, match=r"changes.*eq 6"):
        compare(tasks.two_mass, seed=0, controllers=["CTC", NAME], changes={"CTC+FPI (eq6)": CHANGES})


def test_limits_count_from_when_they_are_in_force():
    """The share of cycles at a limit is that of cycles that were clipped, also where the limit comes during the run."""
    problem = replace(tasks.two_mass.problem, duration=0.2, measure_from=0.05)
    ready = fp.simulator(problem, tasks.two_mass.controllers["CTC"], live=["limits.inputs.Q1"], compiled=False)
    free = ready.run(seed=0)["command.Q1"]
    run = ready.run(seed=0, changes={0.1: {"limits.inputs.Q1": (-200.0, float(free[len(free) // 2 :].min()))}})
    counts = run["clipped"][np.round(run.time / problem.period) >= round(0.05 / problem.period)]
    assert fp.measure(problem, run).at_limit == counts.mean() > 0.2
