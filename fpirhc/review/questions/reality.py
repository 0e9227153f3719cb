"""Does the loop of the model's controller around the reality converge? Both are linear plants at points of the reference.

The reality has states that the model lacks, so the eigenvalues of the response Jacobian do not decide: the poles of the whole loop
do, with the integrator, the estimator and the dead times in it.
"""

from __future__ import annotations

import numpy as np

from fpirhc.contraction.delayed import damped_product, resonant_limit
from fpirhc.controllers.contract import without_deformation
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.questions.speed import law_of
from fpirhc.review.true_plant_loop import Extra, extra_modes, real_loops, real_points
from fpirhc.simulation.linearise.linear_loop import NEUTRAL

LOOP = "Does the loop with the reality converge?"


def real_pair_converges(case: Case) -> Answer | None:
    """Return the largest pole of the real pair along the reference; None without a reality that is a plant."""
    if case.grid.real is None:
        return None
    try:
        adapted = max(one.radius for one in real_loops(case.grid, case.controller))
        bare = max(one.radius for one in real_loops(case.grid, without_deformation(case.controller)))
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(LOOP, Verdict.UNKNOWN, f"no linear loop of the real pair: {error}")
    text = f"the slowest or fastest growing mode is multiplied by {adapted:.6g} per cycle, without adaptation by {bare:.6g}"
    numbers = {"radius": adapted, "bare_radius": bare}
    if adapted < 1:
        return Answer(LOOP, Verdict.YES, text, "", numbers)
    whole = case.controller.deformation.mirror.lags
    lag = "the whole lag of the reality." if whole else "the reality's lag: ModelReferenced(map, lag=...)."
    change = f"Lower the gain, or pair through {lag}"
    if bare >= 1:
        change = "Lower the rate of the tracking law: the loop does not converge without adaptation either."
    return Answer(LOOP, Verdict.UNKNOWN if adapted < 1 + NEUTRAL else Verdict.NO, text, change, numbers)


def plain_pair_converges(case: Case) -> Answer | None:
    """Return the largest pole of the real pair; None for adaptive controllers, and where there is no such loop to judge."""
    if case.grid.real is None or case.controller.deformation.adapts:
        return None
    try:
        radius = max(one.radius for one in real_loops(case.grid, case.controller))
    except (FpirhcError, np.linalg.LinAlgError):
        return None
    text, numbers = f"the slowest or fastest growing mode is multiplied by {radius:.6g} per cycle", {"radius": radius}
    if radius < 1:
        return Answer(LOOP, Verdict.YES, text, "", numbers)
    change = "Lower the rate of the tracking law, or the weights of the plan."
    return Answer(LOOP, Verdict.UNKNOWN if radius < 1 + NEUTRAL else Verdict.NO, text, change, numbers)


LAG = "Does the tracking law leave room for the lag of the reality?"
_DAMPING = 0.3
_REAL = 1e-6  # share of the imaginary part, below which a pole is real


def _extras(case: Case) -> list[Extra]:
    """At points along the reference."""
    iteration = case.controller.deformation.iteration
    return [extra_modes(case.grid, point, case.believed, iteration) for point in real_points(case.grid)]


def leaves_room(case: Case) -> Answer | None:
    """Return N Lambda tau, and the largest a lambda with some damping; None without a reality, an unpaired lag or a known law."""
    law = law_of(case.grid, case.controller) if case.grid.real is not None else None
    if law is None or case.controller.deformation.mirror.lags:
        return None  # paired through it, which the loop with the reality judges
    rate, poles = law
    extras = _extras(case)
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
        return Answer(LAG, Verdict.NO, text, change, numbers)
    text += f", and keeps the damping {_DAMPING:g} up to {most:.3g}"
    if product <= most:
        return Answer(LAG, Verdict.YES, text, "", numbers)
    change = f"Multiply the gain by {most / product:.2g}, or pair through the lag: lag={lag:.2g}."
    return Answer(LAG, Verdict.UNKNOWN, text, change, numbers)


def _is_lag(poles: np.ndarray) -> np.ndarray:
    return (poles.real < 0) & (np.abs(poles.imag) <= _REAL * np.abs(poles))


RESONANCE = "Is the gain small enough for the resonance of the reality?"
_COMPLEX = 1e-6  # share of the imaginary part, above which a pole swings


def stays_below(case: Case) -> Answer | None:
    """Return the gain and its limit; None without a reality, a resonance or a law with known poles."""
    law = law_of(case.grid, case.controller) if case.grid.real is not None else None
    gain = abs(case.controller.deformation.effective_gain())
    if law is None or gain == 0:
        return None
    rate, poles = law
    extras = _extras(case)
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
        return Answer(RESONANCE, Verdict.YES, text, "", numbers)
    if limit <= 0:
        rates = f"below {2 * damping * frequency / poles:.3g} {case.problem.rate_unit}"
        return Answer(
            RESONANCE, Verdict.NO, f"{text}: the tracking law alone excites it", f"Use a rate {rates}.", numbers
        )
    return Answer(RESONANCE, Verdict.NO, text, f"Multiply the gain by {limit / gain:.2g} or less.", numbers)


def _swinging(extra: Extra) -> list[complex]:
    return [complex(p) for p in extra.poles if p.imag > _COMPLEX * abs(p) and p.real <= 0]


def _limit(period: float, rate: float, poles: int, extra: Extra, pole: complex) -> float:
    eigenvalue = float(np.abs(extra.eigenvalues).max())
    return resonant_limit(
        period, rate, poles, frequency=abs(pole), damping=-pole.real / abs(pole), eigenvalue=eigenvalue
    )


QUESTIONS = (
    ControllerQuestion(real_pair_converges, LOOP, order=7, doubts=True, of_targets=True),
    ControllerQuestion(plain_pair_converges, LOOP, order=33, adaptive=False),
    ControllerQuestion(leaves_room, LAG, order=34),
    ControllerQuestion(stays_below, RESONANCE, order=35),
)
