"""A part of a result that breaks, such as a linear loop that is not finite: it is told by its name and leaves the rest alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from fpirhc.symbolic.evaluate import unwrapped

Result = TypeVar("Result")


def words_of(error: BaseException) -> str:
    """Return class and first line of an error: "LinAlgError: Array must not contain infs or NaNs"."""
    first = f"{error}".strip().partition("\n")[0]
    return f"{type(error).__name__}: {first}" if first else type(error).__name__


def attempted(
    what: str, compute: Callable[..., Result], *arguments: object, broken: list[str], **named: object
) -> Result | None:
    """Return what a function returns; None where it raises, with a sentence about it added to `broken`.

    Args:
        compute: the function.
    """
    try:
        with np.errstate(all="ignore"):  # numbers that overflow show in the result
            return compute(*arguments, **named)
    except Exception as error:  # noqa: BLE001 -- whatever it is, what was computed before must not be lost
        interruption = unwrapped(error)
        if not isinstance(interruption, Exception):
            raise interruption from None
        broken.append(f"{what} could not be computed ({words_of(error)}); the rest does not depend on it")
        return None
