"""The shared parts of the conformance laws: trying a law, reporting a broken one, and the laws of every value."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import FrozenInstanceError, dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.describe import describe
from fpirhc.errors import CompileError, FpirhcError, NotSupported
from fpirhc.members import FAMILIES as FAMILIES
from fpirhc.members import Example as Example
from fpirhc.members import examples as examples
from fpirhc.members import member_classes as member_classes
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.symbolic.paths import entry, names_in
from fpirhc.task.problem import Problem

Law = Callable[[Any, np.random.Generator], None]


def keep(subject: object, trial: Any, laws: Sequence[Law], seed: int) -> None:
    """Try the laws one after the other, each with a generator of its own."""
    for law in laws:
        name = law.__name__.replace("_", " ")
        try:
            law(trial, np.random.default_rng(seed))
        except AssertionError as error:
            text = (law.__doc__ or name).strip().splitlines()[0]
            raise AssertionError(
                f"{type(subject).__name__} breaks the law '{name}': {error}. The law: {text}"
            ) from None
        except FpirhcError:
            raise
        except Exception as error:
            error.add_note(f"raised by {type(subject).__name__} while its law '{name}' was tried")
            raise


def hold(law: bool, sentence: str) -> None:
    """Raise AssertionError with the sentence unless the law holds."""
    if not law:
        raise AssertionError(sentence)


def within(value: Any, bound: float) -> bool:
    """Return whether every entry is at most `bound` in size; NaN is not."""
    return bool(np.all(np.abs(np.asarray(value, dtype=float)) <= bound))


def frozen_value(trial: Any, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A member is a frozen dataclass that can be hashed, compared, copied, and described as plain data."""
    subject = next(iter(vars(trial).values()))  # the first field of every trial
    hold(is_dataclass(subject), f"{type(subject).__name__} is no dataclass; write @dataclass(frozen=True)")
    for field in fields(subject):
        try:
            setattr(subject, field.name, getattr(subject, field.name))
        except FrozenInstanceError:
            continue
        hold(False, f"its field '{field.name}' can be set; write @dataclass(frozen=True)")
    try:
        same = hash(subject) == hash(subject)
    except TypeError as error:
        hold(False, f"it cannot be hashed ({error}); use tuples for its settings, or @dataclass(frozen=True, eq=False)")
    hold(same, "its hash changes from call to call")
    described = describe(subject)
    hold(describe(deepcopy(subject)) == described, "a copy of it has another description")
    try:
        json.dumps(described)
    except (TypeError, ValueError) as error:
        hold(False, f"its description is no plain data ({error})")


_FACTORS = (1.07, 0.93, 1.01, 0.5, 2.0)  # the first one that the setting accepts
_SHARE, _CLOSE = 0.5, 1e-6


@dataclass(frozen=True)
class Tried:
    """What became of one number that was asked to be live.

    Args:
        path: of the number.
        refused: why it cannot be live; empty where it can.
        factor: by which the number was changed; None where no change of it is accepted.
    """

    path: str
    refused: str = ""
    factor: float | None = None


def check_live(
    problem: Problem,
    controller: Controller,
    *,
    paths: Sequence[str] | None = None,
    cycles: int = 40,
    compiled: bool = False,
) -> tuple[Tried, ...]:
    """Try each number of a controller, and of the problem's cost and limits, as a live setting; return which are supported.

    Every number either is refused by name, or a loop with another number in it runs as the loop that is built with that number,
    bit by bit, and the number of the build as the loop without live settings. Plans keep the step length and the first plan of
    the build: behind them the command is nearer to that of the loop built with the number than to that of the first one, which
    holds for plans that are solved.

    Args:
        problem: on which the loops are tried.
        controller: whose numbers are asked.
        paths: of the numbers; None: all of them.
        cycles: length of the runs.
        compiled: whether to try compiled C instead of the virtual machine.

    Raises:
        AssertionError: the first number that is lost, in one sentence.
    """
    short = replace(problem, duration=cycles * problem.period, measure_from=0.0)
    asked = list(number_paths(problem, controller)) if paths is None else list(paths)
    opened, refused = list(asked), dict[str, str]()
    while opened:
        try:
            ready = simulator(short, controller, compiled=compiled, live=opened)
            break
        except CompileError:
            raise
        except FpirhcError as error:
            named = [path for path in opened if f"'{path}'" in str(error)]
            hold(bool(named), f"one of the settings {opened} is refused without its name: {error}")
            guilty = [path for path in named if len(named) == 1 or _refused_alone(short, controller, path)] or named
            refused |= dict.fromkeys(guilty, str(error))
            opened = [path for path in opened if path not in guilty]
    factors: dict[str, float | None] = {}
    if opened:
        plain = simulator(short, controller, compiled=compiled).run(seed=0)
        same = np.array_equal(ready.run(seed=0).log, plain.log, equal_nan=True)
        hold(same, f"with live settings {opened} the loop runs differently although their numbers are the same")
        for path in opened:
            factors[path] = next(
                (f for f in _FACTORS if _runs_as_rebuilt(ready, path, ready.live.start[path] * f)), None
            )
    return tuple(Tried(path, refused.get(path, ""), factors.get(path)) for path in asked)


def _refused_alone(problem: Problem, controller: Controller, path: str) -> bool:
    try:
        simulator(problem, controller, compiled=False, live=[path])
    except FpirhcError:
        return True
    return False


def number_paths(problem: Problem, controller: Controller) -> Iterator[str]:
    """Yield the path of every number of a controller, and of the problem's cost and limits where these are its own."""
    yield from _paths(controller, "")
    for name in ("cost", "limits"):
        if getattr(problem, name) is not None and getattr(controller, name, None) is None:
            yield from _paths(getattr(problem, name), f"{name}.")


def _paths(value: Any, start: str) -> Iterator[str]:
    for name in names_in(value):
        content = entry(value, name)
        if isinstance(content, int | float) and not isinstance(content, bool):
            yield f"{start}{name}"
        yield from _paths(content, f"{start}{name}.")


def _runs_as_rebuilt(ready: Simulator, path: str, value: float) -> bool:
    """Whether the number is accepted; then the changed and the rebuilt loop must run alike."""
    try:
        problem, controller, _ = ready.live.changed({path: value})
    except FpirhcError as error:
        hold(not isinstance(error, NotSupported) or path in str(error), f"setting '{path}' = {value:g}: {error}")
        return False
    rebuilt = simulator(problem, controller, compiled=ready.compiled)
    plain, changed, expected = ready.run(seed=0), ready.run(seed=0, settings={path: value}), rebuilt.run(seed=0)
    if controller.planner is None:
        same = np.array_equal(changed.log, expected.log, equal_nan=True)
    else:  # scale, step length and first plan stay those of the build
        apart, effect = (np.nanmax(np.abs(one["command"] - expected["command"])) for one in (changed, plain))
        same = apart <= _SHARE * effect + _CLOSE * np.nanmax(np.abs(expected["command"]))
    hold(same, f"with '{path}' = {value:g} the loop runs differently from one that is built with it")
    return True
