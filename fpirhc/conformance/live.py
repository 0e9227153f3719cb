"""The law of live settings: a number that a loop keeps open is nowhere lost on its way into the loop."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fpirhc.conformance.laws import hold
from fpirhc.controllers.base import Controller
from fpirhc.errors import CompileError, FpirhcError, NotSupported
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.symbolic.paths import entry, names_in
from fpirhc.task.problem import Problem

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
    together = _together(short, controller, tested, plain.log, compiled)
    return together or tuple(_tried(short, controller, path, plain.log, compiled) for path in tested)


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


def _together(
    problem: Problem, controller: Controller, paths: Sequence[str], plain: np.ndarray, compiled: bool
) -> tuple[Tried, ...] | None:
    """Change all numbers at once: two loops for all of them; None where each is to be tried alone, to find the lost one."""
    tried: dict[str, Tried] = {}
    ready = None
    while ready is None and len(tried) < len(paths):
        try:
            ready = simulator(problem, controller, compiled=compiled, live=[p for p in paths if p not in tried])
        except CompileError:
            raise
        except FpirhcError as error:
            named = [p for p in paths if p not in tried and f"'{p}'" in str(error)]
            if not named:
                return None
            tried |= {path: _tried(problem, controller, path, plain, compiled) for path in named}
    if ready is None:
        return tuple(tried[path] for path in paths)
    changes: dict[str, float] = {}
    for path in (p for p in paths if p not in tried):
        factor = next((f for f in _FACTORS if _accepted(ready, {**changes, path: f * ready.live.start[path]})), None)
        if factor is None:
            tried[path] = _tried(problem, controller, path, plain, compiled)
        else:
            tried[path] = Tried(path, factor=factor)
            changes[path] = factor * ready.live.start[path]
    try:
        changed_problem, changed_controller, _ = ready.live.changed(changes)
        rebuilt = simulator(changed_problem, changed_controller, compiled=compiled).run(seed=0)
        pairs = ((ready.run(seed=0).log, plain), (ready.run(seed=0, settings=changes).log, rebuilt.log))
    except FpirhcError:
        return None
    alike = all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)
    return tuple(tried[path] for path in paths) if alike else None


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
