"""What an integral does while a limit acts: it goes no further in, comes back out, and follows its own coordinate alone."""

import pytest

import fpirhc as fp
from fpirhc.contracts import Controller

LAW = fp.Exponential(rate=2.0)


def heater(start: float, goal: float, duration: float = 30.0) -> fp.Problem:
    """A heater x' = u - x with u from 0 to 1."""
    plant = fp.Plant({"x": "K"}, {"u": "W"}, {}, lambda q, u, p: {"x": u.u - q.x}, order=1)
    reference = fp.Trajectory(lambda t: {"x": goal + 0 * t})
    limits = fp.Limits(inputs={"u": (0.0, 1.0)})
    return fp.Problem(plant, reference, {"x": start}, period=0.02, duration=duration, limits=limits)


def two_heaters(goal: float) -> fp.Problem:
    """Two that know nothing of each other; b has a load that the model lacks."""
    plant = fp.Plant(
        {"a": "K", "b": "K"},
        {"u": "W", "v": "W"},
        {"load": fp.Parameter(0.0, 1.0, "1")},
        lambda q, u, p: {"a": u.u - q.a, "b": u.v - q.b - 0.5 * p.load},
        order=1,
    )
    reference = fp.Trajectory(lambda t: {"a": goal + 0 * t, "b": 0.3 + 0 * t})
    limits = fp.Limits(inputs={"u": (-1.0, 1.0), "v": (-5.0, 5.0)})
    return fp.Problem(plant, reference, {"a": 0.0, "b": 0.0}, period=0.02, duration=20.0, limits=limits)


def last(problem: fp.Problem, controller: Controller, signal: str) -> float:
    return float(fp.simulate(problem, controller, seed=0, compiled=False)[signal][-1])


@pytest.mark.parametrize(
    "controller",
    [
        fp.ComputedTorque(LAW),
        fp.ComputedTorque(fp.ShiftPolynomial(poles=0.96, step=0.02)),
        fp.Slotted({"x": fp.ComputedTorque(LAW)}, {"x": 1.0}, blend=0.1),
        fp.PID({"x": 2.0}, {"x": 1.0}),
        fp.rivals.LyapunovMRAC(2.0, adaptation=1.0),
    ],
    ids=["exponential", "shift polynomial", "slot", "PID", "gains"],
)
def test_the_error_takes_an_integral_out_of_a_limit(controller):
    """A bumpless start from far above loads the integral with heat; frozen there, 1 K would stay for ever."""
    assert last(heater(3.0, 0.5), controller, "state.x") == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("controller", [fp.ComputedTorque(LAW), fp.PID({"x": 2.0}, {"x": 1.0})], ids=["law", "PID"])
def test_an_integral_goes_no_further_into_a_limit(controller):
    """At full power 2 K are out of reach, and an error of 1 K stays; the command asks for hardly more than there is."""
    assert 1 < last(heater(0.0, 2.0), controller, "command_unclipped.u") < 1.1


@pytest.mark.parametrize(
    "controller",
    [
        fp.ComputedTorque(LAW),
        fp.PID(dict.fromkeys("ab", 2.0), dict.fromkeys("ab", 1.0)),
        fp.rivals.LyapunovMRAC(2.0, adaptation=10.0),
    ],
    ids=["law", "PID", "gains"],
)
def test_a_limit_of_one_coordinate_stops_no_other_integral(controller):
    """The integral of b takes its load off also while a asks for what its input cannot give."""
    assert last(two_heaters(2.0), controller, "state.b") == pytest.approx(0.3, abs=1e-3)
