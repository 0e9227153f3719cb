"""A second optimiser for horizons that the first leaves without a usable plan."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from plants import pendulum

import fpirhc as fp
from fpirhc.conformance.optimiser import check_optimiser
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.base import Optimiser
from fpirhc.symbolic.layout import Layout, Signal

LIMITS = fp.Limits(inputs={"torque": (-6.0, 6.0)}, states={"angle'": (-0.3, 0.5)})
COST = fp.Quadratic(states={"angle": 10.0, "angle'": 0.1}, effort={"torque": 0.05})
REFERENCE = fp.Trajectory(lambda t: {"angle": 0.5 + 0.4 * t})
HORIZON = fp.Horizon(stages=12, step=0.05)
FIXED = fp.FixedPoint(iterations=40, tolerance=1e-6)


@dataclass(frozen=True)
class Never(Optimiser):
    """An optimiser whose solver always fails: the remembered plan, NON_FINITE."""

    def memory(self, ocp):
        return Layout((Signal("plan_inputs", tuple(f"u@{k}" for k in range(ocp.stages))),))

    def shifted(self, ocp, memory):  # noqa: ARG002
        return memory

    def step(self, ocp):
        symbols = [ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, ocp.stages + 1)]
        symbols += [ca.MX.sym("lower", 1), ca.MX.sym("upper", 1), ca.MX.sym("memory", ocp.stages)]
        diagnostics = ca.vertcat(ca.MX.zeros(4), int(fp.Status.NON_FINITE))
        return ca.Function("never", symbols, [symbols[4].T, diagnostics, symbols[4]])


NEVER = Never()


def horizon():
    plant = pendulum()
    ocp = transcribe(plant, REFERENCE, HORIZON, COST, LIMITS)
    return ocp, stage_data(plant, REFERENCE, HORIZON, COST)(0.0, plant.approximate).full()


def test_the_second_is_asked_where_the_first_has_no_usable_plan_and_counted():
    """The answer is that of the second, and the memory says how often it was asked."""
    ocp, data = horizon()
    ladder = fp.Ladder(NEVER, FIXED)
    first, layout = np.array([0.1, 0.0]), ladder.memory(ocp)
    bounds, memory = (ocp.input_lower, ocp.input_upper), ca.DM(layout.start())
    for _ in range(2):
        inputs, diagnostics, memory = ladder.step(ocp)(first, data, *bounds, memory)
    assert int(diagnostics[4]) == fp.Status.OK
    best = fp.solve(ocp, FIXED, first, data)
    np.testing.assert_allclose(inputs.full(), best.inputs, atol=1e-5)
    parts = layout.unpack(memory.full().ravel())
    assert parts["plan_second_plans"][0] == 2
    np.testing.assert_array_equal(parts["plan_inputs"], inputs.full().ravel(order="F"))


def test_the_second_is_left_alone_where_the_first_succeeds():
    ocp, data = horizon()
    ladder, first = fp.Ladder(FIXED, NEVER), np.array([0.1, 0.0])
    bounds, memory, own = (ocp.input_lower, ocp.input_upper), ladder.memory(ocp).start(), FIXED.memory(ocp).start()
    for _ in range(3):
        inputs, diagnostics, memory = ladder.step(ocp)(first, data, *bounds, memory)
        alone, other_diagnostics, own = FIXED.step(ocp)(first, data, *bounds, own)
    np.testing.assert_array_equal(inputs.full(), alone.full())
    assert int(diagnostics[4]) == int(other_diagnostics[4]) == fp.Status.OK
    assert float(memory[-1]) == 0


def test_a_run_counts_the_plans_of_the_second():
    """Every plan of a closed loop whose first optimiser never succeeds."""
    problem = fp.Problem(
        plant=pendulum(),
        reference=REFERENCE,
        start={"angle": 0.1},
        period=0.05,
        duration=0.4,
        limits=LIMITS,
        horizon=HORIZON,
        cost=COST,
    )
    run = fp.simulate(problem, fp.RecedingHorizon(fp.Ladder(NEVER, FIXED)), seed=0)
    metrics = fp.measure(problem, run)
    failed = fp.measure(problem, fp.simulate(problem, fp.RecedingHorizon(NEVER), seed=0)).statuses.get("HELD", 0)
    assert failed > 0
    assert metrics.solve["second_plans"] >= 1
    assert "HELD" not in metrics.statuses


@pytest.mark.parametrize("second", [fp.SequentialQuadratic(tolerance=1e-5)])
def test_a_ladder_is_an_optimiser(second):
    """All laws of optimisers with two different ones; the conformance tests try it around one."""
    check_optimiser(fp.Ladder(replace(FIXED, tolerance=1e-5), second), tolerance=1e-5, seed=0)
