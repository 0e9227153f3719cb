"""The law of open numbers: each runs as in the loop that is built with it, or is refused by its path."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError, NotSupported
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.symbolic.paths import entry, names_in
from fpirhc.task.problem import Problem

_FACTORS = (1.07, 0.93, 1.01, 0.5, 2.0)  # the first one that the setting accepts
_SHARE, _CLOSE = 0.5, 1e-6


Became: TypeAlias = dict[str, float | str | None]


def check_live(
    problem: Problem, controller: Controller, *, paths: Sequence[str] | None = None, cycles: int = 40
) -> Became:
    """Try each number of a controller, and of the problem's cost and limits, as a live setting; return what became of it, by path.

    Every number either is refused by name, or a loop with another number in it runs as the loop that is built with that number,
    bit by bit, and the number of the build as the loop without live settings. Plans keep the step length and the first plan of
    the build: behind them the command is nearer to that of the loop built with the number than to that of the first one, which
    holds for plans that are solved. What became of it: why it is refused, the factor by which it was changed, or None: no change
    is accepted.

    Args:
        problem: on which the loops are tried.
        controller: whose numbers are asked.
        paths: of the numbers; None: all of them.
        cycles: length of the runs.
    """
    short = replace(problem, duration=cycles * problem.period, measure_from=0.0)
    asked = list(_own_paths(problem, controller)) if paths is None else list(paths)
    opened, became, ready = list(asked), Became(), None
    while opened and ready is None:
        try:
            ready = simulator(short, controller, compiled=False, live=opened)
        except FpirhcError as error:
            named = [path for path in opened if f"'{path}'" in str(error)]
            _hold(bool(named), f"one of the settings {opened} is refused without its name: {error}")
            if len(named) > 1:  # together: those that open alone are not the ones
                named = [path for path in named if not _opens(short, controller, path)] or named
            became |= dict.fromkeys(named, str(error))
            opened = [path for path in opened if path not in named]
    if ready is not None:
        plain = simulator(short, controller, compiled=False).run(seed=0)
        same = np.array_equal(ready.run(seed=0).log, plain.log, equal_nan=True)
        _hold(same, f"with live settings {opened} the loop runs differently although their numbers are the same")
        for path in opened:
            became[path] = next((factor for factor in _FACTORS if _runs_as_rebuilt(ready, path, factor)), None)
    return became


def _opens(problem: Problem, controller: Controller, path: str) -> bool:
    try:
        return bool(simulator(problem, controller, compiled=False, live=[path]).live.paths)
    except FpirhcError:
        return False


def _own_paths(problem: Problem, controller: Controller) -> Iterator[str]:
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


def _runs_as_rebuilt(ready: Simulator, path: str, factor: float) -> bool:
    """Whether another number is accepted; then the changed and the rebuilt loop must run alike."""
    number = {path: ready.live.start[path] * factor}
    try:
        problem, controller, _ = ready.live.changed(number)
    except FpirhcError as error:
        _hold(not isinstance(error, NotSupported) or path in str(error), f"setting {number}: {error}")
        return False
    expected = simulator(problem, controller, compiled=False).run(seed=0)
    plain, changed = ready.run(seed=0), ready.run(seed=0, settings=number)
    if controller.planner is None:
        same = np.array_equal(changed.log, expected.log, equal_nan=True)
    else:  # scale, step length and first plan stay those of the build
        apart, effect = (np.nanmax(np.abs(one["command"] - expected["command"])) for one in (changed, plain))
        same = apart <= _SHARE * effect + _CLOSE * np.nanmax(np.abs(expected["command"]))
    _hold(same, f"with {number} the loop runs differently from one that is built with it")
    return True


def _hold(law: bool, sentence: str) -> None:
    if not law:
        raise AssertionError(sentence)
