"""Whatever a user names or gives: what is not there or nobody expected is one clear error of the library, and no raw one."""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.errors import InvalidField, InvalidName, InvalidProblem, NotSupported

brief = cache(lambda: replace(tasks.two_mass.problem, duration=0.05, measure_from=0.0))
NAME = "CTC+FPI (eq 6)"
adaptive = cache(lambda: tasks.two_mass.controllers[NAME])
HUGE = 10**400  # a whole number that is no float


@pytest.fixture(scope="module")
def run():
    """A short run."""
    return fp.simulate(brief(), adaptive(), seed=0, compiled=False)


@pytest.mark.parametrize("name", [0, None, 1.5, ["error"], slice(0, 2), np.array([1]), ("error", "q1"), "eror"])
def test_signals_and_metrics_are_found_by_names(name, run):
    """A number, a list or a range of rows is told as an unknown name is."""
    metrics = fp.measure(brief(), run)
    steps: list[Any] = [run.__getitem__, run.unit, run.layout.__getitem__, run.layout.slice, metrics.__getitem__]
    for find in steps:
        with pytest.raises(InvalidName, match="Valid: "):
            find(name)
    assert name not in run.layout


def test_the_rows_of_a_run_are_offered(run):
    """Who wants a cycle by its number is told where it is; a near name is offered."""
    with pytest.raises(InvalidName, match=r"run\.log has its cycles by number"):
        run[0]
    with pytest.raises(InvalidName, match=r"Did you mean 'error'\?"):
        run["eror"]


def pendulum(value):
    """A pendulum whose mass has this value in model and plant."""
    return fp.Plant(
        coordinates={"angle": "rad"},
        inputs={"torque": "N m"},
        order=2,
        response=lambda q, v, u, p: {"angle": u.torque / p.mass - 9.81 * ca.sin(q.angle)},
        parameters={"mass": fp.Parameter(approximate=value, exact=value, unit="kg")},
    )


@pytest.mark.parametrize("value", [HUGE, np.timedelta64(1, "s"), np.bool_(True), "1", None, 1j])
def test_what_is_no_number_is_no_parameter(value):
    with pytest.raises(InvalidField, match=r"(?s)approximate: expected a finite number.*exact: expected"):
        pendulum(value)


FILTERS = [
    lambda d: fp.KalmanFilter(measured={"angle": d}, noise={"angle": 1.0}),
    lambda d: fp.KalmanFilter(measured={"angle": 1.0}, noise={"angle": d}),
    lambda d: fp.KalmanFilter(measured={"angle": 1.0}, noise={"angle": 1.0}, start={"angle": d}),
    lambda d: fp.DisturbanceKalman(drift={"angle": d}, measured={"angle": 1.0}),
    lambda d: fp.DisturbanceKalman(drift={"angle": 1.0}, measured={"angle": d}),
    lambda d: fp.RecursiveLeastSquares({"mass": fp.Uncertain(1.0, 3.0, 0.1)}, {"angle": d}, time=1.0),
    lambda d: fp.Uncertain(1.0, 3.0, d),
]


@pytest.mark.parametrize("make", FILTERS, ids=range(len(FILTERS)))
@pytest.mark.parametrize("deviation", [1e200, 1e-200, 0.0, -1.0, float("inf"), HUGE])
def test_deviations_whose_square_is_no_number_are_refused(make, deviation):
    """Filters are made of variances: 1e200 squared overflows, 1e-200 squared is zero."""
    make(0.5)
    with pytest.raises(InvalidField, match="expected a positive number from 1e-100 to 1e100"):
        make(deviation)


def test_names_of_the_inner_modules_are_offered_as_those_of_the_package():
    """A misspelt rival or figure has the error of a misspelt name of the package; tools may ask for private names."""
    for module, name, meant in ((fp.rivals, "SldingMode", "SlidingMode"), (fp.figures, "overshot", "Overshoot")):
        with pytest.raises(InvalidName, match=f"Did you mean '{meant}'"):
            getattr(module, name)
        assert not hasattr(module, "_no_such_name")


# Whatever has names as keys: a name that is not there is one error with the nearest valid one


def mappings(value: Any, path: str, seen: set[int]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Every mapping in public fields of a value of this library, and of the values in them, with its path."""
    if id(value) in seen:
        return
    seen.add(id(value))
    inner: list[tuple[str, Any]] = []
    if isinstance(value, Mapping):
        if all(isinstance(key, str) for key in value):
            yield path, value
        inner = [(f"{path}[{key!r}]", content) for key, content in value.items()]
    elif isinstance(value, tuple):
        inner = [(f"{path}[{k}]", content) for k, content in enumerate(value)]
    elif is_dataclass(value) and type(value).__module__.startswith("fpirhc"):
        names = [f.name for f in fields(value) if not f.name.startswith("_")]
        inner = [(f"{path}.{name}", getattr(value, name)) for name in names]
    for where, content in inner:
        yield from mappings(content, where, seen)


def measured() -> Any:
    """A run and its metrics."""
    run = fp.simulate(brief(), tasks.two_mass.controllers["RHC+FPI"], seed=0, compiled=False)
    found = fp.measure(brief(), run)
    return run, found, found.statuses, found["cost"], found["plans"]


def stepped() -> Any:
    """What a stepper tells, with live settings."""
    stepper = fp.Stepper(brief(), tasks.two_mass.controllers["RHC+FPI"], live=["deformation.gain"], compiled=False)
    stepper.step_measured(0.0, np.zeros(len(stepper.measures)), stepper.start())
    return stepper.trace(), stepper.numbers, stepper.setpoints


def reviewed() -> Any:
    return fp.review(brief(), {NAME: adaptive()}, mismatch=5.0, seed=0)


# The problem, its plant and limits, the controllers and the ranges of the tuning; and results.
MADE = [(lambda: tasks.two_mass, 12), (measured, 20), (stepped, 3), (reviewed, 7)]


@pytest.mark.parametrize(("made", "least"), MADE)
def test_every_mapping_has_one_error_for_a_missing_name(made, least):
    value = made()
    found = list(mappings(value, type(value).__name__, set()))
    assert len(found) >= least
    lost = ("no such name", 3, ["a list"])
    assert [path for path, mapping in found if not all(tells(mapping, n) for n in lost)] == []


def tells(mapping: Mapping[str, Any], name: Any) -> bool:
    """Whether a missing name has the one error, with the name."""
    try:
        mapping[name]
    except InvalidName as error:
        return str(name) in str(error)
    except (KeyError, TypeError):
        return False
    return False


def test_the_nearest_name_is_offered():
    with pytest.raises(InvalidName, match=r"^Task\.controllers has no '.*'\. Did you mean 'RHC\+FPI'"):
        tasks.two_mass.controllers["RHC+FP"]
    with pytest.raises(InvalidName, match=r"^Plant\.parameters has no"):
        tasks.two_mass.problem.plant.parameters["mm"]
    with pytest.raises(KeyError):
        tasks.two_mass.controllers["nothing like it"]


@pytest.mark.parametrize("name", ["q1_rate", "q1_dot", "q1dot", "dq1", "q1_velocity", "speed_q1"])
def test_a_derivative_is_known_by_the_spellings_of_others(name):
    with pytest.raises(InvalidProblem, match=f"state '{name}' is unknown. Did you mean \"q1'\""):
        replace(tasks.two_mass.problem, start={**tasks.two_mass.problem.start, name: 0.0})
    with pytest.raises(InvalidName, match=r"For a derivative: .*Largest\(\"state.q1'\""):
        fp.study(tasks.two_mass, fp.Draws(1), metric=f"rms_error.{name}")


def test_what_a_frozen_value_holds_stays():
    """A start that was changed in place was shown, and the run began at the old one; the error says what to do."""
    problem = tasks.two_mass.problem
    start: Any = problem.start
    body: Any = problem.plant.parameters
    with pytest.raises(NotSupported, match=r"Problem\.start cannot be changed in place.*\{\*\*start, name: value\}"):
        start["q1"] = 1.0
    for change in (body.clear, body.popitem, lambda: body.pop("m1"), lambda: body.update({})):
        with pytest.raises(NotSupported, match=r"Plant\.parameters cannot be changed"):
            change()
    assert replace(problem, start={**problem.start, "q1": 1.0}).start_state[0] == 1.0
