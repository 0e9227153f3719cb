"""Certificates of limits: no plant of the box leaves what they state, and the laws of the proof hold in the loop."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import casadi as ca
import certificate as certified
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidName, InvalidProblem, InvalidValue, NotSupported


@cache
def task(name):
    return certified.task(name)


@cache
def certificate(name):
    case = certified.LOOPS[name]
    return fp.certify_limits(*task(name), mismatch=case.mismatch, pieces=case.pieces)


@pytest.mark.parametrize(
    "name", ["body", "tanks", *(pytest.param(n, marks=pytest.mark.slow) for n in ("arm", "quadrotor"))]
)
def test_no_plant_of_the_box_leaves_its_certificate(name):
    """The plants run in a loop in numpy that is that of `simulate`; with three quarters of the bound of errors some leave."""
    stated = certificate(name)
    assert stated.holds, stated
    plants = certified.drawn(stated.box, 100)
    found = certified.runs(name, stated, plants)
    assert not certified.violating(stated, found).any()
    narrow = replace(stated, error={n: 0.75 * e for n, e in stated.error.items()})
    assert certified.violating(narrow, found).any()
    run = fp.simulate(stated.problem.with_exact(plants[0]), stated.controller, seed=0)
    assert np.abs(run["state"] - found[0][:-1, :, 0]).max() < 1e-12
    assert np.abs(run["command"] - found[1][:, :, 0]).max() < 1e-11


def test_plans_with_room_do_not_depend_on_the_plant():
    """Bit by bit, also where the commands differ; without a stated room they have what the deformation leaves."""
    problem, controller = task("tanks")
    problem = replace(problem, duration=1.0)
    other = problem.with_exact(1.04 * problem.plant.exact)
    one, two = (fp.simulate(p, controller, seed=0) for p in (problem, other))
    assert np.abs(one["command"] - two["command"]).max() > 1e-3
    for name in ("planned", "target", "nominal"):
        assert np.array_equal(one[name], two[name])
    assert np.abs(one["planned.Q1"]).max() <= 4.0 - 0.8 + 1e-9
    without = replace(controller, room=None)
    one, two = (fp.simulate(p, without, seed=0) for p in (problem, other))
    assert not np.array_equal(one["planned"], two["planned"])


def pushed(
    period: float = 0.01, gain: float = 1.0, force: Any = lambda q, v: 3.0 * q**3
) -> tuple[fp.Problem, fp.ComputedTorque]:
    """A mass with a force on it that follows a sine, with a limit of its speed."""
    plant = fp.Plant(
        coordinates={"q": "m"},
        inputs={"F": "N"},
        response=lambda q, v, u, p: {"q": (u.F - force(q.q, v.q)) / p.m},
        parameters={"m": fp.Parameter(1.3, 1.0, "kg")},
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"q": ca.sin(t)}),
        start={"q": 0.0, "q'": 1.0},
        period=period,
        duration=3.0,
        limits=fp.Limits(inputs={"F": (-10.0, 10.0)}, states={"q'": (-1.1, 1.1)}),
    )
    return problem, fp.ComputedTorque(fp.Exponential(5.0, integral=False), fp.ModelReferenced(fp.Affine(-2 * gain)))


def test_a_reference_is_certified_too_and_the_tube_vanishes_with_the_period():
    """The bounds are of the order of the period, and tend to half of them with half of it."""
    tubes = []
    for period in (0.01, 0.005, 0.0025):
        stated = fp.certify_limits(*pushed(period), mismatch=5)
        assert stated.holds, stated
        assert len(stated.lower) == round(3.0 / period)  # every cycle of the run, to its end
        tubes.append(stated.tube["q'"])
    assert all(0.35 < later / before < 0.55 for before, later in pairwise(tubes))


FORCES: dict[str, Any] = {
    "polynomial": lambda q, v: q**3 - 2 * q * v + v**2,
    "quotient": lambda q, v: (1 + q * v) / (3 + v**2),
    "circular": lambda q, v: ca.sin(q) * ca.cos(v) + ca.tan(0.3 * q) + ca.atan(v),
    "exponential": lambda q, v: ca.exp(q) * ca.log(5 + v) + ca.tanh(v),
    "roots": lambda q, v: ca.sqrt(4 + q) + 0.2 * (5 + v) ** 1.5 + (4 + q) ** -2,
    "power of two arguments": lambda q, v: (4 + q) ** (0.3 * v),
    "sides": lambda q, v: ca.fabs(3 + q) + ca.fmax(q, v + 6) - ca.if_else(v < 5, ca.fmin(q, v + 6), 2) - 5,
    "flow": lambda q, v: fp.signed_power(3 + q - 0.5 * v, 0.5),
}


@pytest.mark.parametrize("name", FORCES)
def test_no_plant_leaves_its_certificate_whatever_its_force_is(name):
    """Every operation that an enclosure has a rule for, over sixteen plants of the box, its corners among them."""
    stated = fp.certify_limits(*pushed(force=FORCES[name]), mismatch=4)
    assert stated.lower.shape == stated.upper.shape == (300, 2)
    low, high = stated.commands["F"]
    for plant in certified.drawn(stated.box, 16):
        run = fp.simulate(stated.problem.with_exact(plant), stated.controller, seed=0, compiled=False)
        assert (run["state"] >= stated.lower - 1e-9).all()
        assert (run["state"] <= stated.upper + 1e-9).all()
        assert low - 1e-9 <= run["command"].min() <= run["command"].max() <= high + 1e-9
    assert (stated.upper - stated.lower).max() < 1.0  # the bounds say something


def test_a_force_that_may_jump_has_no_bounds_and_one_without_a_rule_is_named():
    """A derivative does not contain the jump, so a bound by derivatives would be false."""
    assert not fp.certify_limits(*pushed(force=lambda q, v: 0.1 * ca.sign(q)), mismatch=4).holds
    with pytest.raises(NotSupported, match="operation without a rule"):
        fp.certify_limits(*pushed(force=lambda q, v: ca.erf(q)), mismatch=4)


def test_a_smaller_box_has_a_narrower_tube_and_pieces_have_too():
    wide, narrow = (fp.certify_limits(*pushed(), mismatch=m).tube["q"] for m in (8, 4))
    assert 0.35 < narrow / wide < 0.5
    assert fp.certify_limits(*pushed(), mismatch=8, pieces=2).tube["q"] < 0.6 * wide


def test_bounds_that_do_not_close_are_refused():
    """The third level has no input: in one piece its bounds feed those of the flows, and grow without end."""
    problem, controller = task("tanks")
    stated = fp.certify_limits(replace(problem, duration=3.0), controller, mismatch=8)
    assert "the bounds do not close" in stated.failures[0]
    assert "of 'h3' first" in stated.failures[0]
    assert not stated.holds
    assert not stated.error


def limited(**limits):
    problem, controller = pushed()
    return replace(problem, limits=fp.Limits(**limits)), controller


@pytest.mark.parametrize(
    ("loop", "mismatch", "words"),
    [
        (limited(inputs={"F": (-2.0, 10.0)}, states={"q'": (-0.9, 0.9)}), 5, r"may pass its limits \(-0.9, 0.9\) by"),
        (limited(inputs={"F": (-1.0, 1.0)}), 5, "clips a command at t = "),
        (pushed(gain=1.5), 10, "need not contract"),  # 1.5 * 1.3 / 0.9 is above 2
    ],
)
def test_what_fails_is_named(loop, mismatch, words):
    with pytest.raises(AssertionError, match=words):
        assert not fp.certify_limits(*loop, mismatch=mismatch).failures


def test_what_else_the_theorem_does_not_cover_is_refused():
    problem, controller = pushed()
    tanks, planned = task("tanks")
    with pytest.raises(NotSupported, match="disturbances"):
        fp.certify_limits(replace(problem, disturbances={"q": fp.Noise(0.1)}), controller, mismatch=5)
    with pytest.raises(NotSupported, match="exact parameters of every plant"):
        fp.certify_limits(problem, fp.ExactModel(controller), mismatch=5)
    rated = replace(problem, limits=fp.Limits(inputs={"F": (-10.0, 10.0)}, rates={"F": (-50.0, 50.0)}))
    with pytest.raises(NotSupported, match="hard limits of rates"):
        fp.certify_limits(rated, controller, mismatch=5)
    for ways, words in (({"tracking": None, "room": None}, "tracking=law"), ({"room": None}, "depend on the plant")):
        with pytest.raises(NotSupported, match=words):
            fp.certify_limits(tanks, replace(planned, **ways), mismatch=5)
    for room, words, error in (
        ({"Q3": 1.0}, "'Q3' is unknown", InvalidName),
        ({"Q1": 2.0}, "leaves nothing", InvalidProblem),
    ):
        with pytest.raises(error, match=words):
            replace(planned, room=room).check(tanks)
    with pytest.raises(InvalidValue, match="room"):
        replace(planned, room={"Q1": -1.0})
    with pytest.raises(InvalidProblem, match="give the law"):
        replace(planned, tracking=None).check(tanks)
