"""What a law is, how laws are tried, and the law of every value.

A law is a function of a trial, which has the member and what it is tried in, and of a generator of random numbers: it yields a
sentence for everything that breaks it. Its name and the first line of its docstring say what it asks for.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import is_dataclass
from inspect import isfunction
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fpirhc.describe import describe
from fpirhc.errors import FpirhcError
from fpirhc.members import FAMILIES as FAMILIES
from fpirhc.members import Example as Example
from fpirhc.members import examples as examples
from fpirhc.members import member_classes as member_classes

Array: TypeAlias = npt.NDArray[Any]
Draw: TypeAlias = np.random.Generator
Broken: TypeAlias = Iterator[str]
Law: TypeAlias = Callable[[Any, Draw], Broken]


def laws_of(module: str) -> tuple[Law, ...]:
    """The laws of a family's module, in the order in which they stand there: every function that yields what breaks it."""
    own = (value for value in vars(sys.modules[module]).values() if isfunction(value) and value.__module__ == module)
    return tuple(one for one in own if one.__annotations__.get("return") == "Broken" and one.__name__[0] != "_")


def keep(trial: Any, seed: int) -> None:
    """Try the laws beside the class of a trial, each with a generator of its own; AssertionError: what breaks the first one."""
    subject = type(_member(trial)).__name__
    for law in (frozen_value, *laws_of(type(trial).__module__)):
        name = law.__name__.replace("_", " ")
        try:
            broken = next(law(trial, np.random.default_rng(seed)), "")
        except FpirhcError:
            raise
        except Exception as error:
            error.add_note(f"raised by {subject} while its law '{name}' was tried")
            raise
        if broken:
            text = (law.__doc__ or name).strip().splitlines()[0]
            raise AssertionError(f"{subject} breaks the law '{name}': {broken}. The law: {text}")


def _member(trial: Any) -> object:
    """The first field of every trial."""
    return next(iter(vars(trial).values()))


def within(value: Any, bound: float) -> bool:
    """Return whether every entry is at most `bound` in size; NaN is not."""
    return bool(np.all(np.abs(np.asarray(value, dtype=float)) <= bound))


def frozen_value(trial: Any, draw: Draw) -> Broken:
    """A member is a frozen dataclass that can be hashed, compared, copied, and described as plain data."""
    subject = _member(trial)
    if not (is_dataclass(subject) and getattr(subject, "__dataclass_params__").frozen):  # noqa: B009
        yield "its settings can be changed after a loop was built from them; write @dataclass(frozen=True)"
    try:
        hash(subject)
    except TypeError as error:
        yield f"it cannot be hashed ({error}); use tuples for its settings, or @dataclass(frozen=True, eq=False)"
    described = describe(subject)
    if describe(deepcopy(subject)) != described:
        yield "a copy of it has another description"
    try:
        json.dumps(described)
    except (TypeError, ValueError) as error:
        yield f"its description is no plain data ({error})"
