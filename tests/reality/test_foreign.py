"""A foreign reality: an object outside, called once per cycle; what it may do wrong, what a run then keeps, and what is refused."""

import math
import re
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.drives import CONTROLLERS, MEASURES, PAIRS, SENSING, Wrapped, lagged, parameters, run, task
from helpers.plants import linear, pendulum

import fpirhc as fp
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
    "wrong shape": (lambda a: a[:2], r"returned array\(\[.*\]\), expected 3 numbers: y, y', y''"),
    "text": (lambda _: "on", "returned 'on', expected 3 numbers: y, y', y''"),
    "truth values": (lambda a: a > 0, r"returned array\(.*, expected 3 numbers"),
    "nothing": (lambda _: None, "returned None, expected 3 numbers"),
    "complex": (lambda a: a * 1j, "expected 3 numbers"),
    "ragged": (lambda a: [a, 1.0], "raised ValueError"),
}
SILENT: dict[str, Any] = {
    "no number": lambda a: a * [1, np.nan, 1], "masked": lambda a: np.ma.masked_array(a, [True, False, False]),
    "infinite": lambda a: a * np.inf}  # fmt: skip


def outside(problem: fp.Problem, **settings) -> fp.Problem:
    """The problem with its own plant outside."""
    return replace(problem, reality=fp.ExternalPlant(Wrapped(problem), measures=MEASURES, **settings))


@pytest.mark.parametrize(("controller", "sensing"), PAIRS)
def test_wrapped_plant_runs_as_the_plant_itself(controller, sensing):
    """Every signal that both runs have agrees, behind an estimator, noisy and late too, up to the rounding of the time."""
    pushed = {"u": fp.Formula(lambda t: 1.0 * ca.sin(2 * np.pi * 2.0 * t))}
    problem = task(**SENSING[sensing] | {"disturbances": pushed})
    one, other = (run(p, CONTROLLERS[controller]) for p in (problem, outside(problem)))
    assert other.stop is None
    for name in one.layout.names:
        size = max(1.0, np.abs(one[name]).max())
        assert np.abs(one[name] - other[name]).max() <= 1e-9 * size, name
    assert set(other.layout.names) - set(one.layout.names) - {"lost_sample"} == {"foreign", "no_answer"}


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


@pytest.mark.parametrize("kind", BAD)
def test_bad_answer_ends_the_run_and_loses_nothing(kind):
    """A hundred good answers are kept; the reason names the method, what it did, and when."""
    bad, message = BAD[kind]
    problem = task()
    result = run(replace(problem, reality=fp.ExternalPlant(Faulty(problem, bad), MEASURES)))
    assert re.search(f"{message}.* at t = 0.1 s .cycle 100.", str(result.stop))
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


@pytest.mark.parametrize("kind", SILENT)
def test_an_answer_without_numbers_is_a_skipped_cycle(kind):
    """Two are skipped and marked, and the last good answer stands in the log; more in a row than are bridged end the run."""
    problem, bad = task(), SILENT[kind]
    two = run(replace(problem, reality=fp.ExternalPlant(Faulty(problem, bad, range(100, 102)), MEASURES)))
    assert two.stop is None
    assert two["no_answer"][99:103, 0].tolist() == [0, 1, 2, 0]
    assert np.array_equal(two["state"][100:102], two["state"][[99, 99]])
    assert np.flatnonzero(two["status"] == fp.Status.BAD_SAMPLE).tolist() == [100, 101]  # as a lost sample of a machine
    assert np.array_equal(two["command"][100:102], two["command"][[99, 99]])
    assert "BAD_SAMPLE in 2 cycles, first at 0.1 s" in repr(two)
    many = run(replace(problem, reality=fp.ExternalPlant(Faulty(problem, bad, range(100, 200)), MEASURES)))
    assert many.cycles == 105
    assert "the plant outside gave no answer in 6 cycles in a row at t = 0.105 s (cycle 105)" in str(many.stop)


def test_bad_first_answer_is_an_error():
    """There is nothing to keep before the first answer."""
    problem = task()
    with pytest.raises(InvalidProblem, match=r"reset of Wrapped returned array.*, expected 3 numbers"):
        run(replace(problem, reality=fp.ExternalPlant(Wrapped(problem, ("y",)), MEASURES)))
    body = Wrapped(problem)
    body.reset = lambda _seed: [0.0, np.nan, 0.0]  # type: ignore[method-assign]
    with pytest.raises(InvalidProblem, match="reset of Wrapped returned y' = nan, expected a finite number"):
        run(replace(problem, reality=fp.ExternalPlant(body, MEASURES)))


GAIN = {"b": fp.Parameter(approximate=1.0, exact=2.0, unit="1/kg", bounds=(0.1, 10.0))}


def test_a_made_body_is_new_in_every_run_and_has_its_seed():
    """The function is called once per run, with the seed of the run and the exact values."""
    seeds: list[int] = []

    def make(parameters, seed):
        seeds.append(seed)
        body = Wrapped(task())
        body._rate = lambda x, u: np.array([x[1], parameters["b"] * u[0]])  # type: ignore[method-assign]
        return body

    problem = task(reality=fp.ExternalPlant(make=make, parameters=GAIN, measures=MEASURES))
    first, weaker = run(problem), run(problem.with_exact(np.array([1.0])))
    assert seeds == [0, 0]
    assert np.array_equal(first["plant_state"], run(outside(task()))["plant_state"])
    assert not np.array_equal(first["plant_state"], weaker["plant_state"])


def test_nobody_has_the_exact_model_of_a_plant_outside():
    """Parameters that are equal in the file say nothing of the plant: the row without adaptation is no bound of the others."""
    laws = {"law": fp.ComputedTorque(fp.Exponential(rate=6.0)), "fast": fp.ComputedTorque(fp.Exponential(rate=9.0))}
    known = task(start={"y": 0.3})
    known = outside(known.with_exact(known.plant.approximate))
    found = fp.compare(tasks.made(known, laws), seed=0, compiled=False)
    assert [e.exact for e in found.entries] == [False, False]


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
    words = rf"state 'level' is -.*outside its physical range of 0 to inf m at t = {first * 1e-3:g} s \(cycle {first}\)"
    assert re.match(words, str(checked.stop))
    assert free.stop is None


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


# What is wrong with a reality, or with a body outside, is said where the problem is made
Y = linear(2.0, 1.0)
OUTPUT = replace(Y, outputs={"z": fp.Output("m", lambda q, v, p: 2 * q.y)})
LEVEL = fp.Plant({"h": "m"}, {"u": "m/s"}, {}, lambda q, u, p: {"h": u.u - q.h}, order=1)


def real(plant: fp.Plant, **settings: Any) -> fp.Problem:
    return task(reality=fp.Reality(plant, **settings))


def loose(body: Any = None, **settings: Any) -> Any:
    """An external plant from whatever is given."""
    return fp.ExternalPlant(
        body if "make" in settings else body or Wrapped(task()), **{"measures": MEASURES} | settings
    )


def body(**settings: Any) -> fp.Problem:
    return task(reality=loose(**settings))


class Stepless:
    """Half a body."""

    reset = Wrapped.reset


WRONG: dict[str, tuple[Any, str]] = {
    "no coordinate": (
        lambda: real(replace(Y, coordinates={"z": "m"}, response=lambda q, v, u, p: {"z": p.b * u.u})),
        "has no 'y', which the model has",
    ),
    "no output": (lambda: task(plant=OUTPUT, reality=fp.Reality(Y), cost=None, horizon=None,
                               reference=fp.Trajectory(lambda t: {"z": 0 * t})), "has no 'z'"),
    "unit": (lambda: real(replace(Y, coordinates={"y": "mm"})), "in mm, the model's 'y' in m;"),
    "unit of an input": (lambda: real(replace(Y, inputs={"u": "kN"})), "its inputs are u in kN, the model's are u in N"),
    "unit of time": (lambda: real(replace(Y, time_unit="ms")), "time is in ms, the model's in s"),
    "other input": (
        lambda: real(replace(Y, inputs={"F": "N"}, response=lambda q, v, u, p: {"y": p.b * u.F})),
        "inputs are F in N, the model's are u in N",
    ),
    "lower order": (
        lambda: real(fp.Plant({"y": "m"}, {"u": "N"}, parameters(), lambda q, u, p: {"y": p.b * u.u}, order=1)),
        "y' jumps with the command",
    ),
    "out of reach": (
        lambda: real(replace(lagged(), response=lambda q, v, u, p: {"y": -q.y, "F": (u.u - q.F) / p.tau})),
        "no input reaches its 'y'",
    ),
    "unknown start": (lambda: real(lagged(), start={"force": 1.0}), "start: state 'force' is unknown. Valid: y, F, y'"),
    "unknown sensor": (
        lambda: real(lagged(), start={"F": 0.0}, seen={"y": "Y"}), "coordinate of the reality 'Y' is unknown"
    ),
    "no start": (lambda: real(lagged()), "does not have: F; give their first values: Reality(start={'F': ...})"),
    "stiff": (lambda: real(lagged(tau=1e-4), start={"F": 0.0}), "RungeKutta4(substeps=1) makes it grow by"),
    "judged": (lambda: task(reality=fp.Reality(Y), judged=["y", "F"]), "'F'"),
    "a plant": (lambda: task(reality=pendulum()), "Reality"),
    "no exact model": (
        lambda: run(real(lagged(), start={"F": 0.0}), fp.ExactModel(CONTROLLERS["computed torque"])),
        "coordinates ('y', 'F'), the controller's are ('y',): it cannot be the exact model",
    ),
    "range": (lambda: replace(LEVEL, ranges={"levels": (0.0, 1.0)}), "'levels'"),
    "empty range": (lambda: replace(LEVEL, ranges={"h": (1.0, 0.0)}), "(lowest, highest), got (1.0, 0.0)"),
    "start out of range": (
        lambda: fp.Problem(
            replace(LEVEL, ranges={"h": (0.5, 1.0)}), fp.Trajectory(lambda t: {"h": 1 + 0 * t}), {"h": 0.2}, 0.01, 1.0
        ),
        "'h' is 0.2, outside its physical range of 0.5 to 1",
    ),
    "no body": (lambda: fp.ExternalPlant(measures=MEASURES), "either a body or make=lambda parameters, seed: body"),
    "two bodies": (
        lambda: fp.ExternalPlant(Wrapped(task()), measures=MEASURES, make=lambda _p, _s: None), "either a body or make"
    ),
    "half a body": (lambda: loose(Stepless()), "its body is a value of the class Stepless without step"),
    "a class": (lambda: loose(Stepless), "its body is the class Stepless; write Stepless() for an object of it"),
    "not measured": (lambda: body(measures={"y": "m", "y'": "m/s"}), "y'' (m/s^2), which the sensing"),
    "unknown measure": (lambda: body(measures={**MEASURES, "yy": "m"}), "'yy' is unknown. Did you mean 'y'?"),
    "measured unit": (lambda: body(measures={**MEASURES, "y": "mm"}), "measures y in mm, the model has it in m"),
    "an option": (lambda: loose(rests={}), "no field 'rests'. Did you mean 'rest'?"),
    "a lag of nothing": (lambda: loose(lag=0.002), "lag: expected {name: a finite number of at least 0}"),
    "a negative lag": (lambda: body(lag={"u": -0.1}), "lag['u']: expected a finite number of at least 0, got -0.1"),
    "an infinite lag": (lambda: body(lag={"u": math.inf}), "got inf"),
    "lag of nobody": (lambda: body(lag={"v": 0.1}), "input 'v' is unknown"),
    "parameters alone": (lambda: loose(parameters=GAIN), "a body that stands cannot take parameters; write make="),
    "one argument": (lambda: loose(make=lambda _: None), "make: expected a function of 2 arguments or None"),
    "made of nothing": (
        lambda: run(body(make=lambda _p, _s: None)), "reality: make returned None; expected an object with reset(seed)"
    ),
    "raises": (lambda: run(body(make=lambda p, _: p["c"])), "reality: make raised KeyError: 'c'"),
    "out of bounds": (
        lambda: body(make=lambda p, s: Wrapped(task()), parameters=GAIN).with_exact(np.array([20.0])), "outside its bounds"
    ),
    "nothing to draw": (lambda: body().with_exact(np.array([1.0])), "no exact parameters"),
    "no equations": (lambda: run(body(), fp.ExactModel(CONTROLLERS["computed torque"])), "no equations"),
    "a disturbance": (lambda: task(reality=loose(), disturbances={"y": fp.Step(0.0, 1.0)}), "disturbances"),
    "no object": (lambda: task(reality=Wrapped(task())), "reality: expected a Reality or an ExternalPlant"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_reality_says_what_was_expected(name):
    make, words = WRONG[name]
    with pytest.raises(fp.FpirhcError) as caught:
        make()
    assert words in " ".join(str(caught.value).split())
