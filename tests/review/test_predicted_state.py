"""A prediction by a model that lacks a force: its error in closed form, and what the review says of it."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.contracts import Controller, Deformation

RATE, PERIOD, FORCE = 3.0, 0.01, 1.0  # 1/s, s, m/s^2
KP, KD = RATE**2, 2 * RATE


def mass(late: float) -> fp.Problem:
    """A mass that a force pushes of which the model knows nothing, to be held at rest."""
    force = {"w": fp.Parameter(0.0, FORCE, "m/s^2")}
    plant = fp.Plant({"q": "m"}, {"u": "m/s^2"}, force, lambda q, v, u, p: {"q": u.u - p.w})
    rest, lasts = fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(0 * t)}), {"duration": 12.0, "measure_from": 10.0}
    return fp.Problem(plant, rest, {"q": 0.1}, PERIOD, **lasts, dead_time=fp.DeadTime(inputs={"u": late}))


def law(late: float, form: Deformation | None = None, **by: Any) -> Controller:
    tracking = fp.Exponential(RATE, integral=False)
    plain = fp.ComputedTorque(tracking) if form is None else fp.ComputedTorque(tracking, form)
    return fp.Predicted(plain, inputs=late, **by)


FORM = fp.ModelReferenced(fp.Affine(gain=-0.4))


@pytest.mark.parametrize("late", [0.03, 0.08])
@pytest.mark.parametrize(
    ("form", "by", "removed"),
    [(None, {}, 0.0), (FORM, {}, 1.0), (FORM, {"by": "desired"}, 2.0), (FORM, {"residual_time": 0.1}, 2.0)],
    ids=["no adaptation", "adaptation", "what is desired", "a residual"],
)
def test_what_the_model_lacks_is_lacking_in_the_prediction(late, form, by, removed):
    """The error is w (1 + kd t + kp t^2 / 2) / kp; adaptation takes w / kp from it, another prediction the rest.

    A residual alone leaves w / kp, more than the first error, so that it is no advice without adaptation.
    """
    problem = mass(late)
    run = fp.simulate(problem, law(late, form, **by), seed=0, compiled=False)
    expected = [FORCE / KP * (1 + KD * late + KP * late**2 / 2), FORCE / KP * (KD * late + KP * late**2 / 2), 0.0]
    assert run["true_error.q"][-1] == pytest.approx(expected[int(removed)], rel=0.01, abs=1e-6)
    told = {a.key: a for a in fp.review(problem, {"it": law(late, form, **by)}, mismatch=0.0, seed=0).answers["it"]}
    assert (f"residual_time={late:g})" in told["follows"].change) == (form is not None and not by)
    free = replace(problem, plant=replace(problem.plant, parameters={}, response=lambda q, v, u, p: {"q": u.u}))
    assert abs(fp.simulate(free, law(late, form, **by), seed=0, compiled=False)["true_error.q"][-1]) < 1e-6
    said = " ".join(a.change for a in told.values())
    assert not [words for words in ("state it", "state the dead", "predict it") if words in said]


def test_errors_of_a_body_outside_are_those_of_now():
    """A body that shows no response: what the controller follows is the reference ahead, and errors count from that of now."""

    class Body:
        def reset(self, _seed):
            self.state = np.array([0.0, 1.0])
            return self.state

        def step(self, _time, command):
            q, v = self.state
            self.state = np.array([q + PERIOD * v + PERIOD**2 / 2 * command[0], v + PERIOD * command[0]])
            return self.state

    body = fp.ExternalPlant(Body(), measures={"q": "m", "q'": "m/s"})
    seen = fp.Sensing(estimator=fp.VelocityDifference())
    motion = {"reference": fp.Trajectory(lambda t: {"q": ca.sin(t)}), "start": {"q": 0.0, "q'": 1.0}}
    problem = replace(mass(0.0).with_exact(np.zeros(1)), reality=body, sensing=seen, **motion)
    run = fp.simulate(problem, law(0.08, by="desired"), seed=0, compiled=False)
    np.testing.assert_allclose(run["true_error.q"], np.sin(run.time) - run["state.q"], atol=1e-12)
    assert np.abs(run["reference.q"] - np.sin(run.time + 0.08)).max() < 1e-12
