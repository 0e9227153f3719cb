"""Status OK is a promise about the plan that is sent: on an unstable plant a plan that is not solved says so."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import CompileError, NotInstalled

LEVITATION = fp.Plant.of_states(
    states={"g": "mm", "w": "mm/s", "i": "A"},
    inputs={"V": "V"},
    rates=lambda x, u, p: {
        "g": x.w,
        "w": 9810.0 - p.K * (x.i / x.g) ** 2 / p.m,
        "i": (u.V - p.R * x.i) / p.L + 0.3 * x.i * x.w / x.g,
    },
    outputs={"gap": fp.Output("mm", lambda x, p: x.g)},
    parameters={
        "K": fp.Parameter(1.8e5, 2.1e5, "N mm^2/A^2"),
        "m": fp.Parameter(0.30, 0.34, "kg"),
        "R": fp.Parameter(2.0, 2.6, "Ohm"),
        "L": fp.Parameter(0.05, 0.06, "H"),
    },
)
CURRENT = 8 * np.sqrt(9810 * 0.34 / 2.1e5)
PROBLEM = fp.Problem(
    plant=LEVITATION,
    reference=fp.Trajectory(lambda t: {"gap": 8 + ca.sin(6 * t)}),
    start={"g": 8.0, "w": 6.0, "i": float(CURRENT)},
    period=1e-3,
    duration=1.5,
    measure_from=0.5,
    limits=fp.Limits(inputs={"V": (-20.0, 20.0)}),
    horizon=fp.Horizon(stages=15, step=1e-2, discretisation=fp.RungeKutta4(substeps=3)),
    cost=fp.Quadratic(outputs={"gap": 1.0}, rate={"V": 1e-7}),
    input_before={"V": float(2.6 * CURRENT)},
)


def levitated(optimiser):
    """Errors of the gap and statuses of every cycle, with the exact model."""
    run = fp.simulate(PROBLEM, fp.ExactModel(fp.RecedingHorizon(optimiser)), seed=0)
    error = np.abs(np.asarray(run["true_error"])).reshape(run.cycles, -1)[:, 0]
    return error, np.ravel(run["status"])


def test_no_cycle_is_ok_after_the_ball_is_lost():
    """One iteration in ten cycles is too little here: the ball falls, and no plan of a ball that falls is OK."""
    error, status = levitated(fp.FixedPointSolver(iterations=1, tolerance=1e-3))
    assert error.max() > 100.0
    lost = int(np.argmax(error > 0.5))
    assert (status[:lost] == fp.Status.OK).mean() > 0.5
    assert (status[lost:] != fp.Status.OK).all()


@pytest.mark.parametrize(
    "optimiser", [fp.FixedPointSolver(), fp.FixedPointSolver(iterations=10, tolerance=1e-3)], ids=["default", "ten"]
)
def test_a_ball_that_is_held_is_held_by_plans_that_are_ok(optimiser):
    error, status = levitated(optimiser)
    assert error[500:].max() < 1e-3
    assert (status == fp.Status.OK).all()


ASKED = r"need a C compiler \(the system's, or pip install ziglang\): compilation is turned off"


@pytest.mark.parametrize(
    ("compiler", "error", "words"), [("none", NotInstalled, ASKED), ("false", CompileError, "failed")]
)
def test_limits_of_states_need_a_compiler(monkeypatch, compiler, error, words):
    """No plan is made of zeros: without a compiler, or where it fails, such plans are refused; others run without it."""
    monkeypatch.setenv("FPIRHC_CC", compiler)
    short = replace(PROBLEM, duration=3e-3, measure_from=0.0)
    limited = replace(short, limits=fp.Limits(inputs=short.limits.inputs, states={"g": (2.0, 20.0)}))
    controller = fp.RecedingHorizon(fp.FixedPointSolver(tolerance=1e-3))
    with pytest.raises(error, match=words):
        fp.simulate(limited, controller, seed=0, compiled=False)
    assert not fp.simulate(short, controller, seed=0).compiled
