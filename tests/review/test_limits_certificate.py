"""Certificates of limits: no plant of the box leaves what they state, and the laws of the proof hold in the loop.

Plants are run by an independent loop in numpy, many at a time; it agrees with `fp.simulate` to rounding.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from itertools import pairwise

import casadi as ca
import certificate as certified
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidName, InvalidProblem, InvalidValue, NotSupported
from fpirhc.review.limits_certificate import LimitsCertificate
from fpirhc.simulation.model_as_plant import exactly

DURATIONS = {"body": 1.0, "arm": 1.0, "tanks": 1.5, "quadrotor": 0.5}


def law(rate: float) -> fp.Exponential:
    return fp.Exponential(rate, integral=False)


@cache
def task(name: str) -> tuple[fp.Problem, fp.RecedingHorizon]:
    return certified.task(name, certified.LOOPS[name].periods[0], DURATIONS[name])


@cache
def certificate(name: str) -> LimitsCertificate:
    case = certified.LOOPS[name]
    return fp.certify_limits(*task(name), mismatch=case.mismatch, pieces=case.pieces)


@cache
def mapped(function: ca.Function, count: int) -> ca.Function:
    return function.map(count)


def of(function: ca.Function, *columns: np.ndarray) -> np.ndarray:
    return np.asarray(mapped(function, columns[0].shape[1])(*columns).full())


def runs(name: str, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (cycles + 1, nx, plants), commands and response errors of many plants; plans are those of one run."""
    problem, _ = task(name)
    case, plant, equations = certified.LOOPS[name], problem.plant, problem.plant.equations
    plans = fp.simulate(problem, certificate(name).controller, seed=0)
    targets = np.vstack([problem.start_state, plans["target"][:-1]])
    gains = np.zeros((len(plant.controlled_names), plant.state.size))
    for row, coordinate in zip(gains, plant.controlled_names, strict=True):
        order = dict(zip(plant.names, plant.orders, strict=True))[coordinate]
        for j, gain in enumerate((case.rate,) if order == 1 else (case.rate**2, 2 * case.rate)):
            row[plant.state.elements.index(coordinate + "'" * j)] = gain
    exact, believed = parameters.T, np.tile(plant.approximate[:, None], len(parameters))
    x, period, deformation = np.tile(problem.start_state[:, None], len(parameters)), problem.period, 0.0
    u = np.zeros((len(plant.inputs), len(parameters)))
    states, commands, errors = [x], [], []
    for k, (target, nominal) in enumerate(zip(targets, plans["nominal"], strict=True)):
        desired = nominal[:, None] + gains @ (target[:, None] - x)
        if k:
            response, modelled = (of(equations.controlled_response, x, u, p) for p in (exact, believed))
            deformation = deformation - case.gain * (response - modelled + deformation)
        u = of(equations.inverse, x, desired + deformation, believed)
        errors.append(of(equations.controlled_response, x, u, exact) - desired)
        slopes = [of(equations.rate, x, u, exact)]
        for share in (0.5, 0.5, 1.0):
            slopes.append(of(equations.rate, x + share * period * slopes[-1], u, exact))
        x = x + period / 6 * (slopes[0] + 2 * slopes[1] + 2 * slopes[2] + slopes[3])
        states.append(x)
        commands.append(u)
    return np.array(states), np.array(commands), np.array(errors)


def drawn(name: str, count: int) -> np.ndarray:
    """Parameters in the box, a quarter of them at its corners."""
    ends = np.array(list(certificate(name).box.values()))
    random = np.random.default_rng(0)
    shares = random.uniform(size=(count, len(ends)))
    shares[: count // 4] = shares[: count // 4] > 0.5
    return ends[:, 0] + shares * (ends[:, 1] - ends[:, 0])


def stays_inside(name: str, count: int) -> None:
    """No plant leaves what the certificate states, one reaches half of the error, and the loop is that of `simulate`."""
    stated, (problem, _) = certificate(name), task(name)
    assert stated.holds, stated
    plants = drawn(name, count)
    states, commands, errors = runs(name, plants)
    cycles = len(stated.lower)
    rounding = 1e-9  # of the integrators: the theorem is about the exact motion
    least, most = problem.limits.state_bounds(problem.plant)
    for rows in (states[:cycles], states[1 : cycles + 1]):  # both ends of every cycle
        assert (rows >= stated.lower[:, :, None] - rounding).all()
        assert (rows <= stated.upper[:, :, None] + rounding).all()
        assert ((rows >= least[:, None]) & (rows <= most[:, None])).all()
    low, high = np.array(list(stated.commands.values())).T
    assert ((commands >= low[:, None] - rounding) & (commands <= high[:, None] + rounding)).all()
    reached = np.abs(errors).max((0, 2)) / np.array(list(stated.error.values()))
    assert reached.max() <= 1 + rounding
    assert reached.max() > 0.5  # so the tests above can fail
    other = replace(problem, plant=exactly(problem.plant, plants[0]))
    run = fp.simulate(other, stated.controller, seed=0)
    assert np.abs(run["state"] - states[:-1, :, 0]).max() < 1e-12
    assert np.abs(run["command"] - commands[:, :, 0]).max() < 1e-11


@pytest.mark.parametrize(
    ("name", "plants"),
    [(name, 100) for name in ("body", "tanks")]
    + [pytest.param(name, 10_000, marks=pytest.mark.slow) for name in DURATIONS],
)
def test_no_plant_of_the_box_leaves_its_certificate(name, plants):
    stays_inside(name, plants)


def test_plans_with_room_do_not_depend_on_the_plant():
    """Bit by bit, also where the commands differ; without a stated room they have what the deformation leaves."""
    problem, controller = task("tanks")
    problem = replace(problem, duration=1.0)
    other = replace(problem, plant=exactly(problem.plant, 1.04 * problem.plant.exact))
    one, two = (fp.simulate(p, controller, seed=0) for p in (problem, other))
    assert np.abs(one["command"] - two["command"]).max() > 1e-3
    for name in ("planned", "target", "nominal"):
        assert np.array_equal(one[name], two[name])
    assert np.abs(one["planned.Q1"]).max() <= 4.0 - 0.4 + 1e-9
    without = replace(controller, replanning=fp.FromPlan(law(4.0)))
    one, two = (fp.simulate(p, without, seed=0) for p in (problem, other))
    assert not np.array_equal(one["planned"], two["planned"])


def pushed(period: float = 0.01, gain: float = 1.0, exact: float = 1.0) -> tuple[fp.Problem, fp.ComputedTorque]:
    """A mass on a spring that follows a sine, with a limit of its speed."""
    plant = fp.Plant(
        coordinates={"q": "m"},
        inputs={"F": "N"},
        response=lambda q, v, u, p: {"q": (u.F - 3.0 * q.q**3) / p.m},
        parameters={"m": fp.Parameter(1.3, exact, "kg")},
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"q": ca.sin(t)}),
        start={"q": 0.0, "q'": 1.0},
        period=period,
        duration=3.0,
        limits=fp.Limits(inputs={"F": (-10.0, 10.0)}, states={"q'": (-1.1, 1.1)}),
    )
    return problem, fp.ComputedTorque(law(5.0), fp.ModelReferenced(fp.Affine(-2 * gain)))


def test_a_reference_is_certified_too_and_the_tube_vanishes_with_the_period():
    """The bounds are of the order of the period, and tend to half of them with half of it."""
    tubes = []
    for period in (0.01, 0.005, 0.0025):
        stated = fp.certify_limits(*pushed(period), mismatch=5)
        assert stated.holds, stated
        assert len(stated.lower) == round(3.0 / period)  # every cycle of the run, to its end
        tubes.append(stated.tube["q'"])
    assert all(0.35 < later / before < 0.55 for before, later in pairwise(tubes))


def test_bounds_that_do_not_close_are_refused():
    """The third level has no input: in one piece its bounds feed those of the flows, and grow without end."""
    problem, controller = task("tanks")
    stated = fp.certify_limits(replace(problem, duration=3.0), controller, mismatch=8)
    assert "the bounds do not close" in stated.failures[0]
    assert "of 'h3' first" in stated.failures[0]
    assert not stated.holds
    assert not stated.error


def test_margins_of_a_controller_are_kept_and_widened():
    """Those that it has are the least; only limits that may be passed need more."""
    problem, controller = task("body")
    own = replace(controller, margins={"w1": (0.05,) * 30, "w2": (0.0,) * 30})
    stated = fp.certify_limits(replace(problem, duration=1.0), own, mismatch=5)
    assert stated.holds
    planner = stated.controller.planner
    assert planner is not None
    assert planner.margins is not None
    assert min(planner.margins["w1"]) >= 0.05
    assert max(planner.margins["w2"]) < 0.05


def test_what_fails_is_named_with_its_amount():
    problem, controller = pushed()
    narrow = replace(problem, limits=fp.Limits(inputs={"F": (-2.0, 10.0)}, states={"q'": (-0.9, 0.9)}))
    stated = fp.certify_limits(narrow, controller, mismatch=5)
    assert not stated.holds
    assert "may pass its limits (-0.9, 0.9) by" in " ".join(stated.failures)
    clipped = replace(problem, limits=fp.Limits(inputs={"F": (-1.0, 1.0)}))
    assert "clips a command at t = " in fp.certify_limits(clipped, controller, mismatch=5).failures[0]
    low, high = fp.certify_limits(problem, controller, mismatch=20).commands["F"]
    tight = replace(problem, limits=fp.Limits(inputs={"F": (low + 0.1, high)}))
    assert re.search("input 'F' may need .* by 0.1;", fp.certify_limits(tight, controller, mismatch=20).failures[0])
    fast = fp.certify_limits(*pushed(gain=1.5), mismatch=10)  # 1.5 * 1.3 / 0.9 is above 2
    assert "need not contract" in fast.failures[0]
    assert "fails: the iteration" in repr(fast)


def test_a_smaller_box_has_a_narrower_tube_and_pieces_have_too():
    task_ = pushed()
    wide, narrow = (fp.certify_limits(*task_, mismatch=m).tube["q"] for m in (8, 4))
    assert 0.35 < narrow / wide < 0.5
    pieces = fp.certify_limits(*task_, mismatch=8, pieces=2)
    assert pieces.tube["q"] < 0.6 * wide


def test_what_the_theorem_does_not_cover_is_refused():
    problem, controller = pushed()
    referenced = fp.ModelReferenced(fp.Affine(-2.0))
    refused = {
        "must not integrate": replace(controller, tracking=fp.Exponential(5.0)),
        "must be ModelReferenced": replace(controller, deformation=fp.Affine(-2.0)),
        "without dead time, lag or filter": replace(controller, deformation=replace(referenced, lag=0.1)),
    }
    refused["without dead time"] = replace(
        controller, deformation=fp.ModelReferenced(fp.Filtered(fp.Affine(-2.0), pole=0.5))
    )
    for words, one in refused.items():
        with pytest.raises(NotSupported, match=words):
            fp.certify_limits(problem, one, mismatch=5)
    with pytest.raises(NotSupported, match="disturbances"):
        fp.certify_limits(replace(problem, disturbances={"q": fp.Noise(0.1)}), controller, mismatch=5)
    with pytest.raises(NotSupported, match="exact parameters of every plant"):
        fp.certify_limits(problem, fp.ExactModel(controller), mismatch=5)
    tanks, planned = task("tanks")
    with pytest.raises(NotSupported, match="FromPlan"):
        fp.certify_limits(tanks, replace(planned, replanning=fp.FromMeasurement()), mismatch=5)
    with pytest.raises(NotSupported, match="depend on the plant"):
        fp.certify_limits(tanks, replace(planned, replanning=fp.FromPlan(law(4.0))), mismatch=5)
    with pytest.raises(InvalidName, match="room of input 'Q3' is unknown"):
        replace(planned, replanning=fp.FromPlan(law(4.0), room={"Q3": 1.0})).check(tanks)
    with pytest.raises(InvalidProblem, match="leaves nothing of input 'Q1'"):
        replace(planned, replanning=fp.FromPlan(law(4.0), room={"Q1": 2.0})).check(tanks)
    with pytest.raises(InvalidValue, match="room"):
        fp.FromPlan(law(4.0), room={"Q1": -1.0})
