"""Whatever has names as keys and a user reaches: a name that is not there is one clear error with the nearest valid one."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.errors import InvalidName, InvalidProblem, NotSupported

shortened = cache(
    lambda: replace(tasks.two_mass, problem=replace(tasks.two_mass.problem, duration=0.05, measure_from=0.0))
)
headline = cache(lambda: tasks.two_mass.headline or ("", ""))
QUICK = ["CTC", "CTC+FPI (eq 6)"]


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
    run = fp.simulate(shortened().problem, shortened().controllers[headline()[1]], seed=0, compiled=False)
    found = fp.measure(shortened().problem, run)
    return run, found, found.statuses, found["cost"], found["plans"]


def stepped() -> Any:
    """What a stepper tells, with live settings."""
    stepper = fp.Stepper(
        tasks.two_mass.problem, tasks.two_mass.controllers[headline()[1]], live=["deformation.gain"], compiled=False
    )
    stepper.step_measured(0.0, np.zeros(len(stepper.measures)), stepper.start())
    return stepper.trace(), stepper.numbers, stepper.setpoints


def reviewed() -> Any:
    """A review."""
    return fp.review(shortened().problem, {QUICK[1]: shortened().controllers[QUICK[1]]}, mismatch=5.0, seed=0)


def test_every_mapping_of_a_problem_file_has_one_error_for_a_missing_name():
    """The problem, its plant and limits, the controllers and the ranges of the tuning."""
    holds(tasks.two_mass, least=12)


@pytest.mark.parametrize(("made", "least"), [(measured, 20), (stepped, 3), (reviewed, 8)])
def test_every_mapping_of_a_result_has_one_error_for_a_missing_name(made, least):
    holds(made(), least)


def holds(value: Any, least: int) -> None:
    found = list(mappings(value, type(value).__name__, set()))
    assert len(found) >= least
    assert [
        path for path, mapping in found if not all(tells(mapping, n) for n in ("no such name", 3, ["a list"]))
    ] == []


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
    name = headline()[1]
    with pytest.raises(InvalidName, match=rf"^Task\.controllers has no '.*'\. Did you mean '{re.escape(name)}'"):
        tasks.two_mass.controllers[name[:-1]]
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
