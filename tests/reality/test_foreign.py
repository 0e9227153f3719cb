"""A foreign reality: an object outside, called once per cycle; what it may do wrong, and what a run then keeps."""

import math
import re
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.drives import CONTROLLERS, MEASURES, PAIRS, SENSING, Wrapped, lagged, run, task

import fpirhc as fp
from fpirhc.contracts import Deformation
from fpirhc.errors import InvalidProblem


class Faulty(Wrapped):
    """The same, with bad answers in some cycles."""

    def __init__(self, problem, bad, at=range(100, 101)) -> None:
        super().__init__(problem)
        self.bad, self.at = bad, at

    def step(self, time, command):
        good = super().step(time, command)
        return self.bad(good) if self.calls in self.at else good


def broken(answer):
    """What a lost connection does."""
    del answer
    raise OSError("cable is out")


BAD: dict[str, tuple[Any, str]] = {
    "raises": (broken, "step of Faulty raised OSError: cable is out"),
    "wrong shape": (lambda a: a[:2], r"returned the shape \(2,\), expected 3 numbers: y, y', y''"),
    "no number": (lambda a: a * [1, np.nan, 1], "returned y' = nan, expected a finite number"),
    "text": (lambda _: "on", "returned 'on', expected 3 numbers: y, y', y''"),
    "masked": (lambda a: np.ma.masked_array(a, [True, False, False]), "returned y = nan, expected a finite number"),
    "truth values": (lambda a: a > 0, r"returned array\(.*, expected 3 numbers"),
    "nothing": (lambda _: None, "returned None, expected 3 numbers"),
    "complex": (lambda a: a * 1j, "expected 3 numbers"),
    "ragged": (lambda a: [a, 1.0], "raised ValueError"),
}


def outside(problem: fp.Problem, **settings) -> fp.Problem:
    """The problem with its own plant outside."""
    return replace(problem, reality=fp.ExternalPlant(Wrapped(problem), measures=MEASURES, **settings))


@pytest.mark.parametrize(("controller", "sensing"), [pair for pair in PAIRS if pair[1] != "late"])
def test_wrapped_plant_runs_as_the_plant_itself(controller, sensing):
    """Every signal that both runs have agrees, also behind an estimator and noisy sensors, up to the rounding of the time."""
    problem = task(**SENSING[sensing], disturbances={"u": fp.Formula(lambda t: 1.0 * ca.sin(2 * np.pi * 2.0 * t))})
    one, other = (run(p, CONTROLLERS[controller]) for p in (problem, outside(problem)))
    assert other.stop is None
    for name in one.layout.names:
        size = max(1.0, np.abs(one[name]).max())
        assert np.abs(one[name] - other[name]).max() <= 1e-9 * size, name
    assert set(other.layout.names) - set(one.layout.names) - {"lost_sample"} == {"foreign", "foreign_held"}


def test_a_late_measurement_stands_around_the_body():
    """It is that of the loop, whatever the body does."""
    problem = task(dead_time=fp.DeadTime(measurement=0.001))
    one, other = (run(p, CONTROLLERS["computed torque"]) for p in (problem, outside(problem)))
    assert np.abs(one["plant_state"] - other["plant_state"]).max() < 1e-12


class Late(Wrapped):
    """The same, acting two cycles after a command."""

    def reset(self, seed):
        """With the inputs before on their way."""
        self.waiting = [np.array(self.problem.inputs_before)] * 2
        return super().reset(seed)

    def step(self, time, command):
        """The step under the command of two cycles before."""
        self.waiting.append(command)
        return super().step(time, self.waiting.pop(0))


@pytest.mark.parametrize("name", ["computed torque", "predicted"])
def test_a_dead_time_of_the_body_is_known_and_not_simulated(name):
    """The run is the one in which the loop delays the commands; a controller that predicts over it does so in both."""
    law = CONTROLLERS["computed torque"]
    controller = fp.Predicted(law, inputs=0.002) if name == "predicted" else law
    problem = task(dead_time=fp.DeadTime(inputs={"u": 0.002}))
    own = replace(problem, reality=fp.ExternalPlant(Late(task()), measures=MEASURES))
    assert own.response_delay == problem.response_delay == 2
    inside, outside_ = run(problem, controller), run(own, controller)
    for signal in ("plant_state", "command"):
        assert np.abs(inside[signal] - outside_[signal]).max() <= 1e-9 * np.abs(inside[signal]).max()


def test_positions_alone_are_enough_for_an_estimator():
    """A body that measures y only runs with an estimator; errors are then those of the estimate."""
    problem = task(sensing=fp.Sensing(estimator=fp.PositionDifference()))
    foreign = fp.ExternalPlant(Wrapped(problem, ("y",)), measures=["y"])
    one, other = run(problem), run(replace(problem, reality=foreign))
    assert np.abs(one["command"] - other["command"]).max() < 1e-9 * np.abs(one["command"]).max()
    assert np.array_equal(other["foreign.y"], other["measured.y"])
    assert other.layout["foreign"].entry_units == ("m",)


@pytest.mark.parametrize("kind", BAD)
def test_bad_answer_ends_the_run_and_loses_nothing(kind):
    """A hundred good answers are kept; the reason names the method, what it did, and when."""
    bad, message = BAD[kind]
    problem = task()
    result = run(replace(problem, reality=fp.ExternalPlant(Faulty(problem, bad), MEASURES)))
    assert result.stop is not None
    assert re.search(message, result.stop)
    assert "at t = 0.1 s (cycle 100)" in result.stop
    assert result.stop.endswith("ExternalPlant(holds=1) bridges a bad answer with the last good one")
    assert result.cycles == 100
    assert np.array_equal(result["command"], run(outside(problem))["command"][:100])


def test_an_implausible_answer_is_a_skipped_cycle():
    """A body that answers 1e9 m once, out of range: the command is held, and the run goes on as if nothing had been."""
    problem = replace(task(), sensing=fp.Sensing({"y": fp.Sensor(range=(-5.0, 5.0))}))
    body = Faulty(problem, lambda answer: np.full_like(answer, 1e9))
    spiked, clean = run(replace(problem, reality=fp.ExternalPlant(body, MEASURES))), run(outside(problem))
    assert spiked.stop is None
    assert np.flatnonzero(spiked["status"] == fp.Status.BAD_SAMPLE).tolist() == [100]
    assert np.array_equal(spiked["command"][100], spiked["command"][99])
    assert np.array_equal(spiked["command"][:100], clean["command"][:100])
    assert np.abs(spiked["state"][101:]).max() < 10.0
    assert np.abs(spiked["state"][-1] - clean["state"][-1]).max() < 1e-3


@pytest.mark.parametrize("kind", BAD)
def test_bad_answers_are_held_as_stated(kind):
    """Two bad answers are bridged with the last good one and marked; the third ends the run."""
    problem = task()
    bad = BAD[kind][0]
    two = run(replace(problem, reality=fp.ExternalPlant(Faulty(problem, bad, range(100, 102)), MEASURES, holds=2)))
    assert two.stop is None
    assert np.flatnonzero(two["foreign_held"]).tolist() == [100, 101]
    assert np.array_equal(two["state"][100:102], two["state"][[99, 99]])
    assert np.flatnonzero(two["status"] == fp.Status.BAD_SAMPLE).tolist() == [100, 101]  # as a lost sample of a machine
    assert np.array_equal(two["command"][100:102], two["command"][[99, 99]])
    three = run(replace(problem, reality=fp.ExternalPlant(Faulty(problem, bad, range(100, 103)), MEASURES, holds=2)))
    assert three.cycles == 102
    assert str(three.stop).endswith("after 2 in a row that were held; ExternalPlant(holds=3) bridges one more")


def test_bad_first_answer_is_an_error():
    """There is nothing to keep before the first answer."""
    problem = task()
    body = Wrapped(problem, ("y",))
    with pytest.raises(InvalidProblem, match="reset of Wrapped returned the shape"):
        run(replace(problem, reality=fp.ExternalPlant(body, MEASURES)))


# A body that is made from parameters


class Driven(Wrapped):
    """The linear plant with a gain of its own."""

    def __init__(self, problem, gain) -> None:
        super().__init__(problem)
        self.gain = gain

    def _rate(self, x, u):
        return np.array([x[1], self.gain * u[0]])


GAIN = {"b": fp.Parameter(approximate=1.0, exact=2.0, unit="1/kg", bounds=(0.1, 10.0))}


def made(problem: fp.Problem, seeds: list[int] | None = None, **settings) -> fp.Problem:
    """The problem with a body that is made for every run."""

    def make(parameters, seed):
        if seeds is not None:
            seeds.append(seed)
        return Driven(problem, parameters["b"])

    return replace(problem, reality=fp.ExternalPlant(make=make, parameters=GAIN, measures=MEASURES, **settings))


def test_a_made_body_is_new_in_every_run_and_has_its_seed():
    """The function is called once per run, with the seed of the run and the exact values."""
    seeds: list[int] = []
    problem = made(task(), seeds)
    first = run(problem)
    weaker = run(problem.with_exact(np.array([1.0])))
    assert seeds == [0, 0]
    assert np.array_equal(first["plant_state"], run(outside(task()))["plant_state"])
    assert not np.array_equal(first["plant_state"], weaker["plant_state"])


def test_contraction_is_identified_where_the_response_is_measured():
    """The run's own requests and responses give the factor 1 - a b / b^ without any equation of the body."""
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain=-0.5))
    problem = outside(task(start={"y": 0.3}))
    factor = fp.measure(problem, run(problem, controller))["contraction.measured"][""]
    assert factor == pytest.approx(1 - controller.deformation.effective_gain() * 2.0, abs=0.02)


def test_nobody_has_the_exact_model_of_a_plant_outside():
    """Parameters that are equal in the file say nothing of the plant: the row without adaptation is no bound of the others."""
    laws = {"law": fp.ComputedTorque(fp.Exponential(rate=6.0)), "fast": fp.ComputedTorque(fp.Exponential(rate=9.0))}
    known = task(start={"y": 0.3})
    known = outside(known.with_exact(known.plant.approximate))
    found = fp.compare(tasks.made(known, laws), seed=0, compiled=False)
    assert [e.exact for e in found.entries] == [False, False]


def test_a_gain_that_changes_during_a_run_acts_from_that_cycle_on():
    """The commands before are those of the run without the change."""
    ready = fp.simulator(outside(task(duration=0.1)), CONTROLLERS["plain form"], compiled=False, live=["tracking.rate"])
    before, after = (ready.run(seed=0, changes=one)["command.u"] for one in (None, {0.05: {"tracking.rate": 12.0}}))
    assert np.array_equal(before[:50], after[:50])
    assert np.abs(after[50:] - before[50:]).max() > 0.1 * np.abs(before).max()


# Physical ranges


def tank(**ranges) -> fp.Plant:
    """A tank with a leak; its level is in m."""
    return fp.Plant(
        {"level": "m"},
        {"pump": "m^3/s"},
        {"leak": fp.Parameter(0.1, 0.2, "m^2/s")},
        lambda q, u, p: {"level": u.pump - p.leak * q.level},
        order=1,
        ranges=ranges,
    )


def emptying(plant: fp.Plant, cycles: int = 1000) -> fp.Problem:
    """A tank that is asked to go below its floor: level = 0.2 - t."""
    reference = fp.Trajectory(lambda t: {"level": 0.2 - t + 0 * ca.sin(t)})
    return fp.Problem(plant, reference, {"level": 0.2}, 1e-3, cycles * 1e-3)


def test_run_ends_where_the_level_is_below_zero():
    """The run without the range is the same up to the last cycle with a level of at least zero, and the reason names it."""
    free, checked = run(emptying(tank())), run(emptying(tank(level=(0.0, np.inf))))
    first = int(np.argmax(free["state.level"] < 0))
    assert 100 < first < 500
    assert checked.cycles == first
    assert np.array_equal(checked["state.level"], free["state.level"][:first])
    assert checked.stop is not None
    assert checked.stop.startswith("state 'level' is -")
    assert f"outside its physical range of 0 to inf m at t = {first * 1e-3:g} s (cycle {first})" in checked.stop
    assert free.stop is None


def test_range_in_a_later_chunk_of_cycles():
    """Cycles are computed 500 at a time; a range that is left in the second chunk ends the run at its own cycle."""
    free, checked = run(emptying(tank())), run(emptying(tank(level=(-0.5, 1.0))))
    first = int(np.argmax(free["state.level"] < -0.5))
    assert first > 500
    assert checked.cycles == first


def test_state_of_a_reality_and_of_a_body_outside():
    """The state that counts is that of what moves: the reality's force, the measured coordinate of an object."""
    real = fp.Reality(replace(lagged(), ranges={"F": (-5.0, 0.5)}), start={"F": 0.0})
    result = run(task(reality=real))
    assert "state 'F' is " in str(result.stop)
    assert np.all(result["reality_state.F"] <= 0.5)
    problem = task(plant=replace(task().plant, ranges={"y'": (-1.0, 1.0)}))
    body = run(replace(problem, reality=fp.ExternalPlant(Wrapped(problem), MEASURES)))
    assert body.stop == run(problem).stop
    assert "y'" in str(body.stop)


def test_noisy_sensor_does_not_end_a_run():
    """The range is that of the level and not of its measurement."""
    noisy = fp.Sensing(sensors={"level": fp.Sensor(noise=fp.Noise(0.5))})
    reference = fp.Trajectory(lambda t: {"level": 0.2 + 0 * t})
    calm = replace(emptying(tank(level=(0.0, 1.0)), 200), reference=reference, sensing=noisy)
    result = run(calm, fp.ComputedTorque(fp.Exponential(rate=1.0)))
    assert result["state.level"].min() < 0
    assert result.stop is None


# Lateness that the body states

CYCLE, LATE, LAG = 1e-2, 3, 0.05


class Cart:
    """x'' = what was commanded, three cycles ago, behind a lag; exact for a held command."""

    def __init__(self, late: int = 0, lag: float = 0.0) -> None:
        self.late, self.lag = late, lag

    def reset(self, seed):
        del seed
        self.waiting, self.x, self.v, self.u = [0.0] * self.late, 0.0, 0.0, 0.0
        return [0.0, 0.0, 0.0]

    def step(self, time, command):
        del time
        self.waiting.append(float(command[0]))
        wanted, before = self.waiting.pop(0), self.v
        steps = 200
        for _ in range(steps):
            h = CYCLE / steps
            start = self.u
            self.u = wanted + (self.u - wanted) * math.exp(-h / self.lag) if self.lag else wanted
            mean = (start + self.u) / 2 if self.lag else wanted
            self.x += h * self.v + h * h / 2 * mean
            self.v += h * mean
        return [self.x, self.v, (self.v - before) / CYCLE]


CART = fp.Plant(
    coordinates={"x": "m"},
    inputs={"u": "m/s^2"},
    parameters={"b": fp.Parameter(approximate=1.0, exact=1.0, unit="1")},
    response=lambda _q, _v, u, p: {"x": p.b * u.u},
)
FORM = fp.ModelReferenced(fp.Affine(gain=-1.0))


def cart(late: float = 0.0, lag: float = 0.0) -> fp.Problem:
    body = Cart(round(late / CYCLE), lag)
    return fp.Problem(
        plant=CART,
        reality=fp.ExternalPlant(body, measures={"x": "m", "x'": "m/s", "x''": "m/s^2"}, lag={"u": lag}),
        dead_time=fp.DeadTime(inputs={"u": late}),
        reference=fp.Trajectory(lambda t: {"x": 1 - ca.cos(2 * t)}),
        start={"x": 0.0},
        period=CYCLE,
        duration=3.0,
        limits=fp.Limits(inputs={"u": (-50.0, 50.0)}),
    )


def law(form: Deformation) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate=3.0, integral=False), form)


def deformed(one: fp.Problem, form: fp.ModelReferenced) -> float:
    """Largest difference between request and desired response."""
    result = run(one, law(form))
    assert result.stop is None
    return float(np.abs(result["deformed"] - result["desired"]).max())


@pytest.mark.parametrize("facts", [{"late": LATE * CYCLE}, {"lag": LAG}], ids=["dead time", "lag"])
def test_an_exact_model_is_left_alone_behind_what_the_body_states(facts):
    """The form that knows of nothing deforms what needs no deformation."""
    one = cart(**facts)
    unknowing = fp.ModelReferenced(FORM.map, cycles=0.0, lag=0.0)
    assert deformed(one, FORM) < 0.06 * deformed(one, unknowing)
