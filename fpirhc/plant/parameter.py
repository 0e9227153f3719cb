"""Parameters of a plant, each with an approximate and an exact value, and how far the exact one may lie from that of the file.

One percentage for all parameters is meaningless where they are of different kinds: 20 % of an activation energy changes a rate of
reaction by a factor of hundreds. A spread says for its parameter what a mismatch of 100 % means. Every distribution has a finite
range, so that a review covers what a study draws.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import Annotated

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import Checked, checked_call
from fpirhc.fields.kinds import JudgedByOwner, Positive, Range, finite_number
from fpirhc.symbolic.dotted import copied


@dataclass(frozen=True)
class Parameter(Checked):
    """One parameter of a plant.

    Args:
        approximate: value in the controller's model.
        exact: value in the simulated plant.
        unit: of both values.
        bounds: least and largest physically possible value, in the same unit.
        spread: distribution of the exact value in studies, and its range in reviews; None: a percentage of the exact value. A run
            does not depend on it.
        outside: whether it is a signal from outside, whose values over time are those of the problem; see `outside`.
    """

    approximate: JudgedByOwner
    exact: JudgedByOwner
    unit: str
    bounds: tuple[float, float] = (-math.inf, math.inf)
    spread: Spread | None = None
    outside: bool = field(default=False, kw_only=True)


@checked_call
def outside(nominal: float, unit: str) -> Parameter:
    """Return a signal from outside, which is declared among the parameters of a plant.

    The response reads it as any other: `p.ambient` where `parameters={"ambient": outside(nominal=293.0, unit="K")}`.
    `Problem(signals=...)` says how it changes over time.

    Args:
        nominal: value at which the plant is reviewed, and which the model has where it is told nothing.
        unit: of the signal.
    """
    return Parameter(nominal, nominal, unit, outside=True)


def check_parameters(parameters: Mapping[str, Parameter], mistakes: Mistakes) -> None:
    """Add every mistake of the parameters to `mistakes`."""
    for name, one in parameters.items():
        values = {which: getattr(one, which) for which in ("approximate", "exact")}
        odd = [
            f"{which} is {value!r}, expected a finite number; look at what computes it (a division by zero, a missing value), or "
            "write the number"
            for which, value in values.items()
            if not finite_number(value)
        ]
        mistakes.join(f"parameter '{name}': {why}" for why in odd or _range_mistakes(one))
        if not one.unit:
            mistakes.add(f"parameter '{name}' has no unit; write unit='kg' (or '1' for none)")


def _range_mistakes(parameter: Parameter) -> Iterator[str]:
    (low, high), spread = parameter.bounds, parameter.spread
    if not low < high:
        yield f"bounds must be (lowest, highest), got {parameter.bounds!r}"
    elif outside := [w for w in ("approximate", "exact") if not low <= getattr(parameter, w) <= high]:
        yield f"{outside[0]} is outside its bounds {parameter.bounds!r}"
    elif spread is not None and (mistake := spread.mistake(float(parameter.exact))):
        yield f"spread: it {mistake}"


def with_exact_values(parameters: Mapping[str, Parameter], exact: Iterable[float]) -> dict[str, Parameter]:
    """Return the parameters with other exact values, in their order."""
    # A spread is around the value of the problem file, and not around another plant's.
    others = {
        name: copied(one, {"exact": float(value), "spread": None})
        for (name, one), value in zip(parameters.items(), exact, strict=True)
    }
    mistakes = Mistakes("plant")
    check_parameters(others, mistakes)
    mistakes.raise_if_any()
    return others


def exact_ranges(parameters: Mapping[str, Parameter], mismatch: float) -> dict[str, tuple[float, float]]:
    """Return the least and the largest value of every exact parameter, |p - p_exact| <= P/100 |p_exact| for P percent, P < 100."""
    all_spread = bool(parameters) and all(p.spread is not None or p.outside for p in parameters.values())
    if not 0 <= mismatch < (math.inf if all_spread else 100):
        signs = "and less than 100 %, where no parameter changes its sign; a wider range needs a `spread` of every Parameter"
        raise InvalidValue(
            f"mismatch {mismatch:g} %: use at least 0 %{'; 100 % is the whole spread' if all_spread else f' {signs}'}"
        )
    ranges = {name: _range(parameter, mismatch) for name, parameter in parameters.items()}
    mistakes = Mistakes("mismatch")
    for name, parameter in parameters.items():
        (low, high), (least, largest) = parameter.bounds, ranges[name]
        if least < low or largest > high:
            wider = (_range(parameter, percent) for percent in range(math.ceil(mismatch)))
            most = sum(low <= one and other <= high for one, other in wider) - 1  # ranges grow with it
            mistakes.add(
                f"parameter '{name}': {mismatch:g} % around {parameter.exact:g} reach from {least:g} to {largest:g} "
                f"{parameter.unit}, outside its bounds ({low:g}, {high:g}); at most {most} % stay inside"
            )
    mistakes.raise_if_any()
    return ranges


def drawn(parameter: Parameter, mismatch: float, share: float) -> float:
    """Return the exact value at this share of the distribution, from 0 to 1."""
    if parameter.outside:
        return parameter.exact
    if parameter.spread is not None:
        return parameter.spread.quantile(parameter.exact, mismatch / 100, share)
    low, high = math.log1p(-mismatch / 100), math.log1p(mismatch / 100)
    return parameter.exact * (math.exp(low + (high - low) * share) if mismatch else 1.0)


def _range(parameter: Parameter, mismatch: float) -> tuple[float, float]:
    if parameter.outside:  # its values are those of the problem
        return parameter.exact, parameter.exact
    if parameter.spread is not None:
        return parameter.spread.interval(parameter.exact, mismatch / 100)
    width = mismatch / 100 * abs(parameter.exact)
    return parameter.exact - width, parameter.exact + width


TAILS = 2.0  # standard deviations at which normal distributions are cut off; 95 % of the uncut one lie inside
_NORMAL = NormalDist()
_LEAST = _NORMAL.cdf(-TAILS)


class Spread(Checked, ABC):
    """Contract: the distribution of an exact parameter around its value, for a share of the full spread."""

    @abstractmethod
    def quantile(self, exact: float, share: float, probability: float) -> float:
        """Return the value below which the parameter lies with this probability; finite at 0 and 1, increasing, exact at share 0.

        Args:
            exact: value in the problem file.
            share: of the spread, 1 for all of it.
            probability: from 0 to 1.
        """

    def interval(self, exact: float, share: float) -> tuple[float, float]:
        """Return the least and the largest value."""
        return self.quantile(exact, share, 0.0), self.quantile(exact, share, 1.0)

    def mistake(self, exact: float) -> str:  # noqa: ARG002
        """Return why the spread cannot belong to a parameter with this exact value; empty where it can."""
        return ""


@dataclass(frozen=True)
class Uniform(Spread):
    """Uniform in exact -+ `absolute`, in the parameter's unit."""

    absolute: Positive

    def quantile(self, exact: float, share: float, probability: float) -> float:
        return exact + share * self.absolute * (2 * probability - 1)


@dataclass(frozen=True)
class Normal(Spread):
    """Normal around exact with the deviation `absolute`, in the parameter's unit, cut off at two of them."""

    absolute: Positive

    def quantile(self, exact: float, share: float, probability: float) -> float:
        return exact + share * self.absolute * _standard(probability)


_FACTOR = Range("a number above 1, such as 1.3 for 30 %", lambda v: 1 < v < math.inf)


@dataclass(frozen=True)
class LogNormal(Spread):
    """Log-normal around exact as its median, cut off at two standard deviations: the parameter keeps its sign.

    Args:
        factor: by which the parameter is larger or smaller at one standard deviation, above 1.
    """

    factor: Annotated[float, _FACTOR]

    def quantile(self, exact: float, share: float, probability: float) -> float:
        """Return exact factor^(share z), z the quantile of the cut standard normal, turned round for a negative exact value."""
        z = _standard(probability if exact > 0 else 1 - probability)
        return float(exact * self.factor ** (share * z))

    def mistake(self, exact: float) -> str:
        zero = "has the value 0, which a factor does not change; use Uniform or Normal with absolute=..."
        return "" if exact else zero


def _standard(probability: float) -> float:
    """Quantile of the standard normal cut off at -+TAILS; the ends are exact."""
    if probability in (0.0, 1.0):
        return TAILS * (2 * probability - 1)
    return _NORMAL.inv_cdf(_LEAST + (1 - 2 * _LEAST) * probability)
