"""Simulators and hardware of others as realities, one file per package of the extra `fpirhc[outside]`.

They share the names of one world in the other, and errors that say whose they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from typing import ParamSpec, TypeVar

from fpirhc.errors import FpirhcError, InvalidProblem, Mistakes
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
