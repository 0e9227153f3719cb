"""How large a response error the plain form survives behind a saturating map, and the step that a given error needs.

A map with the largest step s has the gain s / |h| at most for an error h. This gain falls below the slowest iteration with which
the tracking law is stable (`least_product`) at

    |h| = s lambda / g_low,      g_low = a lambda at the edge of the plain form.

Beyond this error the loop behaves as one whose gain is too small: the error grows. This is a balance of the first harmonic, not a
proof. Simulated thresholds are at 0.85 to 0.98 of it for three and more poles and at 0.72 for two. A required basin therefore needs
a spare factor on the step: 1.25, and 1.5 for two poles. For the sigmoid with D = 0.3 (s = 0.8088 S) and three poles this is
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

    Args:
        largest_step: of the map per cycle, in units of the response.
        poles: N of the tracking law, as in `slowest_iteration`.
        rate: Lambda of the tracking law, 1/s.
        period: T of the control cycle, s.
        eigenvalue: lambda of the response Jacobian.

    Raises:
        InvalidValue: a step, rate, period or eigenvalue that is not positive, or fewer than one pole.
    """
    if not (largest_step > 0 and 0 < eigenvalue < math.inf):
        raise InvalidValue(
            f"basin_of_plain_form(largest_step={largest_step!r}, eigenvalue={eigenvalue!r}): expected positive numbers"
        )
    slowest = least_product(poles, rate, period)
    return largest_step * eigenvalue / slowest if slowest else math.inf


def step_for_basin(largest_error: float, poles: int, rate: float, period: float, *, eigenvalue: float = 1.0) -> float:
    """Return the step per cycle that a map needs to come back from an error of that size, with its spare factor.

    Args:
        largest_error: |f - d|, in units of the response.
        poles: N of the tracking law, as in `slowest_iteration`.
        rate: Lambda of the tracking law, 1/s.
        period: T of the control cycle, s.
        eigenvalue: lambda of the response Jacobian.

    Raises:
        InvalidValue: a negative error, a rate, period or eigenvalue that is not positive, or fewer than one pole.
    """
    if not (largest_error >= 0 and 0 < eigenvalue < math.inf):
        raise InvalidValue(
            f"step_for_basin(largest_error={largest_error!r}, eigenvalue={eigenvalue!r}): expected an error of at least 0 and a "
            "positive eigenvalue"
        )
    spare = _SPARE_OF_TWO_POLES if poles == 2 else _SPARE
    return spare * least_product(poles, rate, period) * largest_error / eigenvalue
