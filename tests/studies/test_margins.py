"""Where controllers fail: limits that theory gives exactly, and what is said of them."""

import math
import re
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.contracts import Controller

RATE, PERIOD = 2.0, 0.02  # 1/s, s
BOUNDS = (1e-6, 1e6)


def pump(exact: float = 1.0, bounds: tuple[float, float] = BOUNDS, **changes: Any) -> fp.Problem:
    """Y' = b u with a model of gain 1, led from 1 m to rest at zero."""
    gain = fp.Parameter(1.0, exact, "m/(s V)", bounds=bounds)
    plant = fp.Plant({"y": "m"}, {"u": "V"}, {"b": gain}, lambda q, u, p: {"y": p.b * u.u}, order=1)
    settings = {"reference": fp.Trajectory(lambda t: {"y": 0 * t}), "start": {"y": 1.0}, "period": PERIOD}
    settings |= {"duration": 100.0, "measure_from": 80.0}
    return fp.Problem(plant=plant, **{**settings, **changes})


LAW = fp.ComputedTorque(fp.Exponential(rate=RATE, integral=False))
ADAPTIVE = LAW.with_deformation(fp.ModelReferenced(fp.Affine(gain=-0.8)))


def found(quantity: str, problem: fp.Problem, controller: Controller = LAW, **more: Any) -> Any:
    task = tasks.made(problem, {"law": controller})
    return fp.margins(task, over=[quantity], compiled=False, **more)


def limit_of(quantity: str, problem: fp.Problem, controller: Controller = LAW, **more: Any) -> Any:
    [row] = found(quantity, problem, controller, **more).table.itertuples()
    return row


def near(one: Any, value: float, share: float = 0.03) -> bool:
    """Whether a value lies between what holds and what fails, or so near that a run cannot show it; both are 5 % apart."""
    return one.holds * (1 - share) <= value <= one.fails * (1 + share) and one.fails <= 1.051 * one.holds


@pytest.mark.parametrize("order", [["latency", "lost"], ["lost", "latency"]])
def test_quantities_that_are_asked_together_have_the_limits_of_each_alone(order):
    problem = pump(duration=8.0, measure_from=2.0)
    task = tasks.made(problem, {"law": LAW})
    together = fp.margins(task, over=order, compiled=False).table.fails
    assert [*together] == [limit_of(one, problem).fails for one in order]


def test_mismatch_is_limited_by_the_sampled_law():
    """e+ = (1 - T b rate) e: stable up to b = 2 / (T rate); the mismatch f makes it 2^f."""
    assert near(limit_of("mismatch", pump(2.0)), math.log2(2 / (PERIOD * RATE)))


def test_mismatch_is_limited_by_the_gain_of_the_map():
    """delta+ = (1 - a b) delta - a (b - 1) d beside y+ = y + T b (d + delta), d = -rate y; by itself the map bears b < 2 / a."""
    gain = ADAPTIVE.deformation.effective_gain()

    def radius(b: float) -> float:
        a, law = gain, np.array([-RATE, 0.0, 0.0])  # of (y, last delta, last d)
        delta = np.array([0.0, 1 - a * b, -a * (b - 1)])
        rows = [np.array([1.0, 0, 0]) + PERIOD * b * (law + delta), delta, law]
        return float(np.abs(np.linalg.eigvals(np.array(rows))).max())

    limit = next(b for b in np.geomspace(2, 10, 4000) if radius(b) > 1)
    assert limit == pytest.approx(2 / gain, rel=0.1)
    assert near(limit_of("mismatch", pump(1.2), ADAPTIVE), math.log(limit) / math.log(1.2))


def test_drawn_plants_are_limited_by_the_largest_of_them():
    """Of a hundred factors up to 1 + P/100 around 0.7 of the limit of the sampled law the largest decides."""
    problem = pump(0.7 * 2 / (PERIOD * RATE), duration=15.0, measure_from=10.0)
    one = limit_of("plants", problem)
    drawn = [fp.Draws(100, percent).of_problem(problem) for percent in (one.holds, one.fails)]
    holds, fails = (max(variant.problem.plant.exact[0] for variant in some) for some in drawn)
    assert holds * 0.99 < 2 / (PERIOD * RATE) < fails * 1.01
    assert one.fails <= 1.051 * one.holds


def test_latency_is_limited_by_the_rate():
    """z^(n+1) - z^n + T rate has all roots inside as long as T rate < 2 sin(pi / (4 n + 2)): up to n = 38 cycles."""
    most = next(n for n in range(1, 100) if 2 * math.sin(math.pi / (4 * n + 6)) <= PERIOD * RATE)
    assert most == 38
    one = limit_of("latency", pump())
    assert abs(one.holds / PERIOD - most) <= 1.01  # one cycle more or less grows too little in this run to show
    assert one.fails == pytest.approx(one.holds + PERIOD)
    assert one.unit == "s"


def test_noise_is_limited_by_its_variance():
    """e+ = e - T rate (e + w): Var e = T rate s^2 / (2 - T rate), and the error is 0.1 of the range at s = 0.3 of it."""
    slow = {"period": 0.1, "duration": 1000.0, "measure_from": 20.0}
    problem = pump(reference=fp.Trajectory(lambda t: {"y": 0.5 * ca.sin(0.1 * t)}), start={"y": 0.0}, **slow)
    one = limit_of("noise", problem, fails=0.1)
    assert near(one, 0.1 * math.sqrt(2 / (0.1 * RATE) - 1), 0.05)
    assert 0.09 < one.error <= 0.1  # where it holds


def test_lost_samples_are_limited_by_the_held_command():
    """From sample to sample, n lost ones between, e' = (1 - share (1 + n)) e: stable where the mean of log |e' / e| is negative."""
    lost, share = np.arange(400), 1.5
    growths = np.log(np.abs(1 - share * (1 + lost)))
    limit = next(p for p in np.linspace(0.01, 0.9, 1000) if np.sum((1 - p) * p**lost * growths) > 0)
    law = fp.ComputedTorque(fp.Exponential(share / PERIOD, integral=False))
    assert near(limit_of("lost", pump(), law), limit, 0.05)


def test_mismatch_grows_up_to_the_bounds_of_the_parameter():
    """The factor of 'b' is (exact / approximate)^f, up to its bounds, which nothing needs to reach; a right model has none."""
    one = limit_of("mismatch", pump(2.0, (1e-6, 40.0)))
    assert one.holds == pytest.approx(math.log2(40.0), rel=0.02)
    assert one.fails == math.inf
    right = found("mismatch", pump())
    assert right.table.why[0] == "not tried: the model is right"
    assert right.view.sentences == []


def test_a_controller_that_fails_as_the_problem_stands():
    """Without feedback of the error a wrong start stays: the error is that of the start, all of the range."""
    one = found("lost", pump(), fp.ComputedTorque(fp.Exponential(rate=1e-9, integral=False)))
    assert math.isnan(one.table.holds[0])
    assert one.table.why[0] == "its error is 100 %"
    assert "as it stands" in one.view.tables[0].rows[0].cells


def test_a_state_that_leaves_its_limits_has_failed():
    """The error is small, and y passes the limit of 0.9 m that its reference keeps. Beside a limit of 0 its own size counts."""
    wave, limits = fp.Trajectory(lambda t: {"y": 0.8 * ca.sin(t)}), fp.Limits(states={"y": (-0.9, 0.9)})
    problem = pump(reference=wave, start={"y": 0.0}, limits=limits, duration=40.0, measure_from=0.0)
    assert limit_of("latency", problem).why == "a hard limit is left"
    touching = fp.Trajectory(lambda t: {"y": 0.4 * (1 - ca.cos(t))})
    above = replace(problem, reference=touching, limits=fp.Limits(states={"y": (0.0, math.inf)}))
    assert limit_of("latency", above).holds > 0


def test_what_each_bears_is_told():
    """Beside what fails up to where adaptation is better: a comparison with the same noise says so too."""
    wave = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    task = tasks.made(pump(1.2, reference=wave, duration=40.0, measure_from=10.0), {"law": LAW, "law+FPI": ADAPTIVE})
    one = fp.margins(task, over=["noise"], compiled=False)
    each = "; ".join(f"{r.controller} fails at {100 * r.fails:.3g} % of the range" for r in one.table.itertuples())
    [(text, _)] = one.view.sentences
    assert text.startswith("Noise: law+FPI beats law up to ")
    assert text.endswith(f": {one.beats['noise'][0].rpartition(': ')[2]}; {each}.")
    two = [float(value) / 100 for value in re.findall(r"([\d.]+) % of the range(?=[,:])", one.beats["noise"][0])]
    noisy = [replace(task.problem, sensing=fp.Sensing({"y": fp.Sensor(noise=fp.Noise(2 * v))})) for v in two]
    tried = [fp.compare(replace(task, problem=p), seed=0, compiled=False) for p in noisy]
    ratios = [one["law+FPI"].errors["y"] / one["law"].errors["y"] for one in tried]
    assert ratios[0] < 0.9 < ratios[1]
    assert [column.head for column in one.view.tables[1].columns] == ["noise [% of the range]", "law", "law+FPI"]
