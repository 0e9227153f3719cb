"""The shared parts of the conformance laws: trying a law, reporting a broken one, and the laws of every value."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import FrozenInstanceError, fields, is_dataclass
from typing import Any

import numpy as np

from fpirhc.describe import describe
from fpirhc.errors import FpirhcError

Law = Callable[[Any, np.random.Generator], None]


def keep(subject: object, trial: Any, laws: Sequence[Law], seed: int) -> None:
    """Try the laws one after the other, each with a generator of its own.

    Args:
        subject: the value that the laws are about.
        trial: first argument of the laws.
        laws: the laws.
        seed: of the generators.

    Raises:
        AssertionError: the first law that is broken, with the class, the law's text, and the numbers.
        FpirhcError: an error of the subject itself, which cannot be used at all.
    """
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
