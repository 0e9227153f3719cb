"""Whatever is given as a setting, a set-point or a time is refused and counted, or ends in one clear error; never in a raw one."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.errors import InvalidField, InvalidName, InvalidProblem, InvalidValue, NotContractive, NotSupported

aimed = cache(
    lambda: replace(
        tasks.two_mass.problem, reference=fp.Setpoint({"q1": 0.1, "q2": 0.2}, rate=3.0), duration=0.02, measure_from=0.0
    )
)
adaptive = cache(lambda: tasks.two_mass.controllers["CTC+FPI (eq 6)"])
HUGE = 10**400  # a whole number that is no float
GAIN, TOP = "deformation.gain", "limits.inputs.Q1.1"


@pytest.fixture(scope="module")
def stepper():
    """A stepper with a gain and an upper limit that are live."""
    return fp.Stepper(aimed(), adaptive(), compiled=False, live=[GAIN, TOP])


def sample(stepper):
    """Arguments of a step at rest."""
    size = stepper.signals["desired"].size
    return 0.0, np.array(aimed().start_state), np.zeros(size), stepper.start()


REFUSED = [
    ({GAIN: HUGE}, "expected a number, got 1000"),
    ({GAIN: [-0.4]}, r"expected a number, got \[-0.4\]"),
    ({GAIN: np.timedelta64(1, "s")}, "timedelta64"),
    ({GAIN: float("nan")}, "expected a number, got nan"),
    ({TOP: (1, 5)}, r"Q1.1': expected a number, got \(1, 5\)"),
]


@pytest.mark.parametrize(("settings", "words"), REFUSED, ids=lambda v: str(v)[:25])
def test_wrong_settings_are_refused_and_counted(settings, words, stepper):
    """The numbers in force stay, and the step of that cycle has the command that it has without them."""
    before, numbers = stepper.refused, stepper.numbers
    expected, _ = stepper.step(*sample(stepper))
    command, _ = stepper.step(*sample(stepper), settings=settings)
    assert np.array_equal(command, expected)
    assert (stepper.refused, stepper.numbers) == (before + 1, numbers)
    with pytest.raises(InvalidValue, match=words):
        raise InvalidValue(stepper.why_refused)


@pytest.mark.parametrize("name", ["settings", "setpoints"])
@pytest.mark.parametrize(
    ("entries", "words"),
    [
        (5, "expected a mapping {name: number}, got 5"),
        ([(GAIN, -0.4)], "expected a mapping"),
        (np.array([1.0, 2.0]), r"an array of the shape \(2,\)"),
        ("q1", "the text 'q1'"),
        ({1: 2.0, None: 3.0}, "the name 1.*\n.*the name None"),
    ],
    ids=lambda v: str(v)[:20],
)
def test_what_is_no_mapping_of_names_is_named(entries, words, name, stepper):
    """It is a mistake in the caller's program, told as an unknown name is; the stepper goes on working."""
    with pytest.raises(InvalidField, match=rf"(?s){name}.*{words}"):
        stepper.step(*sample(stepper), **{name: entries})
    command, _ = stepper.step(*sample(stepper))
    assert np.isfinite(command).all()


SETPOINTS = [HUGE, "0.3", None, {}, 1j, True, np.timedelta64(1, "s"), np.array(["a"]), float("inf"), [[1.0, "a"]]]


@pytest.mark.parametrize("value", SETPOINTS, ids=lambda v: repr(v)[:20])
def test_wrong_set_points_are_refused_and_counted(value, stepper):
    """A text, a truth value and a duration are no set-points, though numpy makes numbers of them."""
    before, points = stepper.refused, stepper.setpoints
    assert not stepper.set_reference({"q1": value})
    assert (stepper.refused, stepper.setpoints) == (before + 1, points)
    assert "q1" in stepper.why_refused


def test_right_numbers_of_every_kind_are_taken(stepper):
    """A number of numpy, and an array with one entry."""
    assert stepper.change({GAIN: np.float32(-0.5), TOP: np.array([40.0])})
    assert stepper.set_reference({"q1": np.array([0.25]), "q2": np.int64(1)})
    assert stepper.numbers[GAIN] == -0.5
    assert stepper.setpoints == {"q1": 0.25, "q2": 1.0}
    assert not stepper.set_reference({"q1": [0.1, 0.2]})
    with pytest.raises(InvalidName, match=r"deformation\.gain"):
        stepper.change({"deformation.gian": -0.3})


NO_TIMES = [np.timedelta64(1, "s"), np.datetime64("2020-01-01"), "0", None, HUGE, [0.0], 1j, True, np.bool_(0)]


@pytest.mark.parametrize("time", NO_TIMES, ids=lambda v: repr(v)[:20])
def test_what_is_no_time_is_named(time, stepper):
    """Also numpy's truth values, which are numbers to an assignment."""
    with pytest.raises(InvalidValue, match="'time' must be a number of seconds, got"):
        stepper.step(time, *sample(stepper)[1:])


RUNS = [
    ({"settings": {1: 2.0}}, InvalidField, "name.* 1"),
    ({"settings": 5}, InvalidField, "settings: expected .*, got 5"),
    ({"settings": {GAIN: HUGE}}, InvalidValue, "expected a number"),
    ({"setpoints": 5}, InvalidField, "setpoints: expected .*, got 5"),
    ({"setpoints": {"q1": [(0, HUGE)]}}, InvalidValue, "expected .*number"),
    ({"setpoints": {"q9": 1.0}}, InvalidName, "'q9' is unknown"),
    ({"setpoints": {"q1": lambda t: 1.0}}, InvalidField, "setpoints"),
]


@pytest.fixture(scope="module")
def loop():
    """A loop with a gain that is live."""
    return fp.simulator(aimed(), adaptive(), compiled=False, live=[GAIN])


@pytest.mark.parametrize(("given", "error", "words"), RUNS, ids=lambda v: str(v)[:30])
def test_wrong_numbers_of_a_run_are_named(given, error, words, loop):
    """Before the run."""
    with pytest.raises(error, match=words):
        loop.run(seed=0, **given)


LIVE = [
    ("RHC+FPI", "deformation.gian", InvalidName, "gain"),
    ("RHC+FPI", "start.q1", InvalidName, "data of every loop"),
    ("RHC+FPI", "cost.states.q3", InvalidName, "q1"),
    ("RHC+FPI", "optimiser.iterations", NotSupported, "what the loop is made of"),
    ("RHC+FPI", "deformation", InvalidValue, "go on with one of"),
    ("CTC", "cost.states.q1", NotSupported, "does not use it"),
    ("CTC", "reference.rate", NotSupported, "needs its number while the loop is built"),
]


@pytest.mark.parametrize(("name", "path", "error", "words"), LIVE, ids=[w[1] for w in LIVE])
def test_what_cannot_be_live_is_refused_by_name(name, path, error, words):
    """A setting that is needed as a number would become NaN in CasADi, without an error."""
    with pytest.raises(error, match=words):
        fp.simulator(aimed(), tasks.two_mass.controllers[name], compiled=False, live=[path])


def test_numbers_are_checked_at_every_change():
    """Unknown names, numbers outside a setting's range, infinite limits and gains that diverge."""
    live = ["deformation.gain", "cost.states.q1", "limits.inputs.Q1.1"]
    ready = fp.simulator(aimed(), tasks.two_mass.controllers["RHC+FPI"], live=live, compiled=False)
    cases: tuple[tuple[dict[str, Any], type[Exception], str], ...] = (
        ({"deformation.shift": 0.2}, InvalidName, "not live"),
        ({"deformation.gain": 0.0}, InvalidValue, "other than zero"),
        ({"deformation.gain": 0.5}, NotContractive, "gain"),
        ({"cost.states.q1": -1.0}, InvalidProblem, "at least 0"),
        ({"limits.inputs.Q1.1": float("inf")}, InvalidValue, "use a large one"),
        ({"limits.inputs.Q1.1": -400.0}, InvalidProblem, "above upper"),
    )
    for numbers, error, words in cases:
        with pytest.raises(error, match=words):
            ready.run(seed=0, settings=numbers)
