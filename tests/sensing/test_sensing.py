"""Honest sensing: what noise, quanta, lost samples and estimators do to the loop, and what is refused before a run."""

import math
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.plants import chain, linear

import fpirhc as fp
from fpirhc.conformance import two_masses
from fpirhc.contracts import Signal
from fpirhc.errors import NotContractive

ESTIMATORS = (
    fp.Measured(),
    fp.VelocityDifference(),
    fp.LowPassDifference(time_constant=0.05),
    fp.PositionDifference(),
    fp.SavitzkyGolay(window=7, degree=4),
    fp.SavitzkyGolay(window=11, degree=5),
)
NOISE = fp.Sensor(noise=fp.Noise(1.0))
GENTLE = fp.Exponential(rate=0.01, integral=False)


def resting(plant, **others):
    """A plant to be held at zero."""
    settings: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {"y": 0 * t}),
        "start": {"y": 0.0},
        "period": 1e-3,
        "duration": 0.1,
    }
    return fp.Problem(plant=plant, **(settings | others))


def swinging(**others):
    """A plant with a wrong model on a sine."""
    motion = fp.Trajectory(lambda t: {"y": 0.5 * ca.sin(2 * t)})
    return resting(linear(1.0, 0.7), reference=motion, start={"y": 0.0, "y'": 1.0}, **others)


ADAPTIVE = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain=-0.5))


def run(problem, controller=ADAPTIVE, seed=0, compiled=False):
    return fp.simulate(problem, controller, seed=seed, compiled=compiled)


def test_coloured_noise_has_its_deviation_and_memory():
    """Standard deviation and correlation exp(-T / correlation time), within four standard deviations."""
    times = 1e-3 * np.arange(200_000)
    values = fp.Noise(deviation=2.0, correlation_time=5e-3).values(times, np.random.default_rng(0))
    decay = math.exp(-0.2)
    spread = 4 * math.sqrt(2 / times.size * (1 + decay**2) / (1 - decay**2))
    assert np.var(values) == pytest.approx(4.0, rel=spread)
    assert np.corrcoef(values[1:], values[:-1])[0, 1] == pytest.approx(decay, abs=4 / math.sqrt(times.size))


# Sensors in the loop


def test_nothing_and_zero_noise_are_the_ideal_loop():
    """The default, and sensors that add zero, give the ideal run bit by bit."""
    ideal = run(swinging())
    assert np.array_equal(run(swinging(sensing=fp.Sensing())).log, ideal.log)
    zero = run(swinging(sensing=fp.Sensing({"y''": fp.Sensor(noise=fp.Noise(0.0)), "y": fp.Sensor()})))
    for name in ("state", "realised", "deformed", "command", "error"):
        assert np.array_equal(zero[name], ideal[name])
    assert np.array_equal(zero["plant_state"], ideal["state"])


def test_quantised_values_are_multiples_of_the_quantum():
    result = run(swinging(sensing=fp.Sensing({"y": fp.Sensor(quantum=1 / 1024)})))
    counts = result["state.y"] * 1024
    np.testing.assert_array_equal(counts, np.round(counts))
    assert np.abs(result["state.y"] - result["plant_state.y"]).max() <= 0.5 / 1024
    assert np.unique(counts).size > 10


def test_lost_samples_are_skipped_cycles_that_show_the_last_sample():
    """As often as asked for, the first one being the start."""
    result = run(swinging(sensing=fp.Sensing({"y'": fp.Sensor(dropout=0.3)}), duration=2.0))
    seen, true = result["state.y'"], result["plant_state.y'"]
    lost = result["status"].ravel() == fp.Status.BAD_SAMPLE
    assert np.array_equal(seen[~lost], true[~lost])
    assert np.array_equal(seen[1:][lost[1:]], seen[:-1][lost[1:]])
    assert lost.mean() == pytest.approx(0.3, abs=4 * math.sqrt(0.3 * 0.7 / lost.size))


def test_series_belong_to_the_seed_and_to_the_sensor():
    """Same seed same run, other seed other noise; another sensor or disturbance leaves a sensor's noise as it is."""
    noisy = swinging(sensing=fp.Sensing({"y": NOISE}))
    first = run(noisy, seed=1)
    assert np.array_equal(run(noisy, seed=1).log, first.log)
    drawn = first["measured.y"] - first["plant_state.y"]
    other = run(noisy, seed=2)
    assert not np.allclose(other["measured.y"] - other["plant_state.y"], drawn)
    more = replace(noisy, disturbances={"u": fp.Noise(0.1)}, sensing=fp.Sensing({"y": NOISE, "y'": NOISE}))
    third = run(more, seed=1)
    np.testing.assert_allclose(third["measured.y"] - third["plant_state.y"], drawn, atol=1e-12)
    assert not np.allclose(third["measured.y'"] - third["plant_state.y'"], drawn)


def test_order_of_sensor_dead_time_and_controller():
    """The controller is given what the sensor showed three cycles ago; the run is judged by the true error."""
    problem = swinging(sensing=fp.Sensing({"y": NOISE}), dead_time=fp.DeadTime(measurement=3e-3))
    result = run(problem)
    assert np.array_equal(result["state.y"][3:], result["measured.y"][:-3])
    assert result["true_error.y"] == pytest.approx(result["reference.y"] - result["plant_state.y"])
    assert fp.measure(problem, result)["max_error"]["y"] == np.abs(result["true_error.y"]).max()


# Estimators


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("estimator", [*ESTIMATORS[1:-1]], ids=str)
def test_response_is_the_stated_average_of_requests(estimator, order):
    """On y^(n) = held requests the estimate is sum w_j r_{k-j}, the weights sum to one, and their centre is the delay."""
    period, plant = 0.1, chain(order)
    requests = np.random.default_rng(order).normal(size=200)
    weights = estimator.weights(order, period)
    assert weights.sum() == pytest.approx(1.0)
    assert (weights * np.arange(weights.size)).sum() == pytest.approx(late(estimator, order), abs=1e-6)
    result = estimated(estimator, plant, period, trajectory(plant, period, requests))[1]
    expected = np.convolve(requests, weights)[: requests.size]
    first = weights.size if isinstance(estimator, fp.LowPassDifference) else estimator.fills(order)
    np.testing.assert_allclose(result[first:], expected[first - 1 : -1], atol=1e-6)


def late(estimator, order):
    """Cycles beyond the ideal pair, by the formulas of the page."""
    window, pole = getattr(estimator, "window", None), getattr(estimator, "pole", lambda _: 0.0)(0.1)
    differences = (order - 1) / 2 if isinstance(estimator, fp.PositionDifference) else pole / (1 - pole)
    return window / 2 - 1 if window else differences


def trajectory(plant, period, requests):
    """States before every request and after the last one, from rest."""
    step = fp.RungeKutta4().step(plant, period)
    rows = [np.zeros(plant.state.size)]
    for request in requests[:-1]:
        rows.append(step(rows[-1], request, plant.exact, 0).full().ravel())
    return np.array(rows)


def estimated(estimator, plant, period, states):
    """States and responses that the estimator makes of true states, given where it measures them."""
    measures = estimator.measures(plant)
    block = estimator.block(plant, period, states[0], Signal("seen", measures))
    memory = [s.start_vector() for s in block.memory.signals]
    places, collected = [plant.state.elements.index(m) for m in measures], []
    for row in states:
        state, response, *memory = block.function.call([row[places], *memory])
        collected.append((state.full().ravel(), float(response)))
    return np.array([s for s, _ in collected]), np.array([r for _, r in collected])


ORDERS = [(fp.SavitzkyGolay(size, degree), degree) for size, degree in ((7, 2), (9, 3), (21, 5))]


@pytest.mark.parametrize(("estimator", "degree"), [(fp.PositionDifference(), 2), *ORDERS], ids=str)
def test_polynomials_up_to_the_degree_are_met_exactly(estimator, degree):
    """The response at the window's centre; Savitzky-Golay also the state at the newest sample, without any delay."""
    plant, period, size = chain(2), 0.05, 40
    motion = np.polynomial.Polynomial(np.random.default_rng(degree).normal(size=degree + 1))
    times = period * np.arange(size)
    states = np.column_stack([motion(times), motion.deriv()(times)])
    state, response = estimated(estimator, plant, period, states)
    first = estimator.fills(2)
    # Half a cycle less: a difference over a window belongs to its middle, the ideal pair to half a cycle ago.
    middle = times[first:] - (late(estimator, 2) + 0.5) * period
    np.testing.assert_allclose(response[first:], motion.deriv(2)(middle), atol=1e-8)
    if isinstance(estimator, fp.SavitzkyGolay):
        np.testing.assert_allclose(state[first:], states[first:], atol=1e-9)


@pytest.mark.parametrize("estimator", [e for e in ESTIMATORS[1:] if not isinstance(e, fp.LowPassDifference)], ids=str)
def test_deformation_waits_for_the_window(estimator):
    """Until the window holds samples of the run alone the request is the desired response; estimates are finite from the first."""
    problem = swinging(sensing=fp.Sensing(estimator=estimator), duration=0.05)
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain=-0.05))
    result, blind = run(problem, controller), problem.warm_up_cycles
    assert blind == estimator.fills(2)
    assert np.array_equal(result["deformed"][:blind], result["desired"][:blind])
    assert (result["deformed"][blind:] != result["desired"][blind:]).all()
    # The start's velocity of 1 m/s is known from the first cycle on.
    assert result["state.y'"][0] == pytest.approx(1.0)


# Stability


def limit_of(weights: np.ndarray, pairing: float) -> float:
    """Largest a for which z = z^-d - a sum w_j z^-j has no root outside the unit circle, by numpy's roots."""
    size, whole, part = max(len(weights), math.ceil(pairing) + 1), math.floor(pairing), pairing % 1
    before = np.zeros(size + 1)
    before[whole] += 1 - part
    before[whole + 1] += part
    low, high = 0.0, 4.0
    for _ in range(50):
        a = (low + high) / 2
        polynomial = np.concatenate([[1.0], -before]) + a * np.pad(weights, (1, size + 1 - len(weights)))
        low, high = (a, high) if np.abs(np.roots(polynomial)).max() < 1 + 1e-9 else (low, a)
    return low


@pytest.mark.parametrize("estimator", ESTIMATORS[3:], ids=str)
@pytest.mark.parametrize("paired", [False, True])
def test_limit_is_that_of_the_characteristic_polynomial(estimator, paired):
    """3 % below the limit a gain is accepted and its loop is stable, 3 % above it is refused."""
    sensing, start = fp.Sensing(estimator=estimator), {"y": 0.0, "y'": 1.0}
    problem = resting(linear(1.0, 0.8), start=start, duration=2.0, sensing=sensing)
    cycles = problem.response_delay if paired else 0.0
    limit = 0.8 * limit_of(estimator.weights(2, problem.period), cycles)
    assert limit > 0
    below, above = (fp.Paired(fp.Affine(gain=-2 * share * limit), cycles=cycles) for share in (0.97, 1.03))
    result = run(problem, fp.ComputedTorque(GENTLE, below))
    parts = np.array_split(np.abs(result["realised.y"] - result["desired.y"]), 4)
    assert parts[3].max() < parts[1].max()
    with pytest.raises(NotContractive):
        run(problem, fp.ComputedTorque(GENTLE, above))


WINDOW = fp.Sensing(estimator=fp.SavitzkyGolay(window=31, degree=2))


def test_delay_that_makes_the_loop_unstable_is_refused_with_remedies_that_are_accepted():
    problem, tracking, wild = swinging(sensing=WINDOW), fp.Exponential(rate=6.0), fp.Affine(gain=-0.6)
    limit = 0.7 * limit_of(WINDOW.estimator.weights(2, 1e-3), 0.0)
    with pytest.raises(NotContractive) as refused:
        run(problem, fp.ComputedTorque(tracking, wild))
    for part in ("14.5 cycles", f"with: 0 < |gain| < {2 * limit:.3g}", "Paired(map, cycles=14.5)", "shorter window"):
        assert part in str(refused.value)
    shorter = replace(problem, sensing=fp.Sensing(estimator=fp.SavitzkyGolay(window=5, degree=2)))
    paired = fp.Paired(wild, cycles=problem.response_delay)
    for accepted, deformation in ((problem, fp.Affine(gain=-1.8 * limit)), (problem, paired), (shorter, wild)):
        assert run(accepted, fp.ComputedTorque(tracking, deformation)).stop is None
    # A comparison has the same limit; where neither law follows it has none. Behind the delay the run shows no factor.
    laws = {"law": fp.ComputedTorque(tracking), "FPI": fp.ComputedTorque(tracking, fp.Affine(gain=-0.9 * limit))}
    lost = replace(problem, limits=fp.Limits(inputs={"u": (0.0, 0.01)}), duration=4.0)
    tried = [fp.compare(tasks.made(one, laws), seed=0, compiled=False) for one in (problem, lost)]
    held, left = (one["FPI"].contraction.said("FPI" in one.lost) for one in tried)
    assert f"iteration alone converges for a negative gain, 0 < |gain| < {2 * limit:.3g}; the loop may bear" in held
    assert not any("The run shows" in one for one in (held, left))
    assert "alone converges" not in left
    assert tried[0]["FPI"].contraction.report.linear_limit == pytest.approx((0, limit), rel=1e-3)


def test_dead_time_counts_but_is_not_judged_alone():
    """With ideal sensing nothing is refused; with an estimator the pairing has to cover both delays."""
    late = swinging(dead_time=fp.DeadTime(measurement=1e-2), duration=0.02)
    wild = fp.ComputedTorque(fp.Exponential(rate=1.0), fp.Affine(gain=-1.0))
    run(late, wild)
    window = replace(late, sensing=fp.Sensing(estimator=fp.SavitzkyGolay(window=5, degree=2)))
    with pytest.raises(NotContractive, match=r"11.5 cycles late \(dead time 10, Sav.* 1.5\).*Paired\(map, cycles=11"):
        run(window, wild)
    run(window, fp.ComputedTorque(fp.Exponential(rate=1.0), fp.Paired(fp.Affine(gain=-1.0), cycles=11.5)))


# Another reality begins with its own estimates


def sensed_slowly(gain: float) -> fp.Problem:
    """Y'' = u / m, whose position is seen through s' = (g y - s) / 20 ms; the sensor rests at the start."""
    mass = {"m": fp.Parameter(1.0, 1.0, "kg")}
    plant = fp.Plant({"y": "m"}, {"u": "N"}, mass, lambda q, v, u, p: {"y": u.u / p.m})
    real = fp.Plant(
        coordinates={"y": "m", "s": "m"},
        inputs={"u": "N"},
        order={"y": 2, "s": 1},
        parameters={**mass, "g": fp.Parameter(1.0, gain, "1")},
        response=lambda q, v, u, p: {"y": u.u / p.m, "s": (p.g * q.y - q.s) / 0.02},
        controlled=("y",),
    )
    more = {"sensing": fp.Sensing(estimator=fp.PositionDifference()), "limits": fp.Limits(inputs={"u": (-50.0, 50.0)})}
    more |= {"horizon": fp.Horizon(stages=5, step=0.01), "cost": fp.Quadratic({"y": 1e2}, deviation={"u": 0.1})}
    more |= {"reality": fp.Reality(real, start={"s": 0.1 * gain}, seen={"y": "s"})}
    moved = fp.Trajectory(lambda t: {"y": 0.1 + 0.05 * ca.sin(t)})
    return fp.Problem(plant, moved, {"y": 0.1}, period=5e-3, duration=0.1, **more)


def test_another_reality_begins_with_its_own_estimates():
    """A simulator that is given other exact parameters starts its estimator where a simulator built for them does."""
    task, other = sensed_slowly(gain=1.0), sensed_slowly(gain=1.3)
    for law in (
        ADAPTIVE.with_deformation(fp.ModelReferenced(fp.Affine(gain=-0.05))),
        fp.RecedingHorizon(fp.FixedPointSolver(1, 1e-3)),
    ):
        shared = fp.simulator(task, law, compiled=False).run(seed=0, variant=other)
        own = run(other, law)
        assert np.array_equal(shared["state"], own["state"])
        assert np.array_equal(shared["command"], own["command"])
        assert abs(shared["state.y"][0] - 1.3 * 0.1) < 1e-12


# What is wrong with sensing is said where it is stated: what, where, what was expected, and how to mend it

FIT, KALMAN = fp.SavitzkyGolay, fp.KalmanFilter(measured={"y": 0.1}, noise={"y": 1.0})


def task(**sensing: Any) -> fp.Problem:
    return resting(linear(1.0, 0.7), sensing=fp.Sensing(**sensing))


def of_output(**sensing: Any) -> fp.Problem:
    plant = fp.Plant.of_states(
        states={"C": "mg/l", "E": "mg/l"},
        inputs={"u": "mg/l/min"},
        parameters={},
        rates=lambda x, u, p: {"C": u.u - x.C, "E": 0.5 * (x.C - x.E)},
        outputs={"depth": fp.Output("1", lambda x, p: 93 / (1 + x.E))},
    )
    still, start = fp.Trajectory(lambda t: {"depth": 0 * t}), {"C": 1.5, "E": 1.5}
    sensing = {"estimator": fp.PositionDifference(), "measured": ["depth"]} | sensing
    return resting(plant, reference=still, start=start, sensing=fp.Sensing(**sensing))


def stepped(call: str, *arguments: Any) -> None:
    one = fp.Stepper(task(estimator=fp.PositionDifference()), fp.ComputedTorque(fp.Exponential(6.0)), compiled=False)
    getattr(one, call)(0.0, *arguments, one.start())


WRONG: dict[str, tuple[Any, str]] = {
    "deviation": (lambda: fp.Noise(-1.0), "Noise.deviation: expected a finite number of at least 0"),
    "no deviation": (lambda: fp.Noise(math.nan), "got nan"),
    "a number for noise": (lambda: fp.Sensor(noise=0.1), "Sensor.noise: expected a Disturbance or None, got 0.1"),  # type: ignore[arg-type]
    "quantum": (lambda: fp.Sensor(quantum=0.0), "Sensor.quantum: expected a finite number above 0"),
    "two mistakes": (lambda: fp.Sensor(quantum=-1.0, dropout=1.0), "dropout: expected a number from 0 to below 1"),
    "range": (lambda: fp.Sensor(range=(1.0, 0.0)), "lower < upper"),
    "range of what is followed": (
        lambda: task(sensors={"y": fp.Sensor(range=(0.5, 0.9))}),
        "the reference of 'y' goes from 0 to 0, but its sensor shows 0.5 to 0.9",
    ),
    "even window": (lambda: FIT(window=10, degree=2), "use 9 or 11"),
    "smallest window": (lambda: FIT(window=2, degree=1), "at least 3 samples for degree 1; use 3"),
    "short window": (lambda: FIT(window=3, degree=3), "at least 5"),
    "window of a float": (lambda: FIT(window=5.0, degree=2), "expected a whole number from 1 to 1001, got 5.0"),  # type: ignore[arg-type]
    "low degree": (lambda: task(estimator=FIT(5, 1)), "use a degree of at least 2"),
    "time constant": (lambda: fp.LowPassDifference(time_constant=0.0), "VelocityDifference()"),
    "pole": (lambda: fp.Filtered(fp.Affine(gain=-1.0), pole=1.0), "pole: expected a number from 0 to below 1, got 1.0"),
    "sensor of nobody": (lambda: task(sensors={"yy": fp.Sensor()}), "quantity 'yy' is unknown. Did you mean 'y"),
    "sensor of an estimate": (
        lambda: task(sensors={"y'": fp.Sensor()}, estimator=FIT(5, 2)),
        "'y'' is estimated by SavitzkyGolay, not measured; sensors are those of y",
    ),
    "measured name": (lambda: task(measured=["Y"], observer=KALMAN), "measured: quantity 'Y'"),
    "no observer": (
        lambda: task(measured=["y"], estimator=fp.Measured()),
        "also needs y', y''; measure it, or estimate it by an observer",
    ),
    "filter of what no sensor shows": (
        lambda: task(measured=["y"], observer=fp.KalmanFilter(measured={"y'": 0.1}, noise={"y": 1.0})),
        "no sensor shows 'y''; Sensing(measured=...) has y",
    ),
    "noise of nobody": (
        lambda: task(measured=["y"], observer=fp.KalmanFilter(measured={"y": 0.1}, noise={"yy": 1.0})),
        "noise: coordinate 'yy' is unknown. Did you mean 'y'",
    ),
    "no noise": (lambda: fp.KalmanFilter(measured={"y": 0.1}, noise={}), "name at least one"),
    "a state of outputs": (
        lambda: of_output(measured=["depth", "C"]),
        "C is given as it is to controllers of a plant with outputs, unless an observer is stated",
    ),
    "filter of a state behind outputs": (
        lambda: of_output(observer=fp.KalmanFilter(measured={"C": 0.1}, noise={"C": 1.0})), "no sensor shows 'C'"
    ),
    "estimates for samples": (lambda: stepped("step", np.zeros(2), np.zeros(1)), "use step_measured(time, measured, memory)"),
    "samples": (lambda: stepped("step_measured", np.zeros(3)), "'measured' has 1 entries"),
    "samples of two": (
        lambda: fp.Stepper(two_masses(), fp.ComputedTorque(fp.Exponential(6.0)), compiled=False).step_measured(
            0.0, np.zeros(4), np.zeros(9)
        ),
        "'measured' has 6 entries",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_wrong_sensing_says_what_was_expected(name):
    make, words = WRONG[name]
    with pytest.raises(fp.FpirhcError) as caught:
        make()
    assert words in " ".join(str(caught.value).split())
