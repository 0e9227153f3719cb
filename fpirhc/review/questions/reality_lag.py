"""Is the reality fast enough for the tracking law? N Lambda tau < 1 for a lag tau that the model lacks, N poles at -Lambda.

The lag is the sum of the time constants of the reality's real poles that it has beyond its settled self. See
`fpirhc.contraction.lag` for the rule and for the gain that keeps a damping.
"""

from __future__ import annotations

import numpy as np

from fpirhc.contraction.lag import damped_product
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.real_pair import extra_modes, real_points
from fpirhc.review.speed import law_of

TEXT = "Does the tracking law leave room for the lag of the reality?"
_DAMPING = 0.3
_REAL = 1e-6  # share of the imaginary part, below which a pole is real


def leaves_room(case: Case) -> Answer | None:
    """Return N Lambda tau, and the largest a lambda with some damping; None without a reality, an unpaired lag or a known law."""
    law = law_of(case.grid, case.controller) if case.grid.real is not None else None
    mirror = case.controller.deformation.mirror
    if law is None or (mirror is not None and mirror.lags):  # paired through it, which the loop with the reality judges
        return None
    rate, poles = law
    extras = [extra_modes(case.grid, point, case.believed) for point in real_points(case.grid)]
    lags = [float(np.sum(-1 / one.poles.real[_is_lag(one.poles)])) for one in extras]
    lag = max(lags, default=0.0)
    if lag == 0:
        return None
    period, unit = case.problem.period, case.problem.time_unit
    gain = abs(case.controller.deformation.effective_gain())
    product = gain * max(float(np.abs(one.eigenvalues).max()) for one in extras)
    room, most = poles * rate * lag, damped_product(period, lag, rate, poles, damping=_DAMPING)
    text = (
        f"a lag of {lag:.3g} {unit} that the model lacks; {poles} x {rate:g} {case.problem.rate_unit} x lag = {room:.3g}, "
        f"which must stay below 1 for a fast iteration; gain x eigenvalue is {product:.3g}"
    )
    numbers = {"lag": lag, "room": room, "product": product, "damped_product": most}
    if room >= 1:
        change = f"Use a rate below {1 / (poles * lag):.3g} {case.problem.rate_unit}, or pair through the lag: lag={lag:.2g}."
        return Answer(TEXT, Verdict.NO, text, change, numbers)
    text += f", and keeps the damping {_DAMPING:g} up to {most:.3g}"
    if product <= most:
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    change = f"Multiply the gain by {most / product:.2g}, or pair through the lag: lag={lag:.2g}."
    return Answer(TEXT, Verdict.UNKNOWN, text, change, numbers)


def _is_lag(poles: np.ndarray) -> np.ndarray:
    return (poles.real < 0) & (np.abs(poles.imag) <= _REAL * np.abs(poles))


QUESTION = ControllerQuestion(leaves_room, order=6)
