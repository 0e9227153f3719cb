"""Whether and how fast the fixed-point iteration converges, from the plant's symbols or from a run.

The request r is realised as f(r): the plant's response (exact parameters) to the command that the model (approximate
parameters) computes for r. With J = df/dr and the effective gain a of a deformation, an error of the request is
multiplied by I - a J in every cycle, so the iteration converges when |1 - a lambda| < 1 for every eigenvalue of J.
"""

from fpirhc.contraction.delayed import delayed_limit
from fpirhc.contraction.gains import linear_limit, optimal_gain, predicted_factor, sector_limit
from fpirhc.contraction.identified import identified_factor
from fpirhc.contraction.report import ContractionReport, assess_gain, check_gain
from fpirhc.contraction.spectrum import (
    Spectrum,
    contraction_along,
    response_jacobian,
    spectrum_over_box,
    spectrum_over_run,
)

__all__ = [
    "ContractionReport",
    "Spectrum",
    "assess_gain",
    "check_gain",
    "contraction_along",
    "delayed_limit",
    "identified_factor",
    "linear_limit",
    "optimal_gain",
    "predicted_factor",
    "response_jacobian",
    "sector_limit",
    "spectrum_over_box",
    "spectrum_over_run",
]
