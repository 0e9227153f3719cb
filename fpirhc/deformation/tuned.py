"""Tunes the gain of a map on line, by stochastic approximation on the signs of successive response errors.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca

from fpirhc.deformation.base import Deformation, Form, Wrapper, memory_of_map
from fpirhc.errors import InvalidValue
from fpirhc.symbolic.expression import power
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

_RATE = 0.02  # gamma
_GROWING, _RETURNING = 5, 8  # in a row
_FAST, _SLOW = 1.5, 1 / 3  # an error that grew by less than the one counts the other
_TARGET = 0.5  # g*, the product of effective gain and the plant's gain that the rule aims at in noise
_RECOVERY = 1.0  # target below the map's own gain: the product of a deadbeat iteration
_RETURNED = 0.3  # relative distance below which an error counts as equal to the error of two cycles before
_SMALLEST = 1e-3  # smallest factor that oscillation may lead to


@dataclass(frozen=True)
class Tuned(Wrapper):
    """The wrapped map with its step scaled on line.

    Args:
        map: any deformation that iterates; the tuner begins at its gain, and noise does not lower the gain below it.
        largest_gain: cap of the effective gain, the bound that the model guarantees (see `assess_gain`: `sector_limit`).

    Raises:
        InvalidValue: a cap that is not positive in the direction of the map's own gain, or below it.
    """

    largest_gain: float

    def __post_init__(self) -> None:
        gain = self.map.effective_gain()
        if gain == 0 or not math.isfinite(self.largest_gain) or self.largest_gain / gain < 1:
            raise InvalidValue(
                f"Tuned(largest_gain={self.largest_gain!r}): expected a bound beyond the map's own effective gain {gain:.4g}; "
                "assess_gain(...).sector_limit gives one. Without a bound a tuner raises the gain until the loop oscillates"
            )

    @property
    def form(self) -> Form:
        return replace(self.map.form, steady=False)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        counts = scalar("tuner_growing"), scalar("tuner_returning")
        errors = Signal("tuner_error", elements), Signal("tuner_earlier", elements)
        own = (scalar("tuner_factor", start=1.0), *counts, *errors)
        return Layout(own) + self.map.memory(elements)

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return r + c (G(r, f, d) - r)."""
        inner = memory_of_map(self, memory, request.numel())
        next_request, of_inner = self.map.step(request, response, desired, inner)
        factor, error, before = memory["tuner_factor"], response - desired, memory["tuner_error"]
        fast = ca.if_else(factor < 1, 1, _FAST)
        growing = _growing_in_a_row(memory["tuner_growing"], error, before, _SLOW, fast)
        returning = _returning_in_a_row(memory["tuner_returning"], error, before, memory["tuner_earlier"])
        oscillates = ca.logic_or(growing > _GROWING - _SLOW / 2, returning > _RETURNING - 0.5)
        own = {
            "tuner_factor": ca.if_else(
                oscillates, ca.fmax(0.5 * factor, _SMALLEST), self._tuned(factor, error, before)
            ),
            "tuner_growing": ca.if_else(oscillates, 0, growing),
            "tuner_returning": ca.if_else(oscillates, 0, returning),
            "tuner_error": error,
            "tuner_earlier": before,
        }
        return request + factor * (next_request - request), {**own, **of_inner}

    def _tuned(self, factor: Expression, error: Expression, before: Expression) -> Expression:
        """The factor after one step towards the target."""
        signs = [_mean_sign(target, error.numel()) for target in (_TARGET, _RECOVERY)]
        product, target_sign = ca.dot(error, before), ca.if_else(factor < 1, signs[1], signs[0])
        # Without a sign (a zero error, or one that is not a number) the factor stays.
        rise = ca.if_else(product > 0, 1 - target_sign, ca.if_else(product < 0, -1 - target_sign, 0))
        floor = ca.if_else(factor < 1, _SMALLEST, 1)
        largest = self.largest_gain / self.map.effective_gain()
        return ca.fmin(ca.fmax(factor * ca.exp(_RATE * rise), floor), largest)

    def with_effective_gain(self, gain: float) -> Self:
        return replace(
            self,
            map=self.map.with_effective_gain(gain),
            largest_gain=self.largest_gain * gain / self.map.effective_gain(),
        )


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Tuned(inner, largest_gain=1.2 * inner.effective_gain()),)


def _growing_in_a_row(
    count: Expression, error: Expression, before: Expression, slow: float, fast: Expression
) -> Expression:
    """How many errors in a row alternated in sign and grew, each by the factor `fast`: one that grew less counts `slow`."""
    size, earlier = ca.sumsqr(error), ca.sumsqr(before)
    weight = ca.if_else(size > fast**2 * earlier, 1, slow)
    return ca.if_else(ca.logic_and(ca.dot(error, before) < 0, size > earlier), count + weight, 0)


def _returning_in_a_row(count: Expression, error: Expression, before: Expression, earlier: Expression) -> Expression:
    """How many errors in a row alternated in sign and were equal to the error of two cycles before: a two-cycle.

    Saturated two-cycles neither grow nor die out. Errors of white noise are not equal in this way eight times in a row.
    """
    back = ca.sumsqr(error - earlier) < _RETURNED**2 * ca.sumsqr(error)
    return ca.if_else(ca.logic_and(ca.dot(error, before) < 0, back), count + 1, 0)


def _mean_sign(product: float, components: int) -> float:
    """The mean of sgn(h_k' h_{k-1}) in white noise, see docs/theory.md; the product may be open."""
    correlation = -0.5 * product
    # Integration by parts: the mean for m + 2 components is the mean for m plus one term.
    size = 1 if components % 2 else 2
    mean = 2 / math.pi * ca.asin(correlation) if size == 1 else correlation
    whole = math.pi / 2 if size == 1 else 1.0  # int_0^1 (1 - x^2)^(m/2-1) dx
    while size < components:
        spread = power(1 - correlation * correlation, size // 2)
        mean += correlation * (spread * ca.sqrt(1 - correlation * correlation) if size % 2 else spread) / (size * whole)
        whole *= size / (size + 1)
        size += 2
    return mean
