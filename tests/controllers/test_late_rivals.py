"""Learning inverse dynamics behind dead time: the regressor, the response and the error of one instant."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_adaptive_rivals import (
    ADAPTATION,
    AID,
    BOX,
    GENTLE,
    NLMS,
    SIGMOID,
    SLOTINE_LI_FPI,
    TRACKING,
    hardening,
    rich,
    task,
)

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.errors import NotSupported

EXACT, FIRST = np.array([1.0, 0.5, 20.0, 3.0]), np.array([1.5, 0.0, 12.0, 0.0])
NONE = fp.DeadTime()
LATE = {"input": fp.DeadTime(inputs={"u": 0.02}), "measurement": fp.DeadTime(measurement=0.02)}
SLOW = replace(AID, rule=fp.LyapunovRule({name: 0.05 * gain for name, gain in ADAPTATION.gains.items()}))


def run(controller: Controller, late: fp.DeadTime = NONE, duration: float = 10.0, **changes: Any) -> fp.Run:
    problem = replace(task(rich, duration), dead_time=late, **changes)
    result = fp.simulate(problem, controller, seed=0, compiled=False)
    assert result.stop is None
    return result


def left(result: fp.Run) -> float:
    """Share of the first parameter error that is left at the end."""
    return float(np.linalg.norm(result["estimate"][-1] - EXACT) / np.linalg.norm(FIRST - EXACT))


def test_late_samples_teach_what_they_taught_at_once():
    """The learning block alone, given one motion at once and seven cycles late: the same estimates, seven cycles later."""
    late, problem = 7, task(rich, 0.1)
    blocks = [
        next(b for b in AID.blocks(p)[0] if b.name == "learn")
        for p in (problem, replace(problem, dead_time=fp.DeadTime(measurement=late * problem.period)))
    ]
    random, cycles = np.random.default_rng(3), 40
    states, realised, integral = (random.standard_normal((cycles, n)) for n in (2, 1, 1))
    reference = problem.reference.function(problem.plant)
    estimates: list[list[np.ndarray]] = []
    for block, delay in zip(blocks, (0, late), strict=True):
        memory = {m.name: m.start_vector() for m in block.memory.signals} | {"learned": FIRST}
        estimates.append([])
        for k in range(delay, cycles):
            j, time = k - delay, k * problem.period
            given = {
                "state": states[j],
                "_measured_state": states[j],
                "realised": realised[j],
                "parameters": problem.plant.approximate,
                "_command_before": [0.0],
                "warm_up": 10,
                "_clipped_before": 0,
                "_target": reference(j * problem.period)[0],
                "_measured_time": time,
                "_integral_used": integral[j],
            }
            results = block.function(*(given[n] for n in block.inputs.names), *memory.values())
            estimates[-1].append(np.asarray(results[0].full()).ravel())
            memory = dict(zip(memory, results[len(block.writes.signals) :], strict=True))
    np.testing.assert_allclose(estimates[1], estimates[0][: cycles - late], rtol=1e-11, atol=1e-12)
    assert np.ptp(estimates[0], axis=0).min() > 1e-3


@pytest.mark.parametrize("late", LATE)
@pytest.mark.parametrize("name", ["projection", "projection and deformation", "Slotine-Li and deformation"])
def test_a_projection_learns_as_without_dead_time(late, name):
    """Pairs that are 20 cycles old: a third of the parameter error is left at most, as without dead time."""
    paired = fp.Paired(SIGMOID, cycles=20)
    controllers = {
        "projection": NLMS,
        "projection and deformation": replace(NLMS, deformation=paired),
        "Slotine-Li and deformation": replace(SLOTINE_LI_FPI, deformation=paired),
    }
    assert left(run(controllers[name], LATE[late])) < 0.36


def test_a_lyapunov_rule_converges_slower_behind_dead_time():
    """With a twentieth of its gains it learns behind 20 ms, slower than without; with all of them it leaves the world."""
    free, late = left(run(SLOW)), left(run(SLOW, LATE["input"]))
    assert free < late < 0.3
    predicted = run(fp.Predicted(SLOW, inputs=0.0, measurement=0.02), LATE["measurement"])
    assert left(predicted) < 0.5
    error = np.abs(predicted["true_error"][-4000:]).max()
    plain = run(fp.ComputedTorque(TRACKING), LATE["measurement"])
    assert error < 0.2 * np.abs(plain["true_error"][-4000:]).max()
    problem = replace(task(rich, 2.0), dead_time=LATE["input"])
    assert fp.simulate(problem, AID, seed=0, compiled=False).stop is not None


def test_slotine_li_with_a_deformation_keeps_its_gradient():
    """Its gradient reads no response, so it is that of the cycle; with its deformation paired the errors stay small."""
    controller = replace(SLOTINE_LI_FPI, rule=GENTLE, deformation=fp.Paired(SIGMOID, cycles=20))
    assert np.abs(run(controller, LATE["input"])["error"][5000:]).max() < 0.02


def test_set_points_behind_dead_time_are_refused_for_the_gradient_alone():
    """The error of an earlier instant needs the reference of that instant, which a filter of set-points does not remember."""
    problem = fp.Problem(
        hardening(), fp.Setpoint({"q": 0.3}, rate=4.0), {"q": 0.0}, period=1e-3, duration=0.05, dead_time=LATE["input"]
    )
    with pytest.raises(NotSupported, match=r"LyapunovRule pairs .* use Projection, or a Trajectory"):
        fp.simulate(problem, AID, seed=0, compiled=False)
    assert fp.simulate(problem, NLMS, seed=0, compiled=False).stop is None
    assert set(BOX) == set(SLOW.bounds)
