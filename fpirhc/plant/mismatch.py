"""The mismatch of P percent, as an option or an argument: the range of every exact parameter.

    |p - p_exact| <= P/100 |p_exact|,        0 <= P < 100,        p_exact the exact value in the problem file,

for a parameter without a spread of its own, so that it keeps its sign, and zero stays zero. A parameter with a `spread` lies in
P/100 of that spread; where all parameters have one, P may be 100 and more. A study of scenarios draws from this range. A review
covers the whole range, and the values between it and the approximate parameter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.plant import Parameter


class Parametric(Protocol):
    """What has exact parameters: a plant, or a body outside."""

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """By name."""


def exact_ranges(plant: Parametric, mismatch: float) -> dict[str, tuple[float, float]]:
    """Return the least and the largest value of every exact parameter.

    Args:
        mismatch: percent.
    """
    check_mismatch(plant, mismatch)
    ranges = {name: _range(parameter, mismatch) for name, parameter in plant.parameters.items()}
    mistakes = Mistakes("mismatch")
    for name, parameter in plant.parameters.items():
        (low, high), (least, largest) = parameter.bounds, ranges[name]
        if least < low or largest > high:
            mistakes.add(
                f"parameter '{name}': {mismatch:g} % around {parameter.exact:g} reach from {least:g} to {largest:g} "
                f"{parameter.unit}, outside its bounds ({low:g}, {high:g}); at most {_most(parameter):.3g} % stay inside"
            )
    mistakes.raise_if_any()
    return ranges


def check_mismatch(plant: Parametric, mismatch: float) -> None:
    """Raise if no range belongs to this mismatch."""
    all_spread = bool(plant.parameters) and all(p.spread is not None or p.outside for p in plant.parameters.values())
    if not 0 <= mismatch < (math.inf if all_spread else 100):
        raise InvalidValue(
            f"mismatch {mismatch!r}: expected percent of at least 0 and below 100; a parameter keeps its sign"
            + ("" if not all_spread else " (100 is the whole spread, more is possible here)")
        )


def drawn(parameter: Parameter, mismatch: float, share: float) -> float:
    """Return the exact value at this share of the distribution, from 0 to 1.

    Without a spread the factor is log-uniform between 1 - P/100 and 1 + P/100.
    """
    if parameter.outside:
        return parameter.exact
    if parameter.spread is not None:
        return parameter.spread.quantile(parameter.exact, mismatch / 100, share)
    low, high = math.log1p(-mismatch / 100), math.log1p(mismatch / 100)
    return parameter.exact * (math.exp(low + (high - low) * share) if mismatch else 1.0)


def _range(parameter: Parameter, mismatch: float) -> tuple[float, float]:
    if parameter.outside:  # its values are those of the problem
        return parameter.exact, parameter.exact
    if parameter.spread is not None:
        return parameter.spread.interval(parameter.exact, mismatch / 100)
    width = mismatch / 100 * abs(parameter.exact)
    return parameter.exact - width, parameter.exact + width


def _most(parameter: Parameter) -> float:
    """The largest mismatch that stays inside the bounds, percent; ranges grow with it, so bisection finds it."""
    low, high = parameter.bounds
    inside, outside = 0.0, 100.0
    while low <= _range(parameter, outside)[0] and _range(parameter, outside)[1] <= high:
        inside, outside = outside, 2 * outside
    for _ in range(60):
        middle = (inside + outside) / 2
        least, largest = _range(parameter, middle)
        inside, outside = (middle, outside) if low <= least and largest <= high else (inside, middle)
    return inside
