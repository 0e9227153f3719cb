"""Tracking laws: gains, integrals and what they do while a limit acts; of fractional order Mittag-Leffler decay and memory."""

import math

import numpy as np
import pytest
from helpers.plants import chain, simulated

import fpirhc as fp
from fpirhc.errors import InvalidValue


@pytest.mark.parametrize(("order", "gains"), [(1, (36, 12)), (2, (216, 108, 18)), (4, (7776, 6480, 2160, 360, 30))])
def test_gains_are_binomials(order, gains):
    """(d/dt + 6)^(n+1) e_int expanded."""
    assert fp.Exponential(rate=6.0).gains(order) == pytest.approx(gains)
    assert fp.ShiftPolynomial([0.94] * (order + 1), step=0.01).gains(order) == pytest.approx(gains)


# The tracking law of fractional order: Mittag-Leffler decay, its weights and memory


def problem(order=1, *, period=1e-3, duration=2.002, **settings):
    """A chain of integrators that is to stand still, from an error of 1 m."""
    settings_in_use = {"start": {"y": -1.0}, "reference": fp.Trajectory(lambda t: {"y": 0 * t}), **settings}
    return fp.Problem(plant=chain(order), period=period, duration=duration, **settings_in_use)


def run(task, tracking):
    return simulated(task, fp.ComputedTorque(tracking))


def decaying(result, order, rate):
    """S = (d/dt + rate)^n e_int of every cycle, from the logged state and integral."""
    integral = np.concatenate([[0.0], result["integral.y"][:-1]])
    chain_of_errors = [integral, *(-result["state"].T)]
    return sum(math.comb(order, s) * rate ** (order - s) * chain_of_errors[s] for s in range(order + 1))


def mittag_leffler(order, x):
    """E_order(-x) by its power series, for x small enough that nothing cancels."""
    return sum((-x) ** k / math.gamma(order * k + 1) for k in range(int(150 / order)))


@pytest.mark.parametrize(("order", "beta", "after"), [(3, 0.6, 0.300584), (1, 0.8, 0.223547), (2, 1.0, 0.135335)])
def test_closed_loop_follows_mittag_leffler(order, beta, after):
    """S(t) / S_0 = E_beta(-(rate t)^beta) on the ideal plant, whatever its relative order; `after` is E at rate t = 2."""
    period = 4e-3
    result = run(problem(order, period=period, duration=2.004), fp.Fractional(rate=1.0, order=beta, memory=2.004))
    surface = decaying(result, order, 1.0)
    assert surface[500] / surface[0] == pytest.approx(after, abs=period)
    late = np.arange(50, 501, 25)
    expected = [mittag_leffler(beta, (k * period) ** beta) for k in late]
    np.testing.assert_allclose(surface[late] / surface[0], expected, atol=period)


LARGEST = (0.05,)  # m/s^n: what limits are said to allow
LAWS = (  # with (g_0, g_1) for order 1 and for order 2
    (fp.Exponential(2.0, bumpless=False, largest=LARGEST), (4, 4), (8, 12)),
    (fp.ShiftPolynomial(0.98, step=0.01, largest=LARGEST), (4, 4), (8, 12)),
    (fp.Fractional(2.0, 0.8, memory=0.5, largest=LARGEST), (4, 2), (8, 8)),
)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("law", "first", "second"), LAWS, ids=lambda one: type(one).__name__)
def test_an_error_counts_within_ten_times_of_what_limits_allow(law, first, second, order):
    """|g_0 e_int + g_1 e| <= 10 L, and an integral with |g_0 e_int| > 20 L is forgotten: every cycle from the one before."""
    task = problem(order, period=0.01, start={"y": -0.3}, disturbances={"u": fp.Step(at=1.0, size=0.5)})
    result, (i, e) = run(task, law), first if order == 1 else second
    error, after = result["error.y"], result["integral.y"]
    start = -e / i * error[0] if isinstance(law, fp.ShiftPolynomial) else 0.0  # alone begins bumpless
    before = np.append(start, after[:-1])
    counts = np.abs(i * before + e * error) <= 0.5
    expected = before + 0.01 * counts * error
    expected *= np.abs(i * expected) <= 1.0
    np.testing.assert_allclose(after, expected, rtol=1e-12, atol=1e-15)
    assert 0 < counts.mean() < 1


@pytest.mark.parametrize(("start", "beta"), [(-0.2, 0.8), (-0.3, 1.5)])
def test_the_law_of_fractional_order_is_its_recursion_by_hand(start, beta):
    """Order 1, S = rate e_int + e; an S with rate |S| > 10 L is not remembered: the last one stands for it, at first zero."""
    rate, period = 2.0, 0.01
    law, push = fp.Fractional(rate, beta, memory=0.5, largest=LARGEST), fp.Step(at=1.0, size=0.8)
    result = run(problem(period=period, start={"y": start}, disturbances={"u": push}), law)
    past, stiffness, integral = np.zeros(law.cycles(period)), (rate * period) ** beta, 0.0
    weights, first, last = law.weights(len(past)), 0.0, 0.0
    for k, error in enumerate(result["error.y"]):
        surface = rate * integral + error
        surface = last if abs(rate * surface) > 0.5 else surface
        first = first if k else surface
        past, last = np.append(surface - first, past[:-1]), surface
        ahead = -(weights @ past + stiffness * first) / (1 + stiffness)
        expected = rate * error - (ahead - (surface - first)) / period
        assert result["desired.y"][k] == pytest.approx(expected, rel=1e-9, abs=1e-9), k
        integral = result["integral.y"][k]


def test_weights_are_binomials():
    """w_j = (-1)^j C(beta, j), here for one half and for one."""
    assert fp.Fractional(1.0, 0.5).weights(4) == pytest.approx([-1 / 2, -1 / 8, -1 / 16, -5 / 128])
    assert fp.Fractional(1.0, 1.0).weights(4) == pytest.approx([-1, 0, 0, 0])


def test_memory_is_static_and_bounded():
    """20 / rate by default, one number per cycle and coordinate, and never more than 20 000 cycles."""
    law = fp.Fractional(rate=4.0, order=0.8)
    memory = fp.Stepper(problem(2), fp.ComputedTorque(law), compiled=False).memory
    assert law.cycles(1e-3) == 5000
    assert memory["decay_past"].size == 5000
    assert fp.Fractional(rate=1.0, order=0.8).cycles(1e-3) == 20_000
    assert fp.Fractional(rate=1.0, order=0.8, memory=1.1).cycles(0.1) == 11  # 11.000000000000002 in floating point
    with pytest.raises(InvalidValue, match="give memory=10 or less"):
        fp.Fractional(rate=1.0, order=0.8).cycles(5e-4)


@pytest.mark.parametrize(
    "settings",
    [
        {"rate": 0.0, "order": 0.5},
        {"rate": math.inf, "order": 0.5},
        {"rate": 1.0, "order": 0.0},
        {"rate": 1.0, "order": 2.0},
        {"rate": 1.0, "order": math.nan},
        {"rate": 1.0, "order": 0.5, "memory": 0.5},
        {"rate": 1.0, "order": 0.5, "memory": math.inf},
    ],
)
def test_bad_settings_are_refused(settings):
    """No decay from order 2 on, and no memory shorter than the decay it is to hold."""
    with pytest.raises(InvalidValue, match="expected"):
        fp.Fractional(**settings)


# An integral goes no further into a limit, comes back out, and follows its own coordinate alone

LAW = fp.Exponential(rate=2.0)


def heater(start: float, goal: float) -> fp.Problem:
    """A heater x' = u - x with u from 0 to 1."""
    plant = fp.Plant({"x": "K"}, {"u": "W"}, {}, lambda q, u, p: {"x": u.u - q.x}, order=1)
    reference = fp.Trajectory(lambda t: {"x": goal + 0 * t})
    limits = fp.Limits(inputs={"u": (0.0, 1.0)})
    return fp.Problem(plant, reference, {"x": start}, period=0.02, duration=30.0, limits=limits)


def two_heaters() -> fp.Problem:
    """Two that know nothing of each other; b has a load that the model lacks."""
    plant = fp.Plant(
        {"a": "K", "b": "K"},
        {"u": "W", "v": "W"},
        {"load": fp.Parameter(0.0, 1.0, "1")},
        lambda q, u, p: {"a": u.u - q.a, "b": u.v - q.b - 0.5 * p.load},
        order=1,
    )
    reference = fp.Trajectory(lambda t: {"a": 2.0 + 0 * t, "b": 0.3 + 0 * t})
    limits = fp.Limits(inputs={"u": (-1.0, 1.0), "v": (-5.0, 5.0)})
    return fp.Problem(plant, reference, {"a": 0.0, "b": 0.0}, period=0.02, duration=20.0, limits=limits)


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
    assert simulated(heater(3.0, 0.5), controller)["state.x"][-1] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("controller", [fp.ComputedTorque(LAW), fp.PID({"x": 2.0}, {"x": 1.0})], ids=["law", "PID"])
def test_an_integral_goes_no_further_into_a_limit(controller):
    """At full power 2 K are out of reach, and an error of 1 K stays; the command asks for hardly more than there is."""
    assert 1 < simulated(heater(0.0, 2.0), controller)["command_unclipped.u"][-1] < 1.1


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
    assert simulated(two_heaters(), controller)["state.b"][-1] == pytest.approx(0.3, abs=1e-3)
