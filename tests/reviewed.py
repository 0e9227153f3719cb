"""A mass whose model is too heavy, and the answers of its review by question."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from plants import heavy

import fpirhc as fp
from fpirhc.simulation.linearise.linear_loop import LinearCycle, LinearLoop

PERIOD = 1e-3  # s


def mass(**settings) -> fp.Problem:
    """M q'' = u - k q, the model's mass 1.5 times too large."""
    sine = fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(3 * t)})
    usual: dict[str, Any] = {"reference": sine, "start": {"q": 0.0}, "period": PERIOD, "duration": 4.0}
    return fp.Problem(**({"plant": heavy(1.5, 1.0, (6.0, 10.0))} | usual | settings))


def torque(gain: float = -0.5, rate: float = 6.0, scale: float = 20.0) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate=rate), fp.Sigmoid(gain=gain, scale=scale))


def answers(problem: fp.Problem, controller=None, mismatch: float = 0.0) -> dict[str, fp.Answer]:
    """All answers by question."""
    controllers = {"it": torque() if controller is None else controller}
    return {a.question: a for a in fp.review(problem, controllers, mismatch=mismatch, seed=0).answers}


def about(result: dict[str, fp.Answer], words: str) -> fp.Answer:
    [question] = [q for q in result if words in q]
    return result[question]


def linear(dynamics: Any, entry: Any, arriving: Any, state: Any, period: float) -> LinearLoop:
    """A linear loop of one cycle by its matrices, with the numbers of the plant's states among its entries; every mode counts."""
    shown = np.eye(len(dynamics))[list(state)]
    cycle = LinearCycle(np.asarray(dynamics), np.asarray(entry), np.asarray(arriving), shown)
    return LinearLoop((cycle,), np.zeros((0, len(dynamics))), shown.T, period)
