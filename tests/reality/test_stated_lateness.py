"""Dead time and lag that an external plant states: known to the model-referenced form and to reviews, and not simulated.

The law: where the body is the model behind a dead time or a lag, the form that follows the statement deforms next to nothing.
"""

from __future__ import annotations

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.contracts import Deformation
from fpirhc.controllers.contract import resolved
from fpirhc.errors import InvalidProblem

PERIOD, LATE, LAG = 1e-2, 3, 0.05


class Cart:
    """x'' = what was commanded, three cycles ago, behind a lag; exact for a held command."""

    def __init__(self, late: int = 0, lag: float = 0.0) -> None:
        self.late, self.lag = late, lag

    def reset(self, seed):
        del seed
        self.waiting, self.x, self.v, self.u = [0.0] * self.late, 0.0, 0.0, 0.0
        return [0.0, 0.0, 0.0]

    def step(self, time, command):
        del time
        self.waiting.append(float(command[0]))
        wanted, before = self.waiting.pop(0), self.v
        steps = 200
        for _ in range(steps):
            h = PERIOD / steps
            start = self.u
            self.u = wanted + (self.u - wanted) * math.exp(-h / self.lag) if self.lag else wanted
            mean = (start + self.u) / 2 if self.lag else wanted
            self.x += h * self.v + h * h / 2 * mean
            self.v += h * mean
        return [self.x, self.v, (self.v - before) / PERIOD]


MODEL = fp.Plant(
    coordinates={"x": "m"},
    inputs={"u": "m/s^2"},
    parameters={"b": fp.Parameter(approximate=1.0, exact=1.0, unit="1")},
    response=lambda _q, _v, u, p: {"x": p.b * u.u},
)
FORM = fp.ModelReferenced(fp.Affine(gain=-1.0))


def problem(**facts) -> fp.Problem:
    body = Cart(round(facts.get("dead_time", {}).get("u", 0.0) / PERIOD), facts.get("lag", {}).get("u", 0.0))
    return fp.Problem(
        plant=MODEL,
        reality=fp.ExternalPlant(body, measures={"x": "m", "x'": "m/s", "x''": "m/s^2"}, **facts),
        reference=fp.Trajectory(lambda t: {"x": 1 - ca.cos(2 * t)}),
        start={"x": 0.0},
        period=PERIOD,
        duration=3.0,
        limits=fp.Limits(inputs={"u": (-50.0, 50.0)}),
    )


def law(form: Deformation) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate=3.0, integral=False), form)


def believed(one: fp.Problem, form: fp.ModelReferenced) -> tuple[object, object]:
    """Cycles and lag of the form in use."""
    mirror = resolved(one, law(form)).deformation.mirror
    assert mirror is not None
    return mirror.cycles, mirror.lag


def deformation(one: fp.Problem, form: fp.ModelReferenced) -> float:
    """Largest difference between request and desired response."""
    run = fp.simulate(one, law(form), seed=0, compiled=False)
    assert run.stop is None
    return float(np.abs(run["deformed"] - run["desired"]).max())


@pytest.mark.parametrize("facts", [{"dead_time": {"u": LATE * PERIOD}}, {"lag": {"u": LAG}}], ids=["dead time", "lag"])
def test_an_exact_model_is_left_alone_behind_what_the_body_states(facts):
    """The form that knows of nothing deforms what needs no deformation."""
    one = problem(**facts)
    unknowing = fp.ModelReferenced(FORM.map, cycles=0.0, lag=0.0)
    assert deformation(one, FORM) < 0.06 * deformation(one, unknowing)


def test_the_statement_becomes_the_forms_numbers():
    one = problem(dead_time={"u": LATE * PERIOD}, lag={"u": LAG})
    assert believed(one, FORM) == (pytest.approx(LATE), LAG)
    assert believed(one, fp.ModelReferenced(FORM.map, cycles=1.0, lag=0.0)) == (1.0, 0.0)
    assert one.dead_time.inputs == {"u": LATE * PERIOD}


def test_a_form_inside_wrappers_is_told_too():
    inside = fp.Estimating(
        law(FORM), fp.DisturbanceKalman(drift={"x": 1.0}, measured={"x": 0.1, "x'": 0.1, "x''": 0.1})
    )
    mirror = resolved(problem(lag={"u": LAG}), inside).deformation.mirror
    assert mirror is not None
    assert mirror.lag == LAG


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"lag": {"v": 0.1}}, "input 'v' is unknown"),
        ({"lag": {"u": -0.1}}, r"lag\['u'\]: expected a finite number of at least 0, got -0.1"),
        ({"lag": {"u": math.inf}}, r"lag\['u'\]: .*got inf"),
        ({"lag": {"u": "slow"}}, "lag"),
        ({"dead_time": {"v": 0.1}}, "'v'"),
    ],
)
def test_a_wrong_statement_is_named(facts, words):
    with pytest.raises((InvalidProblem, fp.FpirhcError), match=words.replace("(", r"\(")):
        replace(problem(), reality=fp.ExternalPlant(Cart(), measures={"x": "m", "x'": "m/s", "x''": "m/s^2"}, **facts))
