"""Rivals by their names: the published equations as runs, and where they are the fixed-point iteration command by command."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import chain, linear, pendulum
from helpers.plants import simulated as run
from scipy.linalg import expm

import fpirhc as fp

RATE = 6.0
TRACK = fp.Exponential(rate=RATE)
DIFFERENCES = fp.Sensing(estimator=fp.VelocityDifference())


def swing(**changes: Any) -> fp.Problem:
    """A pendulum along a sine, with a wrong model."""
    settings: dict[str, Any] = {"reference": fp.Trajectory(lambda t: {"angle": 0.5 * ca.sin(2 * t)})}
    settings |= {"plant": pendulum(), "start": {"angle": 0.1}, "period": 1e-3, "duration": 1.0}
    return fp.Problem(**{**settings, **changes})


def pushed(plant: fp.Plant, **changes: Any) -> fp.Problem:
    """A coordinate to be kept at zero under a load that steps."""
    settings: dict[str, Any] = {"plant": plant, "reference": fp.Trajectory(lambda t: {"y": 0 * t}), "start": {"y": 0.2}}
    settings |= {"period": 1e-2, "duration": 1.0, "disturbances": {"y": fp.Step(at=0.3, size=-2.0)}}
    return fp.Problem(**{**settings, **changes})


def first_order(**changes: Any) -> fp.Problem:
    """Y' = 1.7 u, believed y' = u, and the response is the last difference: what deadbeat observers have."""
    plant = fp.Plant(
        {"y": "m"}, {"u": "N"}, {"b": fp.Parameter(1.0, 1.7, "1")}, lambda q, u, p: {"y": p.b * u.u}, order=1
    )
    moving = fp.Trajectory(lambda t: {"y": ca.sin(3 * t)})
    return pushed(plant, sensing=DIFFERENCES, **{"reference": moving, **changes})


def assert_same(problem: fp.Problem, one: Any, other: Any, tolerance: float = 1e-12) -> None:
    """Both give the same commands, to rounding."""
    first, second = (run(problem, c)["command"] for c in (one, other))
    assert np.ptp(second) > 0.1
    np.testing.assert_allclose(first, second, rtol=0, atol=tolerance * max(1.0, np.abs(second).max()))


def iterated(gain: float, tracking: Any = TRACK) -> fp.ComputedTorque:
    """Computed torque with the model-referenced affine map of that effective gain."""
    return fp.ComputedTorque(tracking, fp.ModelReferenced(fp.Affine(gain=-2 * gain)))


# Identities


@pytest.mark.parametrize("limits", [(-50.0, 50.0), (-1.5, 1.5)])
def test_indi_is_the_iteration_of_unit_gain(limits):
    """The law u + G^-1 (d - f) and the affine map of unit gain, with a wrong model, also where commands are clipped."""
    problem = swing(limits=fp.Limits(inputs={"torque": limits}))
    assert_same(problem, fp.rivals.INDI(TRACK), iterated(1.0))
    late = replace(problem, dead_time=fp.DeadTime({"torque": 0.02}, measurement=0.01))
    assert fp.rivals.INDI(TRACK).notes(problem) == ()
    assert "a command 0.03 s older: dead time is not compensated" in fp.rivals.INDI(TRACK).notes(late)[0]


def test_deadbeat_observer_of_adrc_is_the_iteration_of_unit_gain():
    """For order one z_2 is the last difference less b_0 u."""
    law = fp.Exponential(rate=RATE, integral=False)
    assert_same(first_order(), fp.rivals.ADRC(RATE, observer=1e6), iterated(1.0, law))


def test_l1_is_the_iteration_on_differences_as_its_predictor_gets_slow():
    """Of the effective gain 1 - exp(-w_c T)."""
    problem, law = first_order(), fp.Exponential(rate=RATE, integral=False)
    rival = fp.rivals.L1Adaptive(law, bandwidth=60.0, predictor=1e-10)
    assert_same(problem, rival, iterated(-np.expm1(-60.0 * problem.period), law))


# Published equations


def test_filter_of_indi_has_the_poles_of_its_transfer_function():
    """w^2 / (s^2 + 2 zeta w s + w^2) with w = 50 rad/s and zeta = 0.55 (Smeur, Chu, de Croon 2016), and gain one at rest."""
    period, frequency, damping = 1 / 512, 50.0, 0.55
    first, second = fp.rivals.INDI(TRACK, frequency).filter(period)
    poles = np.roots([1.0, -first, -second])
    wanted = np.exp(period * np.roots([1.0, 2 * damping * frequency, frequency**2]))
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(wanted), rtol=1e-9)


@pytest.mark.parametrize(("frequency", "gain", "grows"), [(None, 1.9, False), (None, 2.1, True), (50.0, 2.1, False)])
def test_indi_diverges_beyond_twice_the_gain_of_the_model_unless_it_is_filtered(frequency, gain, grows):
    law = fp.rivals.INDI(fp.Exponential(rate=1.0), frequency)
    load = {"y": fp.Step(at=0.1, duration=0.05, size=1.0)}
    responses = run(pushed(linear(gain, 1.0), disturbances=load, duration=3.0), law)
    late = np.abs(responses["realised.y"][-20:] - responses["desired.y"][-21:-1]).max()
    assert late > 1.0 if grows else late < 0.02


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_observer_of_adrc_has_all_poles_at_its_bandwidth(order):
    """Eigenvalues of (1 - l c) Phi (Miklosovic, Radke, Gao 2006), and its published gains for orders one and two."""
    period, plant, law = 1e-2, chain(order), fp.rivals.ADRC(2.0, observer=20.0)
    pole, moves = np.exp(-0.2), expm(np.eye(order + 1, k=1) * period)
    gains = np.array(law.corrections(plant, order, period))
    polynomial = np.poly(moves - np.outer(gains, moves[0]))
    np.testing.assert_allclose(polynomial, np.poly(np.full(order + 1, pole)), atol=1e-9)
    published = {1: [1 - pole**2, (1 - pole) ** 2 / period]}
    published[2] = [1 - pole**3, 1.5 * (1 - pole) ** 2 * (1 + pole) / period, (1 - pole) ** 3 / period**2]
    if order in published:
        np.testing.assert_allclose(gains, published[order], rtol=1e-9)


def test_adrc_estimates_the_total_disturbance_of_a_motion_system():
    """Y'' = -1.41 y' + 23.2 T_d + 23.2 u, told as y'' = 40 u: z_3 is all of the rest, and the load leaves no error (Gao 2003)."""
    plant = fp.Plant(
        {"y": "rev"},
        {"u": "V"},
        {"b": fp.Parameter(40.0, 23.2, "rev/(s^2 V)"), "c": fp.Parameter(0.0, 1.41, "1/s")},
        lambda q, v, u, p: {"y": p.b * u.u - p.c * v.y},
    )
    load = {"y": fp.Step(at=2.0, size=-23.2)}
    result = run(pushed(plant, disturbances=load, duration=5.0, period=1e-3), fp.rivals.ADRC(20.0, observer=100.0))
    rest = -23.2 - 1.41 * result["state.y'"] + (23.2 - 40.0) * result["command.u"]
    assert result["extended_state.y''"][-1] == pytest.approx(rest[-1], rel=1e-6)
    assert abs(result["error.y"][-1]) < 1e-9
    assert np.abs(result["error.y"][2000:]).max() > 1e-3


@pytest.mark.parametrize("predictor", [1.0, 20.0])
def test_l1_leaves_the_published_share_of_a_load(predictor):
    """The piecewise-constant law estimates exp(-a_s T) of the mean residual of the last cycle."""
    problem = pushed(chain(2), duration=3.0)
    seen = run(problem, fp.rivals.L1Adaptive(TRACK, bandwidth=200.0, predictor=predictor))["response_disturbance.y"]
    assert seen[-1] == pytest.approx(-2.0 * np.exp(-predictor * problem.period), rel=1e-6)


def test_every_rival_has_its_name_in_one_module():
    """What is a controller of the literature is found there, and by its name at the top."""
    for name in fp.rivals.__all__:
        assert getattr(fp, name) is getattr(fp.rivals, name)
