"""Live settings of one run: the numbers at its start, and changes while it runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.contract import Controller
from fpirhc.controllers.live_settings import LiveSettings, Numbers
from fpirhc.errors import InvalidField, InvalidValue
from fpirhc.fields.kinds import described, finite_number, named_entries
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.open import SETTINGS
from fpirhc.task.problem import Problem

Changes = Mapping[float, Numbers]  # by time, s


@dataclass(frozen=True, eq=False)
class InForce:
    """The settings of one run."""

    problem: Problem  # the problem with the numbers at the start
    controller: Controller  # the controller with them
    numbers: Mapping[str, float]  # of all live settings at the start, by path
    # (first cycle, places in the memory, values) of every change, in the order of time
    patches: Sequence[tuple[int, np.ndarray, np.ndarray]]
    # what was in force when, as plain data: pairs of a time in s and {path: number}
    record: Sequence[tuple[float, Mapping[str, float]]]


def in_force(live: LiveSettings, loop: Composite, problem: Problem, settings: Numbers, changes: Changes) -> InForce:
    """Return the settings of a run, checked before it starts."""
    named_entries("settings", settings)
    _check_times(changes)
    if not (live.paths or settings or changes):
        return InForce(problem, live.controller, {}, (), ())
    first = replace(live, problem=problem)
    if not settings and not changes:  # a variant of the problem runs as it does without live settings
        numbers = first.start
        return InForce(problem, live.controller, numbers, (), [(0.0, numbers)])
    ready, controller, numbers = first.changed(settings)
    record: list[tuple[float, Mapping[str, float]]] = [(0.0, numbers)] if numbers else []
    patches, settings_now = [], dict(first.flat(settings))
    for time in sorted(changes):
        if not 0 <= time < problem.duration:
            raise InvalidValue(f"a change of settings at {time!r} s: expected a time in [0, {problem.duration:g}) s")
        settings_now |= first.flat(changes[time])
        values = first.changed(settings_now)[2]
        cycle = int(np.ceil(time / problem.period - 1e-9))
        patches.append((cycle, *patch(loop, values)))
        record.append((cycle * problem.period, values))
    return InForce(ready, controller, numbers, patches, record)


def _check_times(changes: Changes) -> None:
    """Raise for anything but numbers by time."""
    if not isinstance(changes, Mapping):
        raise InvalidField([f"changes: expected a mapping {{time: {{name: number}}}}, got {described(changes)}"])
    wrong = [f"changes: the time of a change is a number, got {described(t)}" for t in changes if not finite_number(t)]
    if wrong:
        raise InvalidField(wrong)
    for time, numbers in changes.items():
        named_entries(f"changes at {time:g}", numbers)


def patch(loop: Composite, numbers: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return places in a loop's memory, and the values that the settings have there."""
    places = np.arange(loop.memory.size)[loop.memory.slice(SETTINGS)]
    return places, np.array(list(numbers.values()), dtype=float)
