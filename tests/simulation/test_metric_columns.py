"""What users read of the metrics: columns, units and texts; and the ends of every definition, on runs that were made by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.hand_made_runs import CYCLES, SOLVE, problem, run
from helpers.plants import linear

import fpirhc as fp
from fpirhc import Status
from fpirhc.contracts import Signal
from fpirhc.simulation.metrics import known_metrics
from fpirhc.simulation.metrics.entries.contraction import sampled_spectrum
from fpirhc.simulation.trials import errors_of

BY_NAME = {metric.name: metric for metric in known_metrics()}


def of_solves(plans) -> Any:
    """Metrics of a run with these plans, cycle by cycle: one number stands for a whole plan."""
    plans = np.asarray(plans, dtype=float)
    solve = np.column_stack([plans, 0 * plans, 0 * plans, -1 + 0 * plans, 0 * plans])
    return fp.measure(problem(), run(0.0, solve=(Signal("solve", SOLVE), solve)))


def cut(source, cycles: int):
    """The first cycles of a run."""
    return replace(source, log=source.log[:cycles])


@pytest.fixture(scope="module")
def adaptive():
    """A run of computed torque with adaptation and its problem, a thousand cycles."""
    task = problem(plant=linear(1.6, 1.0), start={"y": 0.5}, period=1e-3, duration=1.0, measure_from=0.0)
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.4, scale=50.0))
    return task, fp.simulate(task, controller, seed=0, compiled=False)


# What stands where


# The ends of definitions


def test_a_run_that_ended_at_once_has_no_numbers():
    solve = (Signal("solve", SOLVE), np.ones((CYCLES, 5)))
    metrics = fp.measure(problem(), cut(run(1.0, stop="signal 'x' is not finite", solve=solve), 0))
    assert np.isnan([metrics.at_limit, metrics.settling["y"], metrics.effort["u"], metrics.rms_error["y"]]).all()
    assert np.isnan(metrics["total_variation"]["u"])
    assert metrics.solve == {}
    assert metrics.statuses == {"NON_FINITE": 1}
    assert metrics["cycles"] == {"": 0}
    assert metrics.broken == fp.measure(problem(), run(1.0)).broken == {}


def test_a_pair_with_a_run_that_ended_before_errors_count_is_informative():
    """A command at its limit in every cycle shows nothing of adaptation; that one of the runs ended is a fact, whichever it is."""
    task, ended = problem(limits=fp.Limits(inputs={"u": (-1.0, 1.0)})), "signal 'x' is not finite"
    whole, short = run(1.0, command=1.0), run(1.0, command=1.0, stop=ended)
    assert errors_of(task, (whole, whole)).stuck.startswith("not informative: the command stands at a limit in 100 %")
    assert errors_of(task, (whole, short)).stuck == errors_of(task, (short, whole)).stuck == ""
    assert errors_of(task, (cut(short, 0), whole)).without == {"y": np.inf}


def test_one_cycle_is_enough_for_a_solve():
    solve = (Signal("solve", SOLVE), np.ones((CYCLES, 5)))
    metrics = fp.measure(problem(measure_from=0.0), cut(run(0.0, solve=solve), 1))
    assert metrics.solve["plans"] == 1
    assert metrics.solve["worst_iterations"] == 1


def test_end_of_a_run_counts_beside_other_cycles_that_were_not_finite():
    """Two held cycles of that status, and the one in which the run ended; a status that never occurred counts zero."""
    status = np.where(np.arange(CYCLES) < 2, float(Status.NON_FINITE), 0.0)
    metrics = fp.measure(problem(), run(0.0, status=status, stop="signal 'x' is not finite"))
    assert metrics.statuses == {"OK": 23, "NON_FINITE": 3}
    always = ("OK", "NOT_CONVERGED", "INFEASIBLE", "HELD", "NON_FINITE")  # the others are statuses of a machine
    assert metrics["status"] == {name: {"OK": 23, "NON_FINITE": 3}.get(name, 0) for name in always}


def test_plans_that_return_are_counted_once():
    assert of_solves(np.arange(CYCLES) // 10 % 2).solve["plans"] == 2
    assert of_solves(np.zeros(CYCLES)).solve["plans"] == 1
    assert of_solves(np.arange(CYCLES)).solve["plans"] == CYCLES


def test_plans_that_differ_by_one_everywhere_are_two():
    """Cost, residuals, iterations and status of one are each larger by one than those of the other, whichever is first."""
    for first in (0, 1):
        solve = np.repeat((first + np.arange(CYCLES))[:, None] % 2, 5, axis=1)
        assert fp.measure(problem(), run(0.0, solve=(Signal("solve", SOLVE), solve))).solve["plans"] == 2


def test_a_plan_that_is_not_finite_has_iterations_and_no_residual():
    """It took its time, and its residual is no number of a plan."""
    solve = np.tile([0.0, 0.1, 0.2, 3.0, Status.OK], (CYCLES, 1))
    solve[7] = [0.0, 9.0, 9.0, 50.0, Status.NON_FINITE]
    of = fp.measure(problem(), run(0.0, solve=(Signal("solve", SOLVE), solve))).solve
    assert (of["worst_iterations"], of["worst_stationarity"], of["worst_feasibility"]) == (50, 0.1, 0.2)


def test_a_run_that_ended_early_has_no_cost():
    """A sum over fewer cycles would look like a small cost."""
    cost = (Signal("cost", ("states",)), 1.0)
    assert fp.measure(problem(), run(0.0, cost=cost)).cost == {"states": 50.0, "total": 50.0}
    assert fp.measure(problem(), run(0.0, cost=cost, stop="signal 'x' is not finite")).cost == {}


# Contraction


def test_contraction_needs_ten_cycles(adaptive):
    task, result = adaptive
    for cycles, names in ((9, set()), (10, {"contraction.predicted", "contraction.growing", "contraction.measured"})):
        metrics = fp.measure(task, cut(result, cycles))
        assert {m.name for m, _, _ in metrics if m.name.startswith("contraction")} == names


def test_contraction_is_that_of_an_adapting_controller(adaptive):
    """Neither a controller without a logged contraction nor one without a gain has a factor."""
    task, result = adaptive
    layout = type(result.layout)(tuple(s for s in result.layout.signals if s.name != "contraction"))
    columns_left = [k for k, c in enumerate(result.layout.columns) if c in layout.columns]
    silent = replace(result, layout=layout, log=result.log[:, columns_left])
    gainless = replace(result, settings={k: v for k, v in result.settings.items() if k != "effective_gain"})
    for other in (silent, gainless):
        assert fp.measure(task, other)["contraction.predicted"] == {}


def test_spectrum_is_sampled_from_the_second_to_the_last_cycle(adaptive, monkeypatch):
    """The first cycle has no request before it; a long run is thinned to 200 cycles."""
    from fpirhc.simulation.metrics.entries import contraction

    task, result = adaptive
    sampled_cycles = []

    def recorded(problem, real, states, requests, believed, exact):
        sampled_cycles.append((states, requests, believed))
        return np.ones((len(states), 1, 1))

    monkeypatch.setattr(contraction, "jacobians_along", recorded)
    for cycles in (1000, 50):
        sampled_spectrum(replace(task, measure_from=0.0), cut(result, cycles))
    (long, requests, believed), (short, *_) = sampled_cycles
    assert (len(long), len(requests), len(short)) == (200, 200, 49)
    np.testing.assert_array_equal(long[[0, -1]], result["state"][[1, 999]])
    np.testing.assert_array_equal(requests[[0, -1]], result["deformed"][[1, 999]])
    np.testing.assert_array_equal(short, result["state"][1:50])
    assert believed == pytest.approx([1.0])
