"""Plausible ranges follow from the model: of responses and derivatives, and of the states behind outputs."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance.loops import two_masses
from fpirhc.controllers.plausible import plausible_range
from fpirhc.status import Status

PROBLEM = two_masses()
OF_OUTPUTS = ("anaesthesia", "tumour_vessels")  # the second has an output with the name of a state


def test_range_of_a_response_holds_what_the_model_can_do():
    """Ten times the largest response of the limits along the reference, found by hand, and what it has at plausible states."""
    plant, ranges = PROBLEM.plant, plausible_range(PROBLEM)
    boxes = [ranges[f"state.{name}"] for name in plant.state.elements]
    corners = product(*boxes, *(PROBLEM.limits.inputs[u] for u in plant.inputs))
    found = [
        plant.equations.controlled_response(c[:4], c[4:], plant.approximate).full().ravel()
        for c in map(np.array, corners)
    ]
    for k, name in enumerate(plant.controlled_names):
        lower, upper = ranges[f"realised.{name}"]
        assert lower == -upper
        # The states of the range were found with a smaller response, so these corners are inside three times of it.
        assert np.abs(found)[:, k].max() <= upper
        assert upper < 20 * np.abs(found)[:, k].max()


def test_range_of_a_response_does_not_depend_on_the_period():
    """Ten times as fast a cycle has a hundred times the response in half a cycle; the model's is the same."""
    fast = replace(PROBLEM, period=PROBLEM.period / 10)
    for column in ("realised.a", "realised.b", "state.a'"):
        assert plausible_range(fast)[column] == pytest.approx(plausible_range(PROBLEM)[column], rel=0.05)


@pytest.mark.parametrize(("order", "power"), [(2, 1), (3, 1), (3, 2), (4, 1), (4, 2), (4, 3)])
def test_derivatives_of_bounded_motions_are_inside(order, power):
    """The range of a derivative holds for splines and waves that keep |q| <= D and |q^(n)| <= A: no motion is refused."""
    from fpirhc.controllers.plausible import _derivative

    reach, limit = 3.0, 50.0
    half = _derivative(reach, limit, power, order, period=1e-6)
    frequency = (limit / reach) ** (1 / order)  # the fastest wave: its n-th derivative is at A
    assert reach * frequency**power <= half
    # Chebyshev's polynomial on an interval is extreme at the end of a half line (Schoenberg 1973).
    basis = np.polynomial.chebyshev.Chebyshev.basis(order)
    length = (np.abs(basis.deriv(order)(1.0)) * reach / limit) ** (1 / order)
    assert reach * abs(basis.deriv(power)(1.0)) / length**power <= half * (1 + 1e-12)


@pytest.mark.parametrize("name", OF_OUTPUTS)
def test_states_behind_outputs_have_ranges(name):
    """1e9 mg/l is no concentration: the cycle is skipped, and the command is held."""
    task = fp.load_problem(name)
    controller = next(c for c in task.controllers.values() if c.planner is None)
    stepper = fp.Stepper(task.problem, controller, compiled=False)
    assert not stepper.estimates
    first = np.concatenate([task.problem.start_state, task.problem.start_output, np.zeros(1)])
    for k, state in enumerate(task.problem.plant.state.elements):
        row = first.copy()
        row[k] = 1e9
        stepper.step_measured(0.0, row, stepper.start())
        skipped = stepper.trace()["status"][0] == Status.BAD_SAMPLE
        assert skipped == (f"state.{state}" in plausible_range(task.problem))
        assert skipped
    stepper.step_measured(0.0, first, stepper.start())
    assert stepper.trace()["status"][0] != Status.BAD_SAMPLE


@pytest.mark.parametrize("name", ["delayed_mass", "anaesthesia", "leaking_tanks", "planar_arm"])
def test_ordinary_runs_are_inside(name):
    """Every signal of a run of the first controller that adapts, over its first three hundred cycles."""
    task = fp.load_problem(name)
    controller = next(c for c in task.controllers.values() if c.deformation.adapts)
    short = replace(task.problem, duration=min(task.problem.duration, 300 * task.problem.period), measure_from=0.0)
    run, ranges = fp.simulate(short, controller, seed=0, compiled=False), plausible_range(task.problem)
    shown = [column for column in ranges if column in run.layout.columns]
    assert shown
    for column in shown:
        values = run.log[:, run.layout.columns.index(column)]
        assert ranges[column][0] < values.min()
        assert values.max() < ranges[column][1]
