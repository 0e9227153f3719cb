"""The time of a cycle that plans is that of the cycles in which the controller planned, also where samples were skipped."""

from __future__ import annotations

import numpy as np

import fpirhc as fp
from fpirhc.simulation.machine import SKIPPED
from fpirhc.studies.comparison.timing import _planned, stepper_to_time
from fpirhc.task.problem import cycles_per_plan


def test_a_skipped_sample_moves_the_next_plans_by_one_cycle():
    """An unknown current steps in: the gate doubts the response to it once, and from then on plans come a cycle later."""
    task = fp.load_problem("hodgkin_huxley")
    controller, problem = task.controllers["RHC"], task.problem
    assert problem.horizon is not None
    stride = cycles_per_plan(problem.horizon, problem.period)
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    stepper = stepper_to_time(problem, controller, compiled=False)
    memory, skipped, planned = stepper.start(), np.empty(600), np.empty(600)
    for k in range(600):
        _, memory = stepper.step(run.time[k], run["state"][k], run["realised"][k], memory)
        trace = stepper.trace()
        skipped[k], planned[k] = trace[SKIPPED][0], trace["planned"][0]
    assert skipped[-1] > 0
    ran = np.flatnonzero(np.diff(skipped, prepend=0) == 0)
    new = ran[1:][np.diff(planned[ran]) != 0]  # the plan's first input is held until the next plan
    found = np.flatnonzero(_planned(skipped, stride))
    assert set(new) <= set(found)
    assert found.size == (600 - skipped[-1] - 1) // stride
    assert not (found % stride == 0).all()
