"""A mass whose model is too heavy, and the answers of its review by their keys."""

from __future__ import annotations

from typing import Any

import casadi as ca

import fpirhc as fp
from fpirhc.contracts import Controller
from helpers.plants import heavy

PERIOD = 1e-3  # s


def mass(**settings) -> fp.Problem:
    """M q'' = u - k q, the model's mass 1.5 times too large."""
    sine = fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(3 * t)})
    usual: dict[str, Any] = {"reference": sine, "start": {"q": 0.0}, "period": PERIOD, "duration": 4.0}
    return fp.Problem(**({"plant": heavy(1.5, 1.0, (6.0, 10.0))} | usual | settings))


def torque(gain: float = -0.5, rate: float = 6.0, scale: float = 20.0) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate=rate), fp.Sigmoid(gain=gain, scale=scale))


def answers(problem: fp.Problem, controller: Controller | None = None, mismatch: float = 0.0) -> dict[str, Any]:
    """All answers about the problem and one controller."""
    found = fp.review(problem, {"it": controller or torque()}, mismatch=mismatch, seed=0).answers
    return {a.key: a for some in found.values() for a in some}
