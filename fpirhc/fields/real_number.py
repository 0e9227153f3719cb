"""What counts as one real number, wherever a user or a stranger gives one."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np


def real_number(value: object) -> float | None:
    """Return one real number as a float, which may be NaN or infinite; None for everything else.

    Arrays with one entry count. No numbers are texts, truth values, None, complex numbers, durations (numpy makes integers of
    them), expressions, and whole numbers beyond the largest float, 1.8e308.
    """
    if type(value) is float:
        return value
    if isinstance(value, np.ndarray):
        if isinstance(value, np.ma.MaskedArray) or value.size != 1:
            return None
        value = value.ravel()[0]
    if isinstance(value, bool | np.bool_ | np.timedelta64) or not isinstance(value, Real):
        return None
    try:
        return float(value)
    except (OverflowError, TypeError, ValueError):  # 10**400; a class of somebody's that only says that it is a number
        return None


def finite_number(value: object) -> bool:
    """Return whether it is one real number that is finite."""
    number = real_number(value)
    return number is not None and math.isfinite(number)
