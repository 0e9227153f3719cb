"""How large a response error the plain form survives behind a saturating map, and the step that a wanted one needs.

A map with the largest step s answers an error h with the gain s / |h| at most, which falls below the slowest iteration that the
tracking law bears (`least_product`) at

    |h| = s lambda / g_low,      g_low = a lambda at the edge of the plain form.

Beyond it the loop behaves as one whose gain is too small: the error grows. This is the first harmonic's balance and no
proof; simulated thresholds are at 0.85 to 0.98 of it for three and more poles and at 0.72 for two, so a wanted basin needs
a spare factor on the step, 1.25 and 1.5. For the sigmoid with D = 0.3 (s = 0.8088 S) and three poles this is
S >= 1.55 g_low h_max / lambda.
"""

from __future__ import annotations

import math

from fpirhc.contraction.low_pass import least_product
from fpirhc.errors import InvalidValue

_SPARE, _SPARE_OF_TWO_POLES = 1.25, 1.5


def basin_of_plain_form(
    largest_step: float, poles: int, rate: float, period: float, *, eigenvalue: float = 1.0
) -> float:
    """Return the largest |f - d| from which the plain form comes back; infinite for one pole or an unbounded step.

    Parameters: `largest_step` of the map per cycle, in units of the response; `poles`, `rate`, `period` of the
    tracking law as in `least_product`; `eigenvalue` lambda of the response Jacobian.

    Raises:
        InvalidValue: a step or an eigenvalue that is not positive, and what `least_product` raises.
    """
    if not (largest_step > 0 and 0 < eigenvalue < math.inf):
        raise InvalidValue(
            f"basin_of_plain_form(largest_step={largest_step!r}, eigenvalue={eigenvalue!r}): expected positive numbers"
        )
    slowest = least_product(poles, rate, period)
    return largest_step * eigenvalue / slowest if slowest else math.inf


def step_for_basin(largest_error: float, poles: int, rate: float, period: float, *, eigenvalue: float = 1.0) -> float:
    """Return the step per cycle that a map needs to come back from an error of that size, with its spare factor.

    Parameters: `largest_error` |f - d|, in units of the response; the rest as in `basin_of_plain_form`.

    Raises:
        InvalidValue: a negative error, an eigenvalue that is not positive, and what `least_product` raises.
    """
    if not (largest_error >= 0 and 0 < eigenvalue < math.inf):
        raise InvalidValue(
            f"step_for_basin(largest_error={largest_error!r}, eigenvalue={eigenvalue!r}): expected an error of at least 0 and a "
            "positive eigenvalue"
        )
    spare = _SPARE_OF_TWO_POLES if poles == 2 else _SPARE
    return spare * least_product(poles, rate, period) * largest_error / eigenvalue
