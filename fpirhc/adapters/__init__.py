"""Simulators and hardware of others as realities, one file per package of the extra `fpirhc[outside]`.

They share the names of one world in the other, and errors that say whose they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

from fpirhc.errors import FpirhcError, InvalidProblem, InvalidValue, Mistakes
from fpirhc.fields.checked import checked_call
from fpirhc.plant.plant import Plant

P = ParamSpec("P")
R = TypeVar("R")


def adapter(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function with a check of its arguments, and with what its package raises as an error that names the function.

    Raises:
        InvalidProblem: whatever else the package raises about a file or a model, in its own words.
    """
    checked = checked_call(function)

    @wraps(function)
    def adapted(*arguments: P.args, **named: P.kwargs) -> R:
        try:
            return checked(*arguments, **named)
        except FpirhcError:
            raise
        except OSError as error:
            words = f"'{error.filename}' cannot be read: {error.strerror}" if error.filename else str(error)
            raise InvalidProblem(f"{function.__name__}: {words}") from error
        except Exception as error:
            words = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise InvalidProblem(f"{function.__name__}: {words}") from error

    return adapted


def finite_numbers(where: str, values: object, names: Iterable[str]) -> np.ndarray:
    """Return values as an array with one finite number for each name.

    Raises:
        InvalidValue: it has other ones, or none.
    """
    wanted = tuple(names)
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (len(wanted),) or not np.isfinite(numbers).all():
        raise InvalidValue(f"{where}({values!r}): expected a finite number for each of {', '.join(wanted)}")
    return numbers


def require(good: bool, words: str) -> None:
    """Raise where an answer of a device is bad.

    Raises:
        InvalidProblem: in these words.
    """
    if not good:
        raise InvalidProblem(words)


def require_seconds(where: str, model: Plant) -> None:
    """Raise where the model has another unit of time than a clock or a physics engine.

    Raises:
        InvalidProblem: it has.
    """
    fix = "write the model with time_unit='s', its rates and parameters too"
    require(model.time_unit == "s", f"{where}: its time is in s, and that of the model is in {model.time_unit}; {fix}")


def counterparts(
    mistakes: Mistakes, what: str, own: Iterable[str], given: Mapping[str, str], valid: Iterable[str]
) -> dict[str, str]:
    """Return the name outside of each own name: the given one, or the same; names that either side does not have are mistakes."""
    own, valid = tuple(dict.fromkeys(own)), tuple(valid)
    mistakes.unknown(f"{what}s: name of the model", given, own)
    found = {name: given.get(name, name) for name in own}
    mistakes.unknown(what, found.values(), valid)
    return found


def other_types(mistakes: Mistakes, variables: Iterable[Any], *valid: str) -> None:
    """Add a mistake for each variable (with a name and a type) that an adapter does not take; those that are unknown are None."""
    for one in variables:
        if one is not None and one.type not in valid:
            mistakes.add(f"variable '{one.name}' is of the type {one.type}; expected {' or '.join(valid)}")


def from_path_or_text(source: str | Path, by_path: Callable[[str], R], by_text: Callable[[str], R]) -> R:
    """Return what a package reads from a file of XML, or from its text, which begins with "<".

    Raises:
        OSError: the file cannot be read; packages say something else of one that is not there.
    """
    text = str(source)
    if text.lstrip().startswith("<"):
        return by_text(text)
    Path(text).open("rb").close()
    return by_path(text)


def steps_per_cycle(where: str, model: Plant, period: float, step: float) -> int:
    """Return how many steps of a simulator a control cycle has, both in s.

    Raises:
        InvalidProblem: the period is no whole number of steps, or the model has another unit of time.
    """
    require_seconds(where, model)
    count = max(round(period / step), 1)
    if abs(count * step - period) > 1e-9 * period:
        raise InvalidProblem(
            f"{where}: a cycle of {period:g} s is no whole number of its steps of {step:g} s; choose a period of "
            f"{count * step:g} s, or another step"
        )
    return count


def derivatives(mistakes: Mistakes, quantities: Iterable[str]) -> dict[str, tuple[str, int]]:
    """Return the base and the order of every quantity of a body that moves; beyond accelerations they are mistakes."""
    every = {one: (one.rstrip("'"), one.count("'")) for one in quantities}
    for name in (name for name, order in every.values() if order > 2):
        mistakes.add(
            f"{name} is of a higher order than 2 in the model, and a body that moves shows no derivatives beyond the second; "
            "write a model of order 2"
        )
    return every
