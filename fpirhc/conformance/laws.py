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


def is_a_frozen_value(subject: Any) -> None:
    """A method is a frozen dataclass that can be hashed, compared, copied, and described as plain data."""
    name = type(subject).__name__
    hold(
        is_dataclass(subject) and not isinstance(subject, type),
        f"{name} is no dataclass; write @dataclass(frozen=True)",
    )
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
    bit by bit, and the number of the build as the loop without live settings.

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
    plain = simulator(short, controller, compiled=compiled).run(seed=0)
    tested = list(number_paths(problem, controller)) if paths is None else paths
    return _searched(short, controller, tested, plain.log, compiled)


def number_paths(problem: Problem, controller: Controller) -> Iterator[str]:
    """Yield the path of every number of a controller, and of the problem's cost and limits where these are its own."""
    yield from _paths(controller, "")
    for name in ("cost", "limits", "dead_time"):
        if getattr(problem, name) is not None and getattr(controller, name, None) is None:
            yield from _paths(getattr(problem, name), f"{name}.")


def _paths(value: Any, start: str) -> Iterator[str]:
    for name in names_in(value):
        content = entry(value, name)
        if isinstance(content, int | float) and not isinstance(content, bool):
            yield f"{start}{name}"
        yield from _paths(content, f"{start}{name}.")


def _searched(
    problem: Problem, controller: Controller, paths: Sequence[str], plain: np.ndarray, compiled: bool
) -> tuple[Tried, ...]:
    """Try all numbers at once, and halves of them where one is refused or lost, so that few loops are built."""
    if len(paths) < 2:
        return tuple(_tried(problem, controller, path, plain, compiled) for path in paths)
    apart = paths[: len(paths) // 2]
    try:
        ready = simulator(problem, controller, compiled=compiled, live=paths)
        together = _together(ready, paths, plain)
        if together is not None:
            return together
    except CompileError:
        raise
    except FpirhcError as error:
        named = [path for path in paths if f"'{path}'" in str(error)]
        apart = named if 0 < len(named) < len(paths) else apart
    rest = [path for path in paths if path not in apart]
    tried = {t.path: t for part in (apart, rest) for t in _searched(problem, controller, part, plain, compiled)}
    return tuple(tried[path] for path in paths)


def _together(ready: Simulator, paths: Sequence[str], plain: np.ndarray) -> tuple[Tried, ...] | None:
    """Change all numbers at once; None where the loop does not run as the one that is built with them."""
    changes: dict[str, float] = {}
    tried = []
    for path in paths:
        value = ready.live.start[path]
        factor = next((f for f in _FACTORS if _accepted(ready, {**changes, path: value * f})), None)
        if factor is not None:
            changes[path] = value * factor
        tried.append(Tried(path, factor=factor))
    problem, controller, _ = ready.live.changed(changes)
    rebuilt = simulator(problem, controller, compiled=ready.compiled).run(seed=0)
    pairs = ((ready.run(seed=0).log, plain), (ready.run(seed=0, settings=changes).log, rebuilt.log))
    return tuple(tried) if all(np.array_equal(one, other, equal_nan=True) for one, other in pairs) else None


def _accepted(ready: Simulator, changes: dict[str, float]) -> bool:
    try:
        ready.live.changed(changes)
    except FpirhcError:
        return False
    return True


def _tried(problem: Problem, controller: Controller, path: str, plain: np.ndarray, compiled: bool) -> Tried:
    try:
        ready = simulator(problem, controller, compiled=compiled, live=[path])
    except CompileError:
        raise
    except FpirhcError as error:
        hold(f"'{path}'" in str(error), f"setting '{path}' is refused without its name: {error}")
        return Tried(path, refused=str(error))
    same = np.array_equal(ready.run(seed=0).log, plain, equal_nan=True)
    hold(same, f"with the live setting '{path}' the loop runs differently although its number is the same")
    value = ready.live.start[path]
    for factor in _FACTORS:
        if _runs_as_rebuilt(ready, path, value * factor):
            return Tried(path, factor=factor)
    return Tried(path)


def _runs_as_rebuilt(ready: Simulator, path: str, value: float) -> bool:
    """Whether the number is accepted; then the changed and the rebuilt loop must run alike."""
    try:
        problem, controller, _ = ready.live.changed({path: value})
    except FpirhcError as error:
        hold(not isinstance(error, NotSupported) or path in str(error), f"setting '{path}' = {value:g}: {error}")
        return False
    rebuilt = simulator(problem, controller, compiled=ready.compiled)
    changed, expected = ready.run(seed=0, settings={path: value}), rebuilt.run(seed=0)
    if not np.array_equal(changed.log, expected.log, equal_nan=True):
        rows = min(changed.cycles, expected.cycles)
        apart = np.nanmax(np.abs(changed.log[:rows] - expected.log[:rows])) if rows else np.nan
        hold(
            False, f"with '{path}' = {value:g} the loop runs differently from one that is built with it, by {apart:.3g}"
        )
    return True
