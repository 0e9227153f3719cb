"""Signals from outside beside outputs: allowed where no output needs a derivative of a signal that nobody states."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

import fpirhc as fp
from fpirhc.errors import InvalidProblem


def room(**settings: Any) -> fp.Plant:
    """C T' = u - k (T - ambient): a heated room."""
    return fp.Plant(
        coordinates={"T": "K"},
        inputs={"u": "W"},
        parameters={
            "k": fp.Parameter(approximate=1.5, exact=1.0, unit="W/K"),
            "ambient": fp.outside(nominal=280.0, unit="K"),
        },
        response=lambda q, u, p: {"T": (u.u - p.k * (q.T - p.ambient)) / 100.0},
        order=1,
        **settings,
    )


def heated(plant: fp.Plant, name: str, motion: Any, **settings: Any) -> fp.Problem:
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {name: motion(t)}),
        start={"T": 290.0},
        period=1.0,
        duration=200.0,
        signals={"ambient": fp.Known(lambda t: 280 + 5 * ca.sin(t / 20))},
        **settings,
    )


def rising(t: Any) -> Any:
    return 293 - 3 * ca.exp(-t / 50)


@pytest.mark.parametrize("course", [lambda t: 280 + ca.sin(t), lambda t: ca.pw_lin(t, [0.0, 300.0], [280.0, 285.0])])
def test_an_output_whose_derivative_has_that_of_a_smooth_signal_is_refused(course: Any) -> None:
    difference = room(outputs={"d": fp.Output("K", lambda q, p: q.T - p.ambient)})
    problem, track = heated(room(), "T", rising), fp.Trajectory(lambda t: {"d": rising(t)})
    for signal in (fp.Known(course), fp.Unknown(course)):
        with pytest.raises(InvalidProblem, match=r"signals: .* depend on ambient, .* state it in steps, Samples\("):
            replace(problem, plant=difference, reference=track, signals={"ambient": signal})


RATES = {"valve": 0.1, "drain": 0.05}  # 1/s
TIMES = np.arange(0.0, 120.0, 0.5)
INFLOW = 0.3 * np.sin(TIMES / 9) + (TIMES > 40)


def lower_level(signal: Any) -> fp.Problem:
    """h1' = u - valve h1, h2' = valve h1 - drain h2 + w; the level h2 is the output, and w is in its first derivative."""
    plant = fp.Plant.of_states(
        states={"h1": "cm", "h2": "cm"},
        inputs={"u": "cm/s"},
        rates=lambda x, u, p: {"h1": u.u - p.valve * x.h1, "h2": p.valve * x.h1 - p.drain * x.h2 + p.w},
        outputs={"level": fp.Output("cm", lambda x, p: x.h2)},
        parameters={
            **{name: fp.Parameter(value, value, "1/s") for name, value in RATES.items()},
            "w": fp.outside(nominal=0.0, unit="cm/s"),
        },
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"level": 10 + 2 * ca.tanh((t - 60) / 15)}),
        start={"h1": 4.0, "h2": 8.0},
        period=0.5,
        duration=100.0,
        integrator=fp.RungeKutta4(substeps=8),
        signals={"w": signal},
        measure_from=10.0,
    )


@pytest.mark.parametrize("told", [True, False])
def test_a_signal_held_between_its_samples_may_be_in_the_derivative_of_an_output(told: bool) -> None:
    """The motion is that of the matrix exponential, and the command the inverse by hand: y'' = valve h1' - drain y'."""
    samples = fp.Samples(TIMES, INFLOW)
    problem = lower_level(fp.Known(samples) if told else fp.Unknown(samples))
    run = fp.simulate(problem, fp.ComputedTorque(fp.Exponential(rate=0.3)), seed=0, compiled=False)
    valve, drain, cycles = RATES["valve"], RATES["drain"], run.cycles
    rates = np.array([[-valve, 0, 1, 0], [valve, -drain, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]])
    step = expm(0.5 * rates)
    command, inflow = run["command"][:, 0], INFLOW[:cycles]
    state = np.column_stack([run["state.h1"], run["state.h2"]])
    expected = np.column_stack([state, command, inflow]) @ step.T
    assert state[1:] == pytest.approx(expected[:-1, :2], abs=1e-9)
    model = inflow if told else 0.0 * inflow
    slope = valve * state[:, 0] - drain * state[:, 1] + model
    wanted = (run["desired.level"] + drain * slope) / valve + valve * state[:, 0]
    assert command == pytest.approx(wanted, abs=1e-9)
