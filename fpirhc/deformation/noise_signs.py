"""The mean sign of the product of successive response errors under white measurement noise.

On f = lambda r the iteration r+ = r - a (h + n) with white noise n of m independent components gives errors whose correlation from
one cycle to the next is rho = -a lambda / 2. The angle between two such vectors is distributed as if they were drawn on a sphere,

    E sgn(h_k' h_{k-1}) = 2 I_{(1+rho)/2}(m/2, m/2) - 1 = int_0^rho (1 - x^2)^(m/2-1) dx / int_0^1 (1 - x^2)^(m/2-1) dx,

where I is the regularised incomplete beta function: (2/pi) asin(rho) for one component, rho itself for two.
"""

from __future__ import annotations

import math

from fpirhc.errors import InvalidValue


def expected_sign(product: float, components: int) -> float:
    """Return the mean of sgn(h_k' h_{k-1}) in white noise.

    Args:
        product: g = a lambda, effective gain times eigenvalue, 0 to 2.
        components: m of the response.

    Raises:
        InvalidValue: a product outside [0, 2], fewer than one component.
    """
    if not (0 <= product <= 2 and components >= 1):
        raise InvalidValue(
            f"expected_sign(product={product!r}, components={components!r}): expected a product from 0 to 2, at least one component"
        )
    correlation = -0.5 * product
    # Integration by parts: the mean for m + 2 components is the mean for m plus one term.
    size = 1 if components % 2 else 2
    mean = 2 / math.pi * math.asin(correlation) if size == 1 else correlation
    whole = math.pi / 2 if size == 1 else 1.0  # int_0^1 (1 - x^2)^(m/2-1) dx
    while size < components:
        mean += correlation * (1 - correlation**2) ** (size / 2) / (size * whole)
        whole *= size / (size + 1)
        size += 2
    return mean
