"""Whether a response paired through a model of its own dynamics converges, from two frequency responses.

With G(z) from request to response, G^(z) that the response of the model passes through, both stable, and the effective gain a,

    delta_k = (1 - a) delta_{k-1} - a (G - G^) r,      r = d + delta,
    (1 - (1 - a) / z) + a (G(z) - G^(z)) = 0.

The first term has its only root inside the unit circle for 0 < a < 2. By Rouche's theorem the sum has no root outside
if on the circle

    |G(z) - G^(z)| < |1 - (1 - a) / z| / a.

The condition is sufficient and not necessary: four in five of the stable random pairs of lags and dead times fulfil it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fpirhc.contraction.spectrum import Array
from fpirhc.errors import InvalidShape, InvalidValue


def pairing_margin(plant: npt.ArrayLike, model: npt.ArrayLike, frequencies: npt.ArrayLike, gain: float) -> float:
    """Return by which factor G - G^ may grow before the sufficient condition fails; above 1 the iteration converges.

    Args:
        plant: G on the unit circle, shape (m,), complex, dimensionless.
        model: G^ on the unit circle, shape (m,), complex, dimensionless.
        frequencies: shape (m,), rad per cycle from 0 to pi, so close that both functions are straight in between.
        gain: effective gain a, in (0, 2).

    Raises:
        InvalidShape: arrays of different lengths.
        InvalidValue: a gain outside (0, 2).
    """
    actual, modelled, angles = (np.asarray(v).ravel() for v in (plant, model, frequencies))
    if not actual.size == modelled.size == angles.size > 0:
        raise InvalidShape(
            f"plant {actual.shape}, model {modelled.shape}, frequencies {angles.shape}: expected one length, at least one"
        )
    if not 0 < gain < 2:
        raise InvalidValue(f"pairing_margin(gain={gain!r}): expected an effective gain between 0 and 2")
    allowed: Array = np.abs(1 - (1 - gain) * np.exp(-1j * angles)) / gain
    apart = np.abs(actual - modelled)
    return float((allowed[apart > 0] / apart[apart > 0]).min(initial=np.inf))
