"""What a law is, how laws are tried, and the law of every value.

A law is a function of a trial, which has the member and what it is tried in, and of a generator of random numbers: it yields a
sentence for everything that breaks it. Its name and the first line of its docstring say what it asks for.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import is_dataclass
from typing import Any, TypeAlias

import numpy as np

from fpirhc.describe import describe
from fpirhc.errors import FpirhcError
from fpirhc.members import FAMILIES as FAMILIES
from fpirhc.members import Example as Example
from fpirhc.members import examples as examples
from fpirhc.members import member_classes as member_classes

Broken: TypeAlias = Iterator[str]
Law: TypeAlias = Callable[[Any, np.random.Generator], Broken]


def keep(subject: object, trial: Any, laws: Sequence[Law], seed: int) -> None:
    """Try the laws one after the other, each with a generator of its own; AssertionError: the first sentence of a broken one."""
    for law in laws:
        name = law.__name__.replace("_", " ")
        try:
            broken = next(law(trial, np.random.default_rng(seed)), "")
        except FpirhcError:
            raise
        except Exception as error:
            error.add_note(f"raised by {type(subject).__name__} while its law '{name}' was tried")
            raise
        text = (law.__doc__ or name).strip().splitlines()[0]
        if broken:
            raise AssertionError(f"{type(subject).__name__} breaks the law '{name}': {broken}. The law: {text}")


def within(value: Any, bound: float) -> bool:
    """Return whether every entry is at most `bound` in size; NaN is not."""
    return bool(np.all(np.abs(np.asarray(value, dtype=float)) <= bound))


def frozen_value(trial: Any, draw: np.random.Generator) -> Broken:
    """A member is a frozen dataclass that can be hashed, compared, copied, and described as plain data."""
    subject = next(iter(vars(trial).values()))  # the first field of every trial
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
