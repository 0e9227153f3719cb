"""The mismatch of P percent, as an option or an argument: the range of every exact parameter.

    |p - p_exact| <= P/100 |p_exact|,        0 <= P < 100,        p_exact the exact value in the problem file.

So a parameter keeps its sign, and a parameter that is zero stays zero. A study of scenarios draws from this range. A review covers
the whole range, and the values between it and the approximate parameter.
"""

from __future__ import annotations

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.plant import Parameter, Plant


def exact_ranges(plant: Plant, mismatch: float) -> dict[str, tuple[float, float]]:
    """Return the least and the largest value of every exact parameter.

    Args:
        plant: the plant with its parameters.
        mismatch: percent.

    Raises:
        InvalidValue: `mismatch` outside [0, 100).
        InvalidProblem: a range leaves a parameter's physical bounds; the message names the largest mismatch inside them.
    """
    if not 0 <= mismatch < 100:
        raise InvalidValue(
            f"mismatch {mismatch!r}: expected percent of at least 0 and below 100; a parameter keeps its sign"
        )
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


def _range(parameter: Parameter, mismatch: float) -> tuple[float, float]:
    width = mismatch / 100 * abs(parameter.exact)
    return parameter.exact - width, parameter.exact + width


def _most(parameter: Parameter) -> float:
    """The largest mismatch that stays inside the bounds, percent."""
    low, high = parameter.bounds
    return 100 * min(abs(parameter.exact - low), abs(high - parameter.exact)) / abs(parameter.exact)
