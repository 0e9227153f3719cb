"""The null test of a review: with its own model as the plant a controller with adaptation must not do worse than without."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import reviewed, tasks

import fpirhc as fp
from fpirhc.contracts import Controller, Deformation

POLE = 86.7  # 1/s
MAP = fp.Affine(gain=-1.0)
LAG = 0.02  # s


def drifting(*, exact: float = POLE) -> fp.Problem:
    """Y' = -p y + p u behind a pole that is fast against the period, along a sine: .43 of it passes in a cycle."""
    pole = {"p": fp.Parameter(POLE, exact, "1/s")}
    plant = fp.Plant({"y": "m"}, {"u": "m"}, pole, lambda y, u, p: {"y": p.p * (u.u - y.y)}, order=1)
    plan = {"horizon": fp.Horizon(10, 0.005), "cost": fp.Quadratic({"y": 1.0}, deviation={"u": 1e-3})}
    sine = fp.Trajectory(lambda t: {"y": ca.sin(8 * t)})
    return fp.Problem(plant, sine, {"y": 0.0}, period=0.005, duration=2.0, measure_from=1.0, **plan)


def planned(*deformation: Deformation) -> Controller:
    return fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-3), *deformation)


def alone(problem: fp.Problem, controller: Controller) -> Any:
    return reviewed.answers(problem, controller)["model"]


def rms(problem: fp.Problem, controller: Controller) -> float:
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    assert run.stop is None
    return float(np.sqrt(np.mean(run["error"][run.time >= problem.measure_from] ** 2)))


def test_a_period_that_is_long_against_the_plant_fails():
    """The plain form takes the drift within a cycle for an error. The answer has the errors that runs show."""
    problem = drifting()
    found = alone(problem, planned(MAP))
    assert found.verdict == "no"
    assert found.numbers["error_without"] == pytest.approx(rms(problem, planned()), rel=0.02)
    assert found.numbers["error_with"] == pytest.approx(rms(problem, planned(MAP)), rel=0.02)
    assert found.numbers["error_with"] > 5 * found.numbers["error_without"]


@pytest.mark.parametrize(
    ("late", "gain", "verdict"), [(0.0, -1.0, "yes"), (0.01, -0.298, "caution"), (0.01, -0.4, "no")]
)
def test_masses_that_do_not_drift_pass_until_a_dead_time_is_not_paired(late, gain, verdict):
    """Without a spring there is no drift within a cycle: the plain form leaves a right model; the second makes 1.6 of the error."""
    problem = reviewed.mass(dead_time=fp.DeadTime(inputs={"u": late})) if late else reviewed.mass()
    controller = fp.ComputedTorque(fp.Exponential(rate=5.0), fp.Affine(gain))
    assert alone(problem, controller).verdict == verdict


def test_a_null_test_goes_on_until_errors_count():
    """The input is too weak for the start, so the first cycles show nothing; the plain form disturbs a right model later."""
    strong = {"b": fp.Parameter(1.0, 1.5, "1")}
    plant = fp.Plant({"y": "m"}, {"u": "m/s"}, strong, lambda y, u, p: {"y": p.b * u.u}, order=1)
    sine, lasts = fp.Trajectory(lambda t: {"y": 0.1 * ca.sin(t)}), {"duration": 10.0, "measure_from": 8.0}
    problem = fp.Problem(plant, sine, {"y": 1.0}, 1e-3, **lasts, limits=fp.Limits({"u": (-0.4, 0.4)}))
    law = fp.ComputedTorque(fp.Exponential(rate=5.0, integral=False, bumpless=False), fp.Affine(gain=-0.05))
    found = alone(problem, law)
    right = replace(problem, plant=replace(plant, parameters={"b": fp.Parameter(1.0, 1.0, "1")}))
    both = fp.ComputedTorque(law.tracking), law
    pair = [fp.measure(right, fp.simulate(right, one, seed=0, compiled=False)).rms_error["y"] for one in both]
    assert [found.numbers["error_without"], found.numbers["error_with"]] == pytest.approx(pair, rel=1e-6)


def test_a_null_test_has_the_sensors_of_the_problem_and_the_errors_of_a_comparison():
    seen, law = fp.Sensing({"q": fp.Sensor(fp.Noise(1e-4), quantum=1e-4)}, fp.SavitzkyGolay(15, 2)), fp.Exponential(6.0)
    problem, laws = reviewed.mass(sensing=seen), {"CTC": fp.ComputedTorque(law)}
    laws |= {"CTC+FPI": fp.ComputedTorque(law, fp.ModelReferenced(fp.Affine(-0.2)))}
    null = fp.compare(tasks.made(problem, laws), seed=0, compiled=False).entries[1].null
    told = alone(problem, laws["CTC+FPI"])
    assert [told.numbers["error_without"], told.numbers["error_with"]] == [null.without["q"], null.adapted["q"]]
    assert f"with the problem's sensors, {null.sentence}" in told.evidence


def test_harm_is_a_no_however_small_the_errors_are():
    """A mass rests at its set-point and its command is late: all errors are below a thousandth of the way there."""
    ratios, law = [], fp.Exponential(6.0)
    for seed in range(6):
        speed, gain, cycles = np.random.default_rng(seed).uniform((1.5, -0.5, 1), (3, -0.05, 3)).tolist()
        motion = fp.Trajectory(lambda t, w=speed: {"q": 0.5 - 0.5 * ca.exp(-((w * t) ** 2))})
        late = {"u": 0.01 * round(cycles)}
        problem = reviewed.mass(reference=motion, period=0.01, measure_from=2.0, dead_time=fp.DeadTime(late))
        own = fp.ComputedTorque(law, fp.ModelReferenced(fp.Affine(gain)))
        runs = [fp.simulate(problem, one, seed=0, compiled=False) for one in (own, fp.ComputedTorque(law))]
        ratios.append(np.divide(*(fp.measure(problem, run).rms_error["q"] for run in runs)))
        assert (reviewed.answers(problem, own)["pays"].verdict == "no") == (ratios[-1] > 1.2), (seed, ratios)
    assert sum(ratio > 1.2 for ratio in ratios) == 2


def lagging() -> fp.Reality:
    """A mass on a spring behind an actuator: tau du/dt = u_c - u."""
    known, order = {"m": fp.Parameter(1.5, 1.0, "kg")}, {"q": 2, "acting": 1}
    moves = lambda q, v, u, p: {"q": (q.acting - 10 * q.q) / p.m, "acting": (u.u - q.acting) / LAG}  # noqa: E731
    behind = fp.Plant({"q": "m", "acting": "N"}, {"u": "N"}, known, moves, order=order)
    return fp.Reality(behind, start={"q": 0.0, "q'": 1.5, "acting": 0.0})


def believed(reality: fp.Reality | None, form: Deformation) -> Any:
    law = fp.ComputedTorque(fp.Exponential(rate=6.0), form)
    return alone(reviewed.mass(measure_from=1.0, reality=reality), law)


@pytest.mark.parametrize("reality", [None, lagging()])
def test_a_believed_lag_is_a_part_of_the_right_model(reality):
    """Beside a plant without lag and beside a real one: it leaves a right model alone, and no form is advised."""
    answer = believed(reality, fp.ModelReferenced(fp.Affine(gain=-0.4), lag=LAG))
    assert (answer.verdict, answer.change) == ("yes", ""), answer
    assert answer.numbers["error_with"] == pytest.approx(answer.numbers["error_without"], rel=1e-3)


def test_a_believed_dead_time_is_a_part_of_the_right_model_too():
    """Where the problem states none; a dead time that it states is a fact."""
    assert believed(None, fp.ModelReferenced(fp.Affine(gain=-0.4), cycles=5.0, measurement=2.0)).verdict == "yes"
