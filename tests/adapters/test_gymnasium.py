"""Gymnasium's pendulum behind a model with another mass."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.adapters.gymnasium import gymnasium_body
from fpirhc.errors import InvalidProblem

gymnasium: Any = pytest.importorskip("gymnasium", reason="it needs the extra fpirhc[outside]")

MEASURES: dict[str, int | Callable[[Any], float]] = {"th": lambda seen: np.arctan2(seen[1], seen[0]), "th'": 2}
# Gymnasium's own equation: th'' = 3 g / (2 l) sin(th) + 3 / (m l^2) u, th = 0 upright.
PENDULUM = fp.Plant(
    {"th": "rad"},
    {"u": "N m"},
    {"m": fp.Parameter(approximate=1.6, exact=1.0, unit="kg")},
    lambda q, v, u, p: {"th": 15 * ca.sin(q.th) + 3 / p.m * u.u},
)


def problem(reality: fp.ExternalPlant, period: float) -> fp.Problem:
    return fp.Problem(
        plant=PENDULUM,
        reality=reality,
        sensing=fp.Sensing(estimator=fp.VelocityDifference()),
        reference=fp.Trajectory(lambda t: {"th": 0.8 * ca.sin(t)}),
        start={"th": 0.0},
        period=period,
        duration=20.0,
        measure_from=5.0,
        limits=fp.Limits(inputs={"u": (-40.0, 40.0)}),
    )


def swinging(gain: float) -> tuple[fp.Problem, fp.Run]:
    env = gymnasium.make("Pendulum-v1", max_episode_steps=10_000)
    env.unwrapped.max_torque, env.unwrapped.max_speed = 40.0, 100.0
    env.unwrapped.action_space = env.action_space = gymnasium.spaces.Box(-40, 40, (1,))
    task = problem(gymnasium_body(env, PENDULUM, measures=MEASURES), period=0.05)
    law = fp.ComputedTorque(fp.Exponential(rate=3.0), fp.ModelReferenced(fp.Affine(gain=gain)))
    return task, fp.simulate(task, law, seed=3, compiled=False)


def test_adaptation_pays_behind_a_wrong_mass():
    errors = [fp.measure(*swinging(gain)).rms_error["th"] for gain in (-1e-6, -0.3)]
    assert errors[1] < 0.4 * errors[0]


def test_a_time_step_that_is_written_is_compared_with_the_period():
    """An environment does not state it, and runs with any period."""
    body = gymnasium_body(gymnasium.make("Pendulum-v1"), PENDULUM, measures=MEASURES)
    with pytest.raises(InvalidProblem, match=r"one step of it takes 0\.05, and the problem's period is 0\.1"):
        problem(dataclasses.replace(body, period=0.05), period=0.1)


def test_a_run_ends_by_name_where_the_episode_ends():
    class Ends(gymnasium.Wrapper):  # type: ignore[misc]
        def step(self, action):
            seen, reward, _, truncated, info = super().step(action)
            return seen, reward, True, truncated, info

    body = gymnasium_body(Ends(gymnasium.make("Pendulum-v1")), PENDULUM, measures=MEASURES)
    body.first(0)
    assert "the environment ended its episode at 0.1" in body.read(0.1, np.array([0.0])).mistake


def test_mistakes_are_named():
    env = gymnasium.make("CartPole-v1")
    with pytest.raises(InvalidProblem) as caught:
        gymnasium_body(env, PENDULUM, measures={"th": 4, "thh": 0})
    text = str(caught.value)
    assert "measures: quantity 'thh' is unknown. Did you mean 'th'?" in text
    assert "the environment takes actions Discrete(2), the model has the inputs u" in text
    assert "th is entry 4 of the observation, which has 4 entries, 0 to 3" in text
