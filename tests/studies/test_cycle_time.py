"""The time of a cycle that plans is that of the cycles in which the controller planned, also where samples were skipped."""

from __future__ import annotations

from typing import Any

import numpy as np

import fpirhc as fp
from fpirhc.simulation.machine import SKIPPED
from fpirhc.studies.comparison.timing import REPLAYED, _planned, measure_cycles, stepper_to_time
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


def test_controllers_are_timed_in_turn(monkeypatch):
    """Each has all of its cycles, in blocks between those of the other."""
    task, turns = fp.load_problem("two_mass"), list[int]()
    ran = [
        (stepper_to_time(task.problem, law, compiled=False), fp.simulate(task.problem, law, seed=0, compiled=False))
        for law in (task.controllers["CTC"], task.controllers["CTC+FPI (eq 6)"])
    ]
    for k, (stepper, _) in enumerate(ran):

        def stepped(*now: object, k: int = k, step: Any = stepper.step) -> object:
            turns.append(k)
            return step(*now)

        monkeypatch.setattr(stepper, "step", stepped)
    assert all(one is not None and one.median > 0 for one in measure_cycles(task.problem, ran))
    assert turns.count(0) == turns.count(1) == min(REPLAYED, ran[0][1].cycles)
    assert np.count_nonzero(np.diff(turns)) > 2
