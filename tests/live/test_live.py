"""Live settings: one loop for every setting, bit by bit the loop that would be built with the number; wrong numbers are refused."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.errors import (
    CompileError,
    InvalidField,
    InvalidName,
    InvalidProblem,
    InvalidValue,
    NotContractive,
    NotSupported,
)

brief = cache(lambda: replace(tasks.two_mass.problem, duration=0.3, measure_from=0.0))
by_torque = cache(lambda: tasks.two_mass.controllers["CTC+FPI (eq 6)"])
by_plan = cache(lambda: tasks.two_mass.controllers["RHC+FPI"])
FOUR = ["tracking.rate", "deformation.gain", "deformation.scale", "deformation.shift"]
FIVE = ["deformation.gain", "cost.states.q1", "cost.states.q2'", "cost.deviation.Q1", "limits.inputs.Q1.1"]


def rebuilt(ready, numbers, *, compiled):
    """The run of a loop that is built with these numbers."""
    problem, controller, _ = ready.live.changed(numbers)
    return fp.simulator(problem, controller, compiled=compiled).run(seed=0)


def random_numbers(rng):
    """Numbers for the settings of `FOUR` and `FIVE`."""
    four = rng.uniform((3, -1.2, 0.8, 0.05), (9, -0.1, 3, 0.6))
    five = rng.uniform((-1.2, 200, 0.3, 5e-4, 2), (-0.1, 2e3, 3, 3e-3, 40))
    return dict(zip(FOUR, four.tolist(), strict=True)), dict(zip(FIVE, five.tolist(), strict=True))


@pytest.mark.parametrize("compiled", [True, False], ids=["C", "VM"])
def test_a_changed_loop_is_the_rebuilt_one_bit_by_bit(compiled):
    """Formulas of settings round alike as numbers and as expressions; behind other weights plans keep the build's step length."""
    rng = np.random.default_rng(7)
    torque = fp.simulator(brief(), by_torque(), compiled=compiled, live=FOUR)
    planned = fp.simulator(brief(), by_plan(), compiled=compiled, live=FIVE)
    for k in range(3):
        four, five = random_numbers(rng)
        assert np.array_equal(torque.run(seed=0, settings=four).log, rebuilt(torque, four, compiled=compiled).log), four
        if k == 0:
            runs = planned.run(seed=0, settings=five), rebuilt(planned, five, compiled=compiled)
            one, other = (run["command"] for run in runs)
            assert np.abs(one - other).max() <= 1e-4 * np.abs(other).max()


def test_a_compiler_that_fails_is_an_error(monkeypatch):
    """A loop without live settings runs in the virtual machine then; one with live settings must not hide what went wrong."""
    monkeypatch.setenv("FPIRHC_CC", "false")
    short = replace(brief(), duration=0.01)
    assert not fp.simulator(short, by_torque()).compiled
    with pytest.raises(CompileError):
        fp.simulator(short, by_torque(), live=["deformation.gain"])
    monkeypatch.setenv("FPIRHC_CC", "none")
    assert not fp.simulator(short, by_torque(), live=["deformation.gain"]).compiled


def test_a_run_keeps_the_numbers_that_it_was_given(tmp_path):
    """All live numbers and the limits in force are in the run's file; a run without live settings has none."""
    live, given = [*FOUR[1:3], FIVE[-1]], {"deformation.gain": -0.9, FIVE[-1]: 20.0}
    fp.simulator(brief(), by_torque(), compiled=False, live=live).run(seed=0, settings=given).save(tmp_path / "run.npz")
    kept = fp.load_run(tmp_path / "run.npz").settings
    assert kept["live"] == {"deformation.scale": by_torque().deformation.scale} | given
    assert kept["limits"][1][0] == given[FIVE[-1]]
    assert "live" not in fp.simulate(brief(), tasks.two_mass.controllers["CTC"], seed=0, compiled=False).settings


# Whatever is given as a setting, a set-point or a time is refused and counted, or ends in one clear error; never in a raw one

aimed = cache(
    lambda: replace(
        tasks.two_mass.problem, reference=fp.Setpoint({"q1": 0.1, "q2": 0.2}, rate=3.0), duration=0.02, measure_from=0.0
    )
)
HUGE = 10**400  # a whole number that is no float
GAIN, TOP = "deformation.gain", "limits.inputs.Q1.1"


@pytest.fixture(scope="module")
def stepper():
    """A stepper with a gain and an upper limit that are live."""
    return fp.Stepper(aimed(), by_torque(), compiled=False, live=[GAIN, TOP])


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


RUNS: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"settings": {1: 2.0}}, InvalidField, "name.* 1"),
    ({"settings": 5}, InvalidField, "settings: expected .*, got 5"),
    ({"settings": {GAIN: HUGE}}, InvalidValue, "expected a number"),
    ({"setpoints": 5}, InvalidField, "setpoints: expected .*, got 5"),
    ({"setpoints": {"q1": [(0, HUGE)]}}, InvalidValue, "expected .*number"),
    ({"setpoints": {"q9": 1.0}}, InvalidName, "'q9' is unknown"),
    ({"setpoints": {"q1": lambda t: 1.0}}, InvalidField, "setpoints"),
    ({"settings": {"deformation.shift": 0.2}}, InvalidName, "not live"),
    ({"settings": {GAIN: 0.0}}, InvalidValue, "other than zero"),
    ({"settings": {GAIN: 0.5}}, NotContractive, "gain"),
    ({"settings": {"cost.states.q1": -1.0}}, InvalidProblem, "at least 0"),
    ({"settings": {TOP: float("inf")}}, InvalidValue, "use a large one"),
    ({"settings": {TOP: -400.0}}, InvalidProblem, "above upper"),
]


@pytest.fixture(scope="module")
def loop():
    """A loop with a gain, a weight and an upper limit that are live."""
    return fp.simulator(aimed(), by_plan(), compiled=False, live=[GAIN, "cost.states.q1", TOP])


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


# A gain beyond the limit of its iteration is refused, built in or given while the loop runs, unless it is asked for

LAW = fp.ComputedTorque(fp.Exponential(rate=6.0))
LARGEST = 4 / 1.5  # of an affine map: |1 - a lambda| < 1 with a half of its gain, lambda = 1.5 and 1.3


def affine(gain, around=lambda m: m):
    """Computed torque with an affine map."""
    return LAW.with_deformation(around(fp.Affine(gain=gain)))


@pytest.mark.parametrize("gain", [-1.01 * LARGEST, -5.0, -1e300])
def test_a_gain_beyond_the_limit_is_refused_in_every_way(gain):
    """Built in, as a live setting of a run and of a stepper: one message with the limit and a remedy."""
    message = r"too large; use 0 < \|gain\| < 2.67, where the iteration alone converges"
    for make in (fp.Stepper, fp.simulator):
        with pytest.raises(NotContractive, match=message):
            make(brief(), affine(gain), compiled=False)
    loop = fp.simulator(brief(), affine(-0.5), compiled=False, live=[GAIN])
    assert loop.run(seed=0, settings={GAIN: -0.99 * LARGEST}).stop is None
    with pytest.raises(NotContractive, match=message):
        loop.run(seed=0, settings={GAIN: gain})
    stepper = fp.Stepper(brief(), affine(-0.5), compiled=False, live=[GAIN])
    assert not stepper.change({GAIN: gain})
    assert (stepper.refused, stepper.numbers[GAIN]) == (1, -0.5)
    assert "use 0 < |gain| < 2.67, where the iteration alone converges" in stepper.why_refused


def test_forms_of_the_iteration_have_their_own_limits():
    """`Tuned` finds its gain on line, from twice the limit as well; the model-referenced form at -1e300 is refused."""
    fp.Stepper(brief(), affine(-2 * LARGEST, lambda m: fp.Tuned(m, largest_gain=6.0)), compiled=False)
    with pytest.raises(NotContractive, match=r"^ModelReferenced\(Affine\(gain=-1e\+300\)\) is too large"):
        fp.Stepper(brief(), affine(-1e300, fp.ModelReferenced), compiled=False)
    fp.Stepper(brief(), affine(-0.9, fp.ModelReferenced), compiled=False)
