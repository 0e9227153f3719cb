"""Dead times that a run may set: one loop for all of them up to the stated longest, bit by bit the loop that is built with each."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.contracts import Controller

LONGEST = {"Q1": 0.012, "Q2": 0.02, "measurement": 0.008}  # s; cycles of 1 ms
queued = cache(
    lambda: replace(
        tasks.two_mass.problem,
        duration=0.2,
        measure_from=0.0,
        dead_time=fp.DeadTime(inputs={"Q1": 0.003, "Q2": 0.0}, measurement=0.002, longest=LONGEST),
    )
)
PLANT = ["dead_time.inputs.Q1", "dead_time.inputs.Q2", "dead_time.measurement"]
WAYS = pytest.mark.parametrize("compiled", [True, False], ids=["C", "VM"])


def same_signals(one: fp.Run, other: fp.Run) -> bool:
    """Whether two runs agree bit by bit in every signal that both have."""
    names = set(one.layout.names) & set(other.layout.names)
    assert {"command", "true_error", "deformed"} <= names
    return all(np.array_equal(one[name], other[name], equal_nan=True) for name in names)


@pytest.mark.parametrize(
    ("name", "compiled"),
    [
        ("CTC+FPI (eq 6)", True),
        ("CTC+FPI (eq 6)", False),
        ("RHC+FPI", False),
        pytest.param("RHC+FPI", True, marks=pytest.mark.slow),
    ],
)
def test_a_dead_time_that_is_set_is_the_one_that_is_built(name, compiled):
    """Whole and broken cycles, none at all, and the longest; the rebuilt loop has queues of its own length."""
    controller, rng = tasks.two_mass.controllers[name], np.random.default_rng(3)
    ready = fp.simulator(queued(), controller, compiled=compiled, live=PLANT)
    plain = fp.simulator(queued(), controller, compiled=compiled).run(seed=0)
    assert same_signals(ready.run(seed=0), plain)
    cases = [(0.0, 0.0, 0.0), tuple(rng.uniform(0, 1, 3) * list(LONGEST.values())), (0.012, 0.02, 0.008)]
    cases = cases[:2] if name == "RHC+FPI" else [*cases, (0.005, 0.011, 0.003)]
    for q1, q2, seen in cases:
        numbers: dict[str, Any] = dict(zip(PLANT, map(float, (q1, q2, seen)), strict=True))
        own = replace(
            queued(), dead_time=fp.DeadTime(inputs={"Q1": float(q1), "Q2": float(q2)}, measurement=float(seen))
        )
        rebuilt = fp.simulator(own, controller, compiled=compiled).run(seed=0)
        assert same_signals(ready.run(seed=0, settings=numbers), rebuilt), numbers
        assert rebuilt.cycles == 200


def test_a_dead_time_that_changes_during_a_run_reads_another_place_of_the_queue():
    """The command that acts is that of d cycles before, whatever d was earlier; before the run it is the one of the problem."""
    ready = fp.simulator(queued(), tasks.two_mass.controllers["CTC+FPI (eq 6)"], live=PLANT[:1])
    run = ready.run(seed=0, changes={0.05: {PLANT[0]: 0.011}, 0.1: {PLANT[0]: 0.0}, 0.15: {PLANT[0]: 0.0025}})
    command, arriving = run["command"][:, 0], run["arriving"][:, 0]
    before = queued().inputs_before[0]
    sent = np.concatenate([np.full(20, before), command])
    whole = np.array([3] * 50 + [11] * 50 + [0] * 50)
    assert np.array_equal(arriving[:150], sent[np.arange(150) + 20 - whole])
    k = np.arange(150, 200) + 20
    assert np.array_equal(arriving[150:], (1 - 0.5) * sent[k - 2] + 0.5 * sent[k - 3])
    assert np.ptp(command) > 1.0


@WAYS
def test_an_estimator_waits_for_its_samples_behind_the_dead_time_in_force(compiled):
    """No response is used before its samples have arrived; how long that takes depends on the dead time."""
    sensing = fp.Sensing(estimator=fp.PositionDifference())
    problem = replace(queued(), sensing=sensing)
    controller = fp.ComputedTorque(fp.Exponential(rate=4.0), fp.Sigmoid(gain=-0.2, scale=20.0))
    ready = fp.simulator(problem, controller, compiled=compiled, live=PLANT[2:])
    for late in (0.0, 0.0031, 0.008):
        own = replace(problem, dead_time=replace(problem.dead_time, measurement=late))
        rebuilt = fp.simulator(own, controller, compiled=compiled).run(seed=0)
        assert same_signals(ready.run(seed=0, settings={PLANT[2]: late}), rebuilt), late


LAW = fp.Exponential(rate=6.0)
SIGMOID = fp.Sigmoid(gain=-0.5, scale=20.0)
INCREMENT = fp.Increment(SIGMOID.with_effective_gain(1 / 1.5), cycles=60, uncertainty=6, longest=80)
BELIEFS: dict[str, tuple[Controller | str, str, tuple[float, ...]]] = {
    "pair": (
        fp.ComputedTorque(LAW, fp.Paired(SIGMOID, cycles=60, longest=90)),
        "deformation.cycles",
        (50, 33.4, 0, 90),
    ),
    "mean of pairs": (
        fp.ComputedTorque(LAW, fp.Paired(SIGMOID, cycles=60, uncertainty=5, longest=90)),
        "deformation.cycles",
        (50, 33.4, 90),
    ),
    "increment": (fp.ComputedTorque(LAW, INCREMENT), "deformation.cycles", (50, 77.7, 6)),
    "prediction by the requests": (
        fp.Predicted(fp.ComputedTorque(LAW, INCREMENT), inputs=0.06, longest=0.08, by=fp.ByDesired()),
        "inputs",
        (0.05, 0.0773, 0.0),
    ),
    "prediction with the residual": (
        fp.Predicted(fp.ComputedTorque(LAW, INCREMENT), inputs=0.06, longest=0.08, by=fp.ByModel(residual_time=0.2)),
        "inputs",
        (0.05, 0.0785, 0.002),
    ),
    "plan from the prediction": ("RHC", "measurement", (0.01, 0.0195)),
}


@pytest.mark.parametrize(
    ("name", "compiled"),
    [*((name, False) for name in BELIEFS), *(pytest.param(n, True, marks=pytest.mark.slow) for n in list(BELIEFS)[:3])],
)
def test_a_belief_that_is_set_is_the_one_that_is_built(name, compiled):
    """The controller's own dead time, and the plant's beside it, in one compiled loop."""
    own, path, values = BELIEFS[name]
    shipped = cast(Any, tasks.delayed_mass.controllers)
    controller = replace(shipped[own], longest=0.08) if isinstance(own, str) else own
    dead_time = fp.DeadTime(inputs={"Q": 0.06}, longest={"Q": 0.1})
    problem = replace(tasks.delayed_mass.problem, duration=0.15, measure_from=0.0, dead_time=dead_time)
    ready = fp.simulator(problem, controller, compiled=compiled, live=[path, "dead_time.inputs.Q"])
    assert same_signals(ready.run(seed=0), fp.simulator(problem, controller, compiled=compiled).run(seed=0))
    for k, value in enumerate(values):
        numbers: dict[str, Any] = {path: value, "dead_time.inputs.Q": 0.045 + 0.01 * k}
        changed, own, _ = ready.live.changed(numbers)
        rebuilt = fp.simulator(changed, own, compiled=compiled).run(seed=0)
        assert same_signals(ready.run(seed=0, settings=numbers), rebuilt), numbers
        assert np.ptp(rebuilt["command"]) > 0
