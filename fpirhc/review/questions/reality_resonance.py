"""Is the gain small enough for a resonance of the reality? It is for lambda (N Lambda + a / T) < 2 zeta w0.

See `fpirhc.contraction.lag` for the rule.
"""

from __future__ import annotations

import numpy as np

from fpirhc.contraction.lag import resonant_limit
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.real_pair import Extra, extra_modes, real_points
from fpirhc.review.speed import law_of

TEXT = "Is the gain small enough for the resonance of the reality?"
_COMPLEX = 1e-6  # share of the imaginary part, above which a pole swings


def stays_below(case: Case) -> Answer | None:
    """Return the gain and its limit; None without a reality, a resonance or a law with known poles."""
    law = law_of(case.grid, case.controller) if case.grid.real is not None else None
    gain = abs(case.controller.deformation.effective_gain())
    if law is None or gain == 0:
        return None
    rate, poles = law
    extras = [extra_modes(case.grid, point, case.believed) for point in real_points(case.grid)]
    limits = [(_limit(case.problem.period, rate, poles, one, pole), pole) for one in extras for pole in _swinging(one)]
    if not limits:
        return None
    limit, pole = min(limits, key=lambda pair: pair[0])
    frequency, damping = abs(pole), -pole.real / abs(pole)
    text = (
        f"a resonance at {frequency:.4g} rad/{case.problem.time_unit} with damping {damping:.3g} unknown to the model bears "
        f"an effective gain of {max(limit, 0.0):.3g}; it is {gain:.3g}"
    )
    numbers = {"frequency": frequency, "damping": damping, "limit": limit, "gain": gain}
    if gain <= limit:
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    if limit <= 0:
        rates = f"below {2 * damping * frequency / poles:.3g} {case.problem.rate_unit}"
        return Answer(TEXT, Verdict.NO, f"{text}: the tracking law alone excites it", f"Use a rate {rates}.", numbers)
    return Answer(TEXT, Verdict.NO, text, f"Multiply the gain by {limit / gain:.2g} or less.", numbers)


def _swinging(extra: Extra) -> list[complex]:
    return [complex(p) for p in extra.poles if p.imag > _COMPLEX * abs(p) and p.real <= 0]


def _limit(period: float, rate: float, poles: int, extra: Extra, pole: complex) -> float:
    eigenvalue = float(np.abs(extra.eigenvalues).max())
    return resonant_limit(
        period, rate, poles, frequency=abs(pole), damping=-pole.real / abs(pole), eigenvalue=eigenvalue
    )


QUESTION = ControllerQuestion(stays_below, order=7)
