"""FixedPoint's loops with limits of states beside IPOPT's: the benchmark's loops, its judge and its bars."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from constrained import problem_of
from limited_loop import OwnPlans, closed
from loops_of_machines import van_der_pol
from state_limited_loops import LOOPS, compared, optimiser_of

import fpirhc as fp

TIMED = "2 ms"  # the bar that no test may assert


def missed(comparison):
    return [name for name in comparison.missed if name != TIMED]


@cache
def oscillator():
    case = van_der_pol()
    ocp = problem_of(case)
    return case, ocp, optimiser_of(ocp)


def test_a_loop_with_a_wrong_model_is_ipopts_loop():
    """Plans at the limit in most cycles, two horizons without any plan: the same share, the same verdicts, the same cost."""
    case, ocp, optimiser = oscillator()
    both = compared(case, optimiser, ocp, 60, right=False)
    assert missed(both) == []
    assert both.active > 0.5
    assert both.fork is None
    np.testing.assert_array_equal(np.flatnonzero(both.told), np.flatnonzero(both.empty))
    assert both.told.any()
    assert both.own.stationary.all()
    assert both.own.loop.violation == pytest.approx(both.rival.loop.violation, rel=1e-4)


@pytest.mark.slow
def test_a_loop_whose_calls_end_too_early_misses_the_bars():
    """One iteration is too few for most of its plans, and for the certificate of an infeasible horizon."""
    case, ocp, optimiser = oscillator()
    assert {"share", "infeasible"} <= set(
        compared(case, replace(optimiser, most_iterations=1), ocp, 40, right=False).missed
    )


def test_what_is_measured_is_what_runs():
    """The commands of the benchmark's loop are those of a receding-horizon controller in a run."""
    case, ocp, optimiser = oscillator()
    ours = closed(case, ocp, OwnPlans(optimiser, ocp, optimiser.step(ocp), repeats=1), 40, right=False)
    problem = fp.Problem(
        plant=case.plant,
        reference=case.reference,
        start=case.start,
        period=case.horizon.step,
        duration=40 * case.horizon.step,
        limits=case.limits,
        horizon=case.horizon,
        cost=case.cost,
        integrator=fp.RungeKutta4(4),
    )
    run = fp.simulate(problem, fp.RecedingHorizon(optimiser), seed=0)
    np.testing.assert_allclose(run["command"][:40, 0], [p.inputs[0, 0] for p in ours.plans], atol=1e-9)
    np.testing.assert_allclose(run["state"][:40], ours.states[:40], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("right", [True, False], ids=["right", "wrong"])
@pytest.mark.parametrize("name", LOOPS)
def test_every_loop_meets_the_bars(name, right):
    case = LOOPS[name]()
    ocp = problem_of(case)
    assert missed(compared(case, optimiser_of(ocp), ocp, 200, right=right)) == []
