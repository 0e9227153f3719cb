"""What a run did with hard limits of states, rates and expressions: each by name, in its unit, and said of every controller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.simulation.hard_limits import hard_limits
from fpirhc.studies.comparison.compare import broken_limits

TASK = fp.load_problem("van_der_pol")
POWER = fp.PathConstraint(lambda v: v.input.u * v.state["q'"], -20.0, 20.0, "W")
PROBLEM = replace(
    TASK.problem,
    duration=2.0,
    measure_from=0.0,
    limits=replace(
        TASK.problem.limits, states={"q'": (-1.0, 1.0)}, rates={"u": (-300.0, 300.0)}, paths={"power": POWER}
    ),
)
LAW = fp.ComputedTorque(fp.Exponential(rate=6.0))


@pytest.fixture(scope="module")
def run() -> fp.Run:
    return fp.simulate(PROBLEM, LAW, seed=0, compiled=False)


def test_every_hard_limit_is_followed(run):
    """By its own values; the command keeps its rate, and nothing keeps the others."""
    state, rate, power = hard_limits(PROBLEM, run)
    force, speed = np.ravel(run["command"]), run["plant_state"][:, 1]
    assert (state.name, rate.name, power.name) == ("q'", "u rate", "power")
    np.testing.assert_allclose(state.values, speed)
    np.testing.assert_allclose(power.values, force * speed)
    np.testing.assert_allclose(rate.values[1:], np.diff(force) / PROBLEM.period, atol=1e-9)
    assert rate.beyond.max() < 1e-9
    assert power.beyond.max() > 0.1
    assert power.beyond.max() == pytest.approx(max(np.abs(power.values).max() - 20.0, 0.0) / 40.0)


def test_what_is_left_is_said_and_what_is_weighed_is_not(run):
    said = broken_limits(PROBLEM, run)
    assert any(text.startswith("power reaches") and text.endswith("W") for text in said)
    assert not any("rate" in text for text in said)
    soft = replace(PROBLEM, limits=replace(PROBLEM.limits, soft={"power": 1.0, "q'": 1.0}))
    assert broken_limits(soft, run) == ()
