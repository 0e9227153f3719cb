"""Whether and how fast the fixed-point iteration converges, from the plant's symbols or from a run.

The plant realises the request r as f(r): its response (exact parameters) to the command that the model (approximate
parameters) computes for r. With J = df/dr and the effective gain a of a deformation, an error of the request is
multiplied by I - a J in every cycle, so the iteration converges when |1 - a lambda| < 1 for every eigenvalue lambda of J.
"""

from fpirhc.contraction.basin import basin_of_plain_form, step_for_basin
from fpirhc.contraction.delayed import delayed_limit
from fpirhc.contraction.gains import linear_limit, optimal_gain, predicted_factor, sector_limit
from fpirhc.contraction.identified import identified_factor
from fpirhc.contraction.lag import (
    bearable_lag,
    damped_product,
    fastest_rate,
    lagged_limit,
    through_lag_damping,
    through_lag_limit,
)
from fpirhc.contraction.leaking import leaking_limit
from fpirhc.contraction.low_pass import least_product, slowest_iteration
from fpirhc.contraction.noise import (
    NoiseSpread,
    filter_pole,
    gain_within_chatter,
    noise_spread,
    request_variance,
    step_variance,
)
from fpirhc.contraction.pairing import pairing_margin
from fpirhc.contraction.report import ContractionReport, assess_gain, check_gain
from fpirhc.contraction.resonance import resonant_limit
from fpirhc.contraction.spectrum import (
    Spectrum,
    contraction_along,
    response_jacobian,
    response_jacobians,
    spectrum_over_box,
    spectrum_over_run,
)
from fpirhc.contraction.two_cycle import two_cycle_amplitudes, two_cycle_limit

__all__ = [
    "ContractionReport",
    "NoiseSpread",
    "Spectrum",
    "assess_gain",
    "basin_of_plain_form",
    "bearable_lag",
    "check_gain",
    "contraction_along",
    "damped_product",
    "delayed_limit",
    "fastest_rate",
    "filter_pole",
    "gain_within_chatter",
    "identified_factor",
    "lagged_limit",
    "leaking_limit",
    "least_product",
    "linear_limit",
    "noise_spread",
    "optimal_gain",
    "pairing_margin",
    "predicted_factor",
    "request_variance",
    "resonant_limit",
    "response_jacobian",
    "response_jacobians",
    "sector_limit",
    "slowest_iteration",
    "spectrum_over_box",
    "spectrum_over_run",
    "step_for_basin",
    "step_variance",
    "through_lag_damping",
    "through_lag_limit",
    "two_cycle_amplitudes",
    "two_cycle_limit",
]
