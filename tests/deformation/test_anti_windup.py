"""What anti-windup buys: a step of 2 m with a weak actuator, and the same loop with either of its two measures taken out.

The measures: what a clipped command means becomes the stored request of the deformation, and the integral of the error does not
grow into a limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.contracts import Block, Delay

LARGEST = 20.0  # N


def duffing():
    """A soft Duffing oscillator whose model is half as heavy again and has springs and damping too weak by half."""
    return fp.Plant(
        coordinates={"q": "m"},
        inputs={"u": "N"},
        parameters={
            "m": fp.Parameter(approximate=1.5, exact=1.0, unit="kg"),
            "k": fp.Parameter(approximate=0.3, exact=0.5, unit="N/m"),
            "l": fp.Parameter(approximate=0.05, exact=0.1, unit="N/m^3"),
            "b": fp.Parameter(approximate=0.2, exact=0.5, unit="N s/m"),
        },
        response=lambda q, v, u, p: {"q": (u.u - p.k * q.q - p.l * q.q**3 - p.b * v.q) / p.m},
    )


@dataclass(frozen=True)
class Altered(fp.ComputedTorque):
    """Computed torque with changes made to its blocks and delays."""

    changes: tuple[Any, ...] = ()

    def blocks(self, problem):
        parts = super().blocks(problem)
        for change in self.changes:
            parts = change(*parts)
        return parts


def request_kept(blocks, delays):
    """Store what the deformation wanted, whatever the actuator could do."""
    return blocks, [Delay(d.now, "_deformed_unclipped") if d.now.name == "_deformed_last" else d for d in delays]


def integral_runs(blocks, delays):
    """Integrate the error also where it goes further into a limit."""
    update = blocks[-1]

    def step(s):
        s._cut_off = 0 * s._cut_off
        return update.step(s)

    return [*blocks[:-1], Block(update.name, update.reads, update.writes, step)], delays


def step_of_two_metres(*changes, bumpless=False, deformation=None, largest=()):
    """Run from rest at 0 m to 2 m, where 1.8 N hold the plant."""
    problem = fp.Problem(
        plant=duffing(),
        reference=fp.Trajectory(lambda t: {"q": 2 + 0 * t}),
        start={"q": 0.0},
        period=1e-3,
        duration=10.0,
        limits=fp.Limits(inputs={"u": (-LARGEST, LARGEST)}),
    )
    law, sigmoid = fp.Exponential(rate=6.0, bumpless=bumpless, largest=largest), fp.Sigmoid(gain=-0.5, scale=20.0)
    return fp.simulate(problem, Altered(law, deformation or sigmoid, changes), seed=0)


def overshoot(run):
    return max(0.0, -float(run["error.q"].min()))


def settled(run):
    """Time after which the error stays below 2 cm, s."""
    outside = np.flatnonzero(np.abs(run["error.q"]) > 0.02)
    return run.time[outside[-1]] + run.period


def test_with_both_the_step_settles():
    """The step asks for 324 N at first and has 20; it overshoots by a tenth, settles, and the request stays reachable."""
    run = step_of_two_metres()
    assert run["command_unclipped.u"][0] == pytest.approx(1.5 * 108 * 2)
    assert overshoot(run) < 0.3
    assert settled(run) < 2.0
    assert np.abs(run["deformed.q"]).max() < 1.1 * LARGEST
    assert np.abs(run["command_unclipped.u"]).max() < 330


def test_without_the_frozen_integral_it_overshoots_far():
    """The integral gathered on the way carries the plant a metre too far; the bound of the integral alone takes most of it away."""
    assert overshoot(step_of_two_metres(integral_runs, largest=(1e9,))) > 1.0
    assert overshoot(step_of_two_metres(integral_runs)) < 0.3


@pytest.mark.parametrize("changes", [(request_kept,), (request_kept, integral_runs)], ids=["alone", "and integral"])
def test_without_the_stored_request_it_never_settles(changes):
    """The iteration goes on asking for what cannot be done: thousands of newtons, metres of overshoot, limit to limit."""
    run = step_of_two_metres(*changes)
    assert np.abs(run["command_unclipped.u"]).max() > 1e4
    assert overshoot(run) > 5.0
    assert settled(run) > 9.9
    assert run["clipped"][-2000:].mean() > 0.5


def test_bumpless_start_does_not_reach_the_limit():
    """A bumpless start asks for less than there is, so that nothing needs to be prevented."""
    run = step_of_two_metres(bumpless=True)
    assert not run["clipped"].any()
    assert overshoot(run) < 1e-3
    assert settled(run) < 2.0
