"""Rivals: each law does what its source says, is the iteration where theory says so, and fits or is refused before a run."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from helpers.plants import chain, heavy, linear, swing
from helpers.plants import simulated as simulate
from scipy.linalg import expm

import fpirhc as fp
from fpirhc.errors import InvalidProblem

RATE = 6.0
TRACK = fp.Exponential(rate=RATE)
SIGMOID = fp.Sigmoid(gain=-0.5, scale=10.0)
LOAD = {"y": fp.Step(at=0.3, size=-2.0)}


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


@pytest.mark.parametrize(("stiffness", "tolerance"), [(0.0, 1e-9), (5.0, 0.02)])
def test_acceleration_rate_contracts_as_predicted(stiffness, tolerance):
    """(e, e', e'') follows the sampled matrix of (d/dt + rate)^3 e = 0; on a spring, whose drift is taken out, nearly."""
    period, plant = 1e-2, heavy(1.0, 1.0, (stiffness, stiffness), q="y")
    run = simulate(resting(plant, period=period), fp.rivals.ResolvedAccelerationRate(RATE))
    third = np.eye(3)[2] - period * np.array([RATE**3, 3 * RATE**2, 3 * RATE])  # acceleration of the coming period
    matrix = np.array([[1, period, 0], [0, 1, 0], [0, 0, 0]]) + np.outer([period**2 / 2, period, 1], third)
    states = np.column_stack([run["state"], run["realised"]])[1:]
    for k in range(100):
        np.testing.assert_allclose(states[k + 1], matrix @ states[k], atol=tolerance)
    assert np.abs(np.linalg.eigvals(matrix)).max() == pytest.approx(np.exp(-RATE * period), rel=0.02)


# Acceleration feedback


@pytest.mark.parametrize(("gain", "time_constant"), [(0.5, 0.0), (4.0, 0.05)])
def test_acceleration_feedback_divides_the_residual(gain, time_constant):
    """A constant residual w leaves the response error w / (1 + kappa)."""
    law = fp.rivals.AccelerationFeedback(fp.Exponential(RATE, integral=False), gain, time_constant)
    run = simulate(resting(chain(2), disturbances={"y": fp.Step(at=0.0, size=-8.0)}), law)
    assert run["realised.y"][-1] - run["desired.y"][-1] == pytest.approx(-8.0 / (1 + gain), rel=1e-3)


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


# Where they are the fixed-point iteration, command by command


def first_order():
    """Y' = 1.7 u, believed y' = u, and the response is the last difference: what deadbeat observers have."""
    moving, last = fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}), fp.Sensing(estimator=fp.VelocityDifference())
    first = {"b": fp.Parameter(1.0, 1.7, "1")}
    plant = fp.Plant({"y": "m"}, {"u": "N"}, first, lambda q, u, p: {"y": p.b * u.u}, order=1)
    return resting(plant, 0.2, reference=moving, sensing=last, duration=1.0, disturbances=LOAD)


def assert_same(problem, one, other):
    """Both give the same commands, to rounding."""
    first, second = (simulate(problem, c)["command"] for c in (one, other))
    assert np.ptp(second) > 0.1
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-12 * max(1.0, np.abs(second).max()))


def iterated(gain, tracking=TRACK):
    """Computed torque with the model-referenced affine map of that effective gain."""
    return fp.ComputedTorque(tracking, fp.ModelReferenced(fp.Affine(gain=-2 * gain)))


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
    responses = simulate(resting(linear(gain, 1.0), 0.2, disturbances=load), law)
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
    result = simulate(
        resting(plant, 0.2, disturbances=load, duration=5.0, period=1e-3), fp.rivals.ADRC(20.0, observer=100.0)
    )
    rest = -23.2 - 1.41 * result["state.y'"] + (23.2 - 40.0) * result["command.u"]
    assert result["extended_state.y''"][-1] == pytest.approx(rest[-1], rel=1e-6)
    assert abs(result["error.y"][-1]) < 1e-9
    assert np.abs(result["error.y"][2000:]).max() > 1e-3


@pytest.mark.parametrize("predictor", [1.0, 20.0])
def test_l1_leaves_the_published_share_of_a_load(predictor):
    """The piecewise-constant law estimates exp(-a_s T) of the mean residual of the last cycle."""
    problem = resting(chain(2), 0.2, disturbances=LOAD)
    seen = simulate(problem, fp.rivals.L1Adaptive(TRACK, bandwidth=200.0, predictor=predictor))[
        "response_disturbance.y"
    ]
    assert seen[-1] == pytest.approx(-2.0 * np.exp(-predictor * problem.period), rel=1e-6)


def test_every_rival_has_its_name_in_one_module():
    """What is a controller of the literature is found there, and by its name at the top."""
    for name in fp.rivals.__all__:
        assert getattr(fp, name) is getattr(fp.rivals, name)


# What does not fit


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
