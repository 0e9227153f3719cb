"""Rivals: each law does what its textbook says, fits or is refused before a run, and is one step in C as in CasADi."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from helpers.plants import chain, linear, pendulum
from helpers.plants import simulated as simulate

import fpirhc as fp
from fpirhc.errors import InvalidProblem

RATE = 6.0
TRACK = fp.Exponential(rate=RATE)
SIGMOID = fp.Sigmoid(gain=-0.5, scale=10.0)


def resting(plant, start=1.0, *, name="y", **changes):
    """The task of bringing a coordinate to zero and keeping it there."""
    settings = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {name: 0 * t}),
        "start": {name: start},
        "period": 1e-2,
        "duration": 3.0,
    }
    return fp.Problem(**{**settings, **changes})


def swing(**changes):
    """A pendulum along a sine, with a wrong model."""
    settings = {"reference": fp.Trajectory(lambda t: {"angle": 0.5 * ca.sin(2 * t)}), "start": {"angle": 0.1}}
    settings |= {"plant": pendulum(), "period": 1e-3, "duration": 4.0, "measure_from": 2.0}
    return fp.Problem(**{**settings, **changes})


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


# PID


def test_pid_on_a_double_integrator_has_the_computed_poles():
    """Poles fitted to the run's own samples are the roots of s^3 + k_d s^2 + k_p s + k_i, up to the sampling."""
    wanted = np.array([-2.0, -4.0 + 3.0j, -4.0 - 3.0j])
    _, derivative, proportional, integral = np.poly(wanted).real
    controller = fp.PID({"y": proportional}, {"y": integral}, {"y": derivative}, bumpless=False)
    run = simulate(resting(chain(2), period=1e-3), controller)
    states = np.column_stack([run["integral"][:-1], run["state"][1:]])  # the integral is logged after its update
    matrix = np.linalg.lstsq(states[:-1], states[1:], rcond=None)[0].T
    result = np.log(np.linalg.eigvals(matrix).astype(complex)) / 1e-3
    np.testing.assert_allclose(np.sort_complex(result), np.sort_complex(wanted), rtol=0.01)


def test_pid_starts_without_a_jump_and_its_integral_waits_for_the_actuator():
    """The first command is zero; while the command is clipped the integral goes no further into the limit."""
    controller = fp.PID({"y": 40.0}, {"y": 60.0}, {"y": 12.0})
    assert simulate(resting(chain(2)), controller)["command"][0, 0] == pytest.approx(0.0, abs=1e-12)
    plain = simulate(resting(chain(2)), replace(controller, integral={}))
    assert plain["command"][0, 0] == pytest.approx(40.0 * plain["error"][0, 0]) != 0
    weak = resting(chain(2), limits=fp.Limits(inputs={"u": (-0.8, 0.8)}), duration=6.0)
    run = simulate(weak, replace(controller, bumpless=False))
    clipped = run["clipped"][1:, 0] > 0.5
    assert clipped.sum() > 50
    cut_off = (run["command_unclipped.u"] - run["command.u"])[1:]
    assert np.all((np.diff(run["integral.y"]) * cut_off)[clipped] <= 0)
    assert abs(run["error.y"][-1]) < 0.05


# Sliding mode


def test_sliding_mode_holds_the_residual_at_the_computed_distance():
    """|S| = w atanh(residual / K) and e = S / rate, to three digits."""
    law = fp.rivals.SlidingMode(rate=RATE, gain=20.0, width=0.5)
    run = simulate(resting(chain(2), disturbances={"y": fp.Step(at=0.0, size=-8.0)}, period=1e-3), law)
    expected = 0.5 * np.arctanh(8.0 / 20.0)
    assert run["surface.y"][-1] == pytest.approx(expected, rel=1e-3)
    assert run["error.y"][-1] == pytest.approx(expected / RATE, rel=1e-3)


@pytest.mark.parametrize("product", [0.5, 1.0, 1.9])
def test_sliding_mode_multiplies_a_small_surface_by_one_minus_gain_period_over_width(product):
    """For relative order one S is the error, and the factor is exact."""
    law = fp.rivals.SlidingMode(rate=RATE, gain=product * 100.0, width=1.0)
    surface = simulate(resting(chain(1), 1e-4, duration=0.1), law)["surface.y"]
    np.testing.assert_allclose(surface[1:5], (1 - product) * surface[:4], atol=1e-11)


# Resolved acceleration rate


def test_acceleration_rate_contracts_as_predicted():
    """On the double integrator (e, e', e'') follows the sampled matrix of (d/dt + rate)^3 e = 0."""
    period = 1e-2
    run = simulate(resting(chain(2), period=period), fp.rivals.ResolvedAccelerationRate(RATE))
    third = np.eye(3)[2] - period * np.array([RATE**3, 3 * RATE**2, 3 * RATE])  # acceleration of the coming period
    matrix = np.array([[1, period, 0], [0, 1, 0], [0, 0, 0]]) + np.outer([period**2 / 2, period, 1], third)
    states = np.column_stack([run["state"], run["realised"]])[1:]
    for k in range(100):
        np.testing.assert_allclose(states[k + 1], matrix @ states[k], atol=1e-9)
    assert np.abs(np.linalg.eigvals(matrix)).max() == pytest.approx(np.exp(-RATE * period), rel=0.02)


@pytest.mark.parametrize(("gain", "decays"), [(0.06, False), (0.2, True), (3.0, True)])
def test_acceleration_rate_needs_a_ninth_of_the_model_gain(gain, decays):
    """Stability limit J > 1/9 for relative order two."""
    run = simulate(resting(linear(gain, 1.0), duration=12.0), fp.rivals.ResolvedAccelerationRate(RATE))
    late = np.abs(run["error.y"][-200:]).max()
    assert late < 0.02 if decays else late > 1.0


def test_acceleration_rate_forgets_a_constant_residual():
    """Only the model's changes count."""
    load = {"y": fp.Step(at=0.0, size=-8.0)}
    run = simulate(resting(chain(2), disturbances=load, duration=5.0), fp.rivals.ResolvedAccelerationRate(RATE))
    assert abs(run["error.y"][-1]) < 1e-6


# Acceleration feedback


@pytest.mark.parametrize(("gain", "time_constant"), [(0.5, 0.0), (4.0, 0.05)])
def test_acceleration_feedback_divides_the_residual(gain, time_constant):
    """A constant residual w leaves the response error w / (1 + kappa)."""
    law = fp.rivals.AccelerationFeedback(fp.Exponential(RATE, integral=False), gain, time_constant)
    run = simulate(resting(chain(2), disturbances={"y": fp.Step(at=0.0, size=-8.0)}), law)
    assert run["realised.y"][-1] - run["desired.y"][-1] == pytest.approx(-8.0 / (1 + gain), rel=1e-3)


@pytest.mark.parametrize("time_constant", [0.0, 0.02])
def test_acceleration_feedback_has_the_computed_limit(time_constant):
    """Stable at 0.9, unstable at 1.1 of (1 + p) / (1 - p)."""
    sizes = []
    for share in (0.9, 1.1):
        law = fp.rivals.AccelerationFeedback(fp.Exponential(0.1, integral=False), 1.0, time_constant)
        law = replace(law, gain=share * (1 + law.pole(1e-2)) / (1 - law.pole(1e-2)))
        load = {"y": fp.Step(at=0.5, duration=0.1, size=1.0)}
        run = simulate(resting(chain(2), 0.0, disturbances=load, period=1e-2), law)
        sizes.append(np.abs(np.diff(run["deformed.y"][-5:])).max())
    assert sizes[0] < 1e-3
    assert sizes[1] > 1.0


# Model reference adaptive control


def test_force_mrac_believes_in_the_reference_model():
    """Recalculated and desired force agree 20 times better than deformed and desired; the tracking error falls with it."""
    values = {"m": (2.0, 1.0, "kg"), "b": (1.0, 0.5, "N s/m"), "k": (10.0, 20.0, "N/m"), "c": (1.0, 3.0, "N/m^3")}
    plant = fp.Plant(
        {"q": "m"},
        {"Q": "N"},
        {name: fp.Parameter(*v) for name, v in values.items()},
        lambda q, v, u, p: {"q": (u.Q - p.b * v.q - p.k * q.q - p.c * q.q**3) / p.m},
    )
    moving = fp.Trajectory(lambda t: {"q": ca.sin(2 * t)})
    problem = fp.Problem(plant, moving, {"q": 0.0}, 1e-3, 10.0, measure_from=3.0)
    collected = []
    for deformation in (fp.Identity(), SIGMOID):
        run = simulate(problem, fp.rivals.ForceMRAC(fp.Exponential(3.7), deformation))
        late = slice(3000, run.cycles)
        desired, before = run["force_desired"][late], run["force_desired"][2999:-1]
        errors = (run["error"][late], run["force_recalculated"][late] - before, run["command"][late] - desired)
        collected.append((np.abs(errors[0]).max(), rms(errors[1]), rms(errors[2])))
    (plain, unequal, _), (adaptive, equal, illusion) = collected
    assert 20 * equal < illusion
    np.testing.assert_allclose([plain, unequal], [0.172, 8.1], rtol=0.2)
    np.testing.assert_allclose([adaptive, equal, illusion], [0.0030, 0.13, 9.1], rtol=0.2)


def test_force_mrac_is_computed_torque_with_a_deformed_command():
    """Without a deformation they are one; with it the automatic scale, in units of the input, serves as well."""
    problem = swing()
    plain = [simulate(problem, c) for c in (fp.rivals.ForceMRAC(TRACK, fp.Identity()), fp.ComputedTorque(TRACK))]
    np.testing.assert_allclose(plain[0]["command"], plain[1]["command"], atol=1e-9)
    scaled = [simulate(problem, fp.rivals.ForceMRAC(TRACK, s)) for s in (SIGMOID, fp.Sigmoid(gain=-0.5))]
    late = [rms(r["error"][2000:]) for r in (*scaled, plain[0])]
    assert late[1] == pytest.approx(late[0], rel=0.02)
    assert 20 * late[0] < late[2]


def adapted(period, gain, duration=20.0):
    """A linear plant of which the model knows the sign of the gain only; V along the run, and the run."""
    values = {"b": (0.5 * gain, gain), "k": (0.0, 3.0), "c": (0.0, 0.5), "d": (0.0, 1.0)}
    plant = fp.Plant(
        {"y": "m"},
        {"u": "N"},
        {name: fp.Parameter(believed, exact, "1") for name, (believed, exact) in values.items()},
        lambda q, v, u, p: {"y": p.b * u.u - p.k * q.y - p.c * v.y + p.d},
    )
    moving = fp.Trajectory(lambda t: {"y": ca.sin(t) + 0.5 * ca.sin(2.7 * t)})
    problem = fp.Problem(plant, moving, {"y": 0.5}, period, duration)
    law = fp.rivals.LyapunovMRAC(4.0, adaptation=10.0)
    run = simulate(problem, law)
    before = np.vstack([run["gains"][:1], run["gains"][:-1]])[1:]  # of the state at the cycle's start
    matched = np.array([3.0, 0.5, 1.0, -1.0]) / gain
    errors = (run["model"] - run["state"])[1:] * np.array([4.0, 1.0])
    quadratic = np.einsum("ki,ij,kj->k", errors, law.weights(2), errors)
    return quadratic + abs(gain) / law.adaptation * np.sum((before - matched) ** 2, axis=1), run


@pytest.mark.parametrize("gain", [2.0, -2.0])
def test_lyapunov_function_falls_and_the_error_goes_to_zero(gain):
    """In the limit of small periods V never rises: what it rises shrinks with the period and is little beside its fall."""
    rises = []
    for period in (4e-3, 2e-3):
        function, run = adapted(period, gain)
        changes = np.diff(function)
        rises.append(changes[changes > 0].sum() / -changes[changes < 0].sum())
    assert rises[0] < 0.02
    assert rises[1] < 0.6 * rises[0]
    deviation = np.abs(run["model.y"] - run["state.y"])
    assert deviation[-500:].max() < 0.05 * deviation.max()


@pytest.mark.parametrize(("share", "grows"), [(0.8, False), (1.25, True)])
def test_adaptation_has_the_computed_limit(share, grows):
    """At rest only the bias is adapted, |phi| = 1: stable below gamma |B| period / 2 = rate."""
    law = fp.rivals.LyapunovMRAC(RATE, adaptation=share * 2 * RATE / 1e-2)
    load = {"y": fp.Step(at=0.1, duration=0.1, size=1e-6)}
    speeds = np.abs(simulate(resting(chain(2), 0.0, disturbances=load), law)["state.y'"])
    assert (speeds[200:].max() > speeds[:60].max()) == grows


# What fits, and what does not


def cart_pole():
    return fp.load_problem("cart_pole").problem


MISFITS = {
    "not fully actuated": (cart_pole, fp.rivals.LyapunovMRAC(RATE, 1.0), "'angle' has no input of its own"),
    "wrong sign": (swing, fp.PID({"angle": -1.0}), "does not bring it back"),
    "too many gains": (swing, fp.PID({"angle": 1.0}, {}, {"angle": (1.0, 1.0)}), "at most 1 gains of e'"),
    "chattering": (swing, fp.rivals.SlidingMode(RATE, 500.0, 0.2), "chatters with any model"),
}


@pytest.mark.parametrize("case", MISFITS)
def test_what_does_not_fit_is_refused_before_a_run(case):
    problem, controller, message = MISFITS[case]
    for begin in (lambda p: simulate(p, controller), lambda p: fp.Stepper(p, controller, compiled=False)):
        with pytest.raises(InvalidProblem, match=message):
            begin(problem())
