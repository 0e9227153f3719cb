"""Settings that stay open in a compiled loop: which numbers of a controller and its problem they are, and what they may be.

    live = live_settings(problem, controller, ["deformation.gain", "cost.states.q1", "limits.inputs.Q1.1"])

An automatic setting, such as the scale of a sigmoid, stays as it was chosen for the build. See docs/simulators.md.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np

from fpirhc.controllers.built import Built, checked, made
from fpirhc.controllers.contract import Controller, resolved
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, NotSupported, nearest
from fpirhc.fields.kinds import described, real_number
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.dotted import changed_at, content_at, entry, levels, meant, names_in, paths_to
from fpirhc.symbolic.evaluate import unwrapped
from fpirhc.symbolic.expression import holds_nan
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.open import ANEW, SETTINGS, Opened, not_live
from fpirhc.task.cases import is_whole, unit_of_setting
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem

OF_PROBLEM = ("cost", "limits", "reference")
_OF_BUILD = (ArithmeticError, AttributeError, FpirhcError, NotImplementedError, RuntimeError, TypeError, ValueError)
_PACKAGE = str(Path(__file__).parents[1])
# Of the search for bounds, in the number's size.
_REACHES = (1.0, 1e1, 1e2, 1e4, 1e8, 1e16, 1e32, 1e64, 1e128, 1e256)
_SMALLEST, _CLOSE = 1e-3, 1e-6
Numbers = Mapping[str, float]  # by path


@dataclass(frozen=True, eq=False)
class LiveSettings:
    """The live settings of one loop."""

    problem: Problem  # the problem with the numbers of the build
    unresolved: Controller  # the controller as it was given, for loops of other problems
    controller: Controller  # the same with its automatic settings chosen
    paths: tuple[str, ...] = ()  # of all live numbers

    @property
    def start(self) -> dict[str, float]:
        """The numbers of the build by path."""
        return {path: float(self._content(path)) for path in self.paths}

    def composed(self, compose: Callable[[Built], Composite], *, any_gain: bool = False) -> Composite:
        """Return what `compose` makes of the controller that is built with open numbers, if there are any."""
        ready = checked(self.problem, self.controller, any_gain=any_gain)
        if not self.paths:
            return compose(made(self.problem, ready))
        opened = Opened(self.start, [unit_of_setting(path, self.problem) for path in self.paths])
        try:
            composite = compose(made(*self._with(opened.symbols)))
        except _OF_BUILD as error:
            interruption = unwrapped(error)
            if not isinstance(interruption, Exception):
                raise interruption from None
            raise self._refusal(error, compose) from None
        for path in self.paths:
            if path not in opened.read:
                loop = f"the loop of {type(self.controller).__name__}"
                raise not_live([path], f"{loop} does not use it, or uses only what was computed from it before; {ANEW}")
        for block in composite.blocks:
            if holds_nan(block.function) or np.isnan(block.memory.start()).any():
                # CasADi makes NaN of a symbol that is turned into a number.
                raise not_live(self.paths, f"block '{block.name}' turns one of them into a number; {ANEW}", " together")
        return composite

    def _refusal(self, error: Exception, compose: Callable[[Built], Composite]) -> Exception:
        """The error that names the setting and the place, for an error of the build."""
        if isinstance(error, FpirhcError) and any(f"'{path}'" in str(error) for path in self.paths):
            return error
        for path in self.paths if len(self.paths) > 1 else ():
            try:
                replace(self, paths=(path,)).composed(compose)
            except NotSupported as alone:
                return alone
        every = traceback.extract_tb(error.__traceback__)
        place = [one for one in every if one.filename.startswith(_PACKAGE)][-1]
        where = f"{Path(place.filename).stem}.{place.name}"
        return not_live(self.paths, f"{where} needs its number while the loop is built; {ANEW}", " here")

    def changed(self, numbers: Numbers) -> tuple[Problem, Controller, dict[str, float]]:
        """Return problem and controller with other numbers, checked, and the numbers of all settings by path."""
        values = self.start | self.flat(numbers)
        for path, value in values.items():
            if not math.isfinite(value):  # whether there is a limit decides what is compiled
                raise InvalidValue(
                    f"setting '{path}' cannot become {value}: the compiled loop has this number in its code; use a large one"
                )
        others = {path: value for path, value in values.items() if value != self.start[path]}
        if not others:  # those of the build are checked
            return self.problem, self.controller, values
        problem, controller = self._with(others)
        return problem, checked(problem, controller, numbers_only=True), values

    @cached_property
    def bounds(self) -> dict[str, Interval]:
        """The interval around the number of the build in which each setting is accepted while the others stay, by path."""
        return {path: self._bounds(path) for path in self.paths}

    def _bounds(self, path: str) -> Interval:
        # A limit of an input is a fact of the plant: it ends at that of the build.
        of_plant = path[-2:] if path.startswith("limits.inputs.") else ""
        ends = (("." + "01"[side > 0], side) for side in (-1, 1))
        low, high = (self._content(path) if end == of_plant else self._end(path, side) for end, side in ends)
        return low, high

    def _end(self, path: str, side: int) -> float:
        value = self._content(path)
        step, outside = side * max(abs(value), _SMALLEST), value
        for far in _REACHES:
            inside, outside = outside, value + step * far
            if not self._accepts(path, outside):
                break
        else:
            return side * math.inf
        while abs(outside - inside) > _CLOSE * max(abs(inside), abs(step)):
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if self._accepts(path, middle) else (inside, middle)
        return inside

    def _accepts(self, path: str, value: float) -> bool:
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # bounds are sought with numbers of any size
                self.changed({path: value})
        except FpirhcError:
            return False
        return True

    def flat(self, numbers: Numbers) -> dict[str, float]:
        """Return numbers of live settings by path, checked."""
        values: dict[str, float] = {}
        for path, value in numbers.items():
            if path not in self.paths:
                raise InvalidName(f"setting '{path}' is not live in this loop.{nearest(path, self.paths)}")
            number = real_number(value)
            if number is None or math.isnan(number):
                raise InvalidValue(f"setting '{path}': expected a number, got {described(value)}")
            values[path] = number
        return values

    def places(self, memory: Layout) -> np.ndarray:
        """Return where a memory has the numbers of all live settings."""
        return np.arange(memory.size)[memory.slice(SETTINGS)] if self.paths else np.zeros(0, dtype=int)

    def _with(self, contents: Mapping[str, object]) -> tuple[Problem, Controller]:
        """Problem and controller with other contents, by path."""
        problem, controller = self.problem, self.controller
        for path, content in contents.items():
            if _owner(self.problem, self.controller, path) is self.problem:
                problem = changed_at(problem, path, content)
            else:
                controller = changed_at(controller, path, content)
        return problem, controller

    def _content(self, path: str) -> float:
        return cast(float, content_at(_owner(self.problem, self.controller, path), path))


def live_settings(problem: Problem, controller: Controller, paths: Sequence[str] = ()) -> LiveSettings:
    """Return the live settings of a loop, with the controller resolved."""
    for path in paths:
        _check(problem, controller, path)
    return LiveSettings(problem, controller, resolved(problem, controller), tuple(dict.fromkeys(paths)))


def _check(problem: Problem, controller: Controller, path: str) -> None:
    """Raise unless a finite number stands at the path that is no whole number and no switch."""
    owner = _owner(problem, controller, path)
    content = content_at(owner, path, "the problem" if owner is problem else "the controller")
    if isinstance(content, bool) or (isinstance(content, int | float) and is_whole(owner, path)):
        what = f"{content!r} decides what the loop is made of, as whole numbers and switches do"
        raise not_live([path], f"{what}; {ANEW}")
    if not isinstance(content, int | float | np.number):
        ways = ", ".join(names_in(content)) or "none"
        hint = "give it a number first" if content is None else f"go on with one of: {ways}"
        raise InvalidValue(f"setting '{path}' is {content!r}, not a number; {hint}")
    if not math.isfinite(content):
        raise InvalidValue(f"setting '{path}' is {content!r}: no limit that could change; give it a finite number")


def _owner(problem: Problem, controller: Controller, path: str) -> Problem | Controller:
    """The controller, or the problem for a cost, limits or a reference that the controller does not have."""
    first, dot, rest = path.partition(".")
    own = [*dict.fromkeys(n for one in levels(controller) for n in names_in(one) if entry(one, n) is not None)]
    shared = [n for n in OF_PROBLEM if getattr(problem, n) is not None]
    if first in (*own, *shared):
        return controller if first in own else problem
    hint = meant(f"{one}{dot}{rest}" for one in paths_to(first, controller)) or nearest(first, [*own, *shared])
    if first in ("start", "plant", "parameters", *problem.plant.parameters):
        hint = (
            " Parameters (exact and approximate) and the start are data of every loop; they need no live setting: --set takes "
            "exact.NAME, approximate.NAME and start.NAME"
        )
    raise InvalidName(
        f"setting '{path}': neither the controller nor the problem's {', '.join(OF_PROBLEM)} have '{first}'.{hint}"
    )
