"""A foreign reality: an object outside, called once per cycle; what it may do wrong, and what a run then keeps."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any
from unittest.mock import DEFAULT, Mock

import numpy as np
import pytest
from test_reality import CONTROLLERS, PAIRS, SENSING, TAU, lagged, run, task

import fpirhc as fp
from fpirhc import simulator
from fpirhc.errors import InvalidProblem, Mistakes, NotSupported
from fpirhc.simulation.loop import start_memory
from fpirhc.simulation.path import moving
from fpirhc.simulation.simulate import Patch, run_cycles

MEASURES = {"y": "m", "y'": "m/s", "y''": "m/s^2"}


class Wrapped:
    """The problem's own plant behind reset and step, moved by a Runge-Kutta step of numpy's own."""

    calls = 0

    def __init__(self, problem: fp.Problem, measures=tuple(MEASURES)) -> None:
        self.problem, self.measures = problem, measures

    def reset(self, seed):
        del seed
        self.calls = 0
        self.x = np.array(self.problem.start_state)
        return self._answer(np.array(self.problem.inputs_before))

    def step(self, time, command):
        self.calls, h = self.calls + 1, self.problem.period
        assert time == pytest.approx((self.calls - 1) * h)
        k1 = self._rate(self.x, command)
        k2 = self._rate(self.x + h / 2 * k1, command)
        k3 = self._rate(self.x + h / 2 * k2, command)
        k4 = self._rate(self.x + h * k3, command)
        self.x = self.x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return self._answer(command)

    def _rate(self, x, u):
        return np.array([x[1], 2.0 * u[0]])

    def _answer(self, u):
        every = {"y": self.x[0], "y'": self.x[1], "y''": self._rate(self.x, u)[1]}
        return np.array([every[name] for name in self.measures])


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
    """Every signal that both runs have agrees, also behind an estimator and noisy sensors."""
    problem = task(**SENSING[sensing], disturbances={"u": fp.Sine(1.0, 2.0)})
    one, other = (run(p, CONTROLLERS[controller]) for p in (problem, outside(problem)))
    assert other.stop is None
    for name in set(one.layout.names) - {"contraction"}:
        size = max(1.0, np.abs(one[name]).max())
        assert np.abs(one[name] - other[name]).max() <= 1e-12 * size, name
    assert set(other.layout.names) - set(one.layout.names) - {"lost_sample"} == {"foreign", "foreign_held"}


def test_dead_times_stand_around_the_body():
    """The problem's dead times of input and measurement are those of the loop, whatever the body does."""
    problem = task(dead_time=fp.DeadTime(inputs={"u": 0.002}, measurement=0.001))
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
    body = fp.ExternalPlant(Late(task()), measures=MEASURES, dead_time={"u": 0.002})
    own = replace(task(), reality=body)
    assert own.response_delay == problem.response_delay == 2
    assert replace(own, duration=0.1).dead_time.inputs == {"u": 0.002}
    inside, outside_ = run(problem, controller), run(own, controller)
    for signal in ("plant_state", "command"):
        assert np.abs(inside[signal] - outside_[signal]).max() <= 1e-9 * np.abs(inside[signal]).max()


def test_a_dead_time_is_stated_once_and_by_name():
    """Two statements that differ are one mistake, and an input that does not exist is another."""
    body = fp.ExternalPlant(Late(task()), measures=MEASURES, dead_time={"u": 0.002})
    with pytest.raises(InvalidProblem, match="state it once"):
        task(dead_time=fp.DeadTime(inputs={"u": 0.005}), reality=body)
    with pytest.raises(InvalidProblem, match="input 'v' is unknown"):
        task(reality=replace(body, dead_time={"v": 0.002}))


def test_a_dead_time_of_the_body_goes_with_the_body():
    """Another body brings its own, the model in its place has it simulated, and what is simulated before a body stays."""
    body = fp.ExternalPlant(Late(task()), measures=MEASURES, dead_time={"u": 0.002})
    stated = task(reality=body)
    slower = replace(stated, reality=replace(body, dead_time={"u": 0.003}))
    assert slower.dead_time.inputs == {"u": 0.003}
    assert replace(stated, reality=replace(body, dead_time={})).dead_time.inputs == {}
    assert replace(stated, reality=None).dead_time.inputs == {}
    assert stated.of_equations.dead_time.simulated.inputs == stated.of_model.dead_time.simulated.inputs == {"u": 0.002}
    more = replace(stated, dead_time=replace(stated.dead_time, inputs={"u": 0.003}))
    assert more.dead_time.simulated.inputs == {"u": pytest.approx(0.001)}
    assert replace(more, reality=slower.reality).dead_time.inputs == {"u": pytest.approx(0.004)}
    with pytest.raises(InvalidProblem, match=r"'u' is 0\.001 s, less than the 0.002 s that the external plant states"):
        replace(stated, dead_time=replace(stated.dead_time, inputs={"u": 0.001}))


def test_the_lateness_of_a_run_is_that_of_the_body_and_what_is_simulated_before_it():
    """One cycle of the loop before two of the body, and three of the loop before a body without."""
    late = task(reality=fp.ExternalPlant(Late(task()), measures=MEASURES, dead_time={"u": 0.002}))
    late = replace(late, dead_time=replace(late.dead_time, inputs={"u": 0.003}))
    alone = outside(task(dead_time=fp.DeadTime(inputs={"u": 0.003})))
    one, other = (run(p, CONTROLLERS["computed torque"]) for p in (late, alone))
    assert np.abs(one["plant_state"] - other["plant_state"]).max() < 1e-12


def test_one_input_is_late_in_the_body_and_another_before_it():
    """Both are known, and one is simulated."""
    late = fp.DeadTime(inputs={"w": 0.01}).behind({"u": 0.002}, Mistakes("problem"))
    assert late.inputs == {"u": 0.002, "w": 0.01}
    assert late.simulated.queued == ("w",)


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


def test_nothing_is_drawn_and_no_model_is_exact():
    """Parameters of an object outside are nobody's to set."""
    problem = outside(task())
    with pytest.raises(NotSupported, match="no exact parameters"):
        problem.with_exact(np.array([1.0]))
    with pytest.raises(NotSupported, match="no equations"):
        run(problem, fp.ExactModel(CONTROLLERS["computed torque"]))


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


def loose(body: Any = None, **settings: Any) -> Any:
    """An external plant from whatever is given."""
    return fp.ExternalPlant(
        body if "make" in settings else body or Wrapped(task()), **{"measures": MEASURES} | settings
    )


class Stepless:
    """Half a body."""

    reset = Wrapped.reset


WRONG: dict[str, tuple[Any, str]] = {
    "no body": (lambda: fp.ExternalPlant(measures=MEASURES), "either a body or make=lambda parameters, seed: body"),
    "two bodies": (lambda: loose(Wrapped(task()), make=lambda _p, _s: None), "either a body or make=lambda parameters"),
    "half a body": (
        lambda: loose(Stepless()),
        "its body is a value of the class Stepless without step; expected an object",
    ),
    "a body that is a class": (
        lambda: loose(Stepless),
        "its body is the class Stepless; write Stepless() for an object of it",
    ),
    "a body that is none": (lambda: loose(object()), "its body is a value of the class object without reset and step"),
    "not all as a list": (
        lambda: task(reality=loose(measures=["y"])),
        "it does not measure y' (m/s), which the sensing",
    ),
    "nothing measured": (lambda: task(reality=loose(measures={})), "it does not measure y (m), which the sensing"),
    "not all": (lambda: task(reality=loose(measures={"y": "m", "y'": "m/s"})), "y'' (m/s^2), which the sensing"),
    "a name": (lambda: task(reality=loose(measures={**MEASURES, "yy": "m"})), "'yy' is unknown. Did you mean 'y'?"),
    "a unit": (
        lambda: task(reality=loose(measures={**MEASURES, "y": "mm"})),
        "measures y in mm, the model has it in m",
    ),
    "half a hold": (lambda: loose(holds=1.5), "holds: expected a whole number of at least 0, got 1.5"),
    "an option": (lambda: loose(dead_times={}), "no field 'dead_times'. Did you mean 'dead_time'?"),
    "a dead time": (
        lambda: loose(dead_time=0.002),
        "dead_time: expected {name: a finite number of at least 0}, got 0.002; write",
    ),
    "a negative one": (
        lambda: task(reality=loose(dead_time={"u": -0.1})),
        "dead_time['u']: expected a finite number of at least 0, got -0.1",
    ),
    "an input": (lambda: task(reality=loose(dead_time={"v": 0.1})), "dead_time: input 'v' is unknown. Valid: u."),
    "parameters alone": (lambda: loose(parameters=GAIN), "a body that stands cannot take parameters; write make="),
    "a number": (lambda: loose(make=Wrapped, parameters={"b": 1.0}), "parameters['b']: expected a Parameter, got 1.0"),
    "one argument": (lambda: loose(make=lambda _: None), "make: expected a function of 2 arguments or None"),
    "made of nothing": (
        lambda: run(task(reality=loose(make=lambda _p, _s: None))),
        "reality: make returned None; expected an object with reset(seed) and step(time, command)",
    ),
    "a name in make": (
        lambda: run(task(reality=loose(make=lambda p, _: p["c"]))),
        "reality: make raised KeyError: 'c'",
    ),
    "out of bounds": (lambda: made(task()).with_exact(np.array([20.0])), "outside its bounds"),
    "a disturbance": (lambda: outside(task(disturbances={"y": fp.Step(0.0, 1.0)})), "disturbances"),
    "no object": (lambda: task(reality=Wrapped(task())), "reality: expected a Reality or an ExternalPlant"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_use_says_what_was_expected(name):
    use, words = WRONG[name]
    with pytest.raises(fp.FpirhcError) as caught:
        use()
    assert words in " ".join(str(caught.value).split())


def test_contraction_is_identified_where_the_response_is_measured():
    """The run's own requests and responses give the factor 1 - a b / b^ without any equation of the body."""
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain=-0.5))
    result = run(outside(task(start={"y": 0.3})), controller)
    assert np.allclose(result["contraction"], 1 - controller.deformation.effective_gain() * 2.0, atol=0.02)


def test_lagged_body_is_the_lagged_reality():
    """An actuator outside is what an actuator in symbols is: two ways to the same run."""
    problem = task(reality=fp.Reality(lagged(), start={"F": 0.0}, integrator=fp.RungeKutta4(substeps=8)))

    class Actuated(Wrapped):
        """Y'' = 2 F, F exactly exponential within a cycle, y by the closed form."""

        force = 0.0

        def step(self, time, command):
            """The closed form of one cycle."""
            del time
            h, gap = self.problem.period, self.force - command[0]
            decay = np.exp(-h / TAU)
            moved = TAU * gap * (1 - decay)
            y = self.x[0] + h * self.x[1] + 2.0 * (command[0] * h**2 / 2 + TAU * (gap * h - moved))
            self.x = np.array([y, self.x[1] + 2.0 * (command[0] * h + moved)])
            self.force = command[0] + gap * decay
            return self._answer(np.array([self.force]))

    controller = CONTROLLERS["plain form"]
    one = run(problem, controller)
    other = run(replace(problem, reality=fp.ExternalPlant(Actuated(task()), MEASURES)), controller)
    assert np.abs(one["command"] - other["command"]).max() < 1e-6 * np.abs(one["command"]).max()


def test_comparison_and_report_of_an_object_outside(tmp_path):
    """The same table, verdict, null test and page as for a plant."""
    shipped = fp.load_problem("two_mass")
    pair = {name: CONTROLLERS[name] for name in ("computed torque", "plain form")}
    file = replace(shipped, problem=outside(task()), controllers=pair, headline=("computed torque", "plain form"))
    comparison = fp.compare(file, seed=0, compiled=False)
    errors = [entry.metrics.rms_error["y"] for entry in comparison.entries]
    inside = [fp.measure(task(), run(task(), one)).rms_error["y"] for one in pair.values()]
    assert errors == pytest.approx(inside, rel=1e-10)
    fp.write_report(comparison, tmp_path / "report.html")
    assert "plain form" in (tmp_path / "report.html").read_text()


def test_memory_that_changes_during_the_run():
    """A change of the believed mass before cycle 50 leaves the commands before it alone, and acts from that cycle on."""
    problem = outside(task(duration=0.1))
    ready = simulator(problem, CONTROLLERS["computed torque"], compiled=False)
    start = start_memory(ready.loop, problem, ready.controller)
    place = np.arange(start.size)[ready.loop.memory.slice("parameters")]
    patches: list[list[Patch]] = [[], [(50, place, np.array([2.0]))]]
    loop, talk = (ready.loop, ready.evaluator), moving(problem).exchange(0)
    before, after = (run_cycles(problem, start, *loop, [], talk, patches=one)[0] for one in patches)
    commands = [log[:, ready.loop.trace.slice("command")].ravel() for log in (before, after)]
    assert np.array_equal(commands[0][:50], commands[1][:50])
    assert commands[1][50] == pytest.approx(0.5 * commands[0][50], rel=1e-12)


def test_solver_that_fails_ends_the_run(monkeypatch):
    """As CasADi's do, with a RuntimeError: the reason is the solver's last line; the cycles before are kept."""
    problem = outside(task(duration=0.1))
    ready = simulator(problem, CONTROLLERS["computed torque"], compiled=False)
    failure = RuntimeError("Error in Function::call\nsolver has no solution")
    evaluate = Mock(wraps=ready.evaluator.evaluate, side_effect=[*[DEFAULT] * 10, failure])
    monkeypatch.setattr(ready.evaluator, "evaluate", evaluate)
    start = start_memory(ready.loop, problem, ready.controller)
    log, stop = run_cycles(problem, start, ready.loop, ready.evaluator, [], moving(problem).exchange(0))
    assert len(log) == 10
    assert "a solver failed (solver has no solution) at t = 0.01 s (cycle 10)" in str(stop)
