"""Outcomes of a comparison, findings, and changes of errors: which coordinates count, and what their changes amount to.

An error counts relative to a scale of its coordinate: the range of the reference, the start included; for a set-point held from the
start 1 / sqrt(w) with the cost's weight w, else the width of the limits, else 1. What a plan's cost does not weigh is not judged,
nor what stays below 1 % of the largest relative error, or below 1e-9, which is rounding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from fpirhc.fields.checked import FoundByName
from fpirhc.plant.motion import followed_units
from fpirhc.summary import numbers_written_out, written_out
from fpirhc.task.problem import Problem


class Outcome(StrEnum):
    """The effect of adaptation on one pair of controllers; words and colours of every output follow from it."""

    BETTER = "better"
    WORSE = "worse"
    MIXED = "mixed"
    DOUBTFUL = "doubtful"  # a smaller error, and a reason why it is no success
    NO_DIFFERENCE = "no difference"
    NOT_COMPARABLE = "not comparable"


@dataclass(frozen=True)
class Finding(FoundByName):
    """One sentence of a verdict."""

    text: str  # the sentence
    outcome: Outcome | None = None  # of the pair that it is about; None for a remark
    pair: tuple[str, str] | None = (
        None  # names of the controllers without and with adaptation, where it is about a pair
    )
    # rms error with adaptation over that without, by judged coordinate, largest first; NaN where both are zero
    ratios: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", numbers_written_out(self.text))
        super().__post_init__()


HELPS = 0.9  # an rms error below this share of the pair's counts as lower
HURTS = 1.1
MINOR = 0.01  # of the largest relative error
ROUNDING = 1e-9  # relative errors
_AT_START = 1e-12  # of the start: rounding of an output there, such as cos(pi / 2) for 0
_SAMPLES = 2000
_MANY = 1e6
_QUARTER_TURN = {"rad": math.pi / 2, "deg": 90.0}


@dataclass(frozen=True)
class Change:
    """The errors of one coordinate, in its unit.

    Args:
        name: of the coordinate.
        before: rms error without adaptation.
        after: rms error with adaptation.
        scale: that the errors are judged by.
    """

    name: str
    before: float
    after: float
    scale: float = 1.0

    @property
    def ratio(self) -> float:
        """After over before; infinite from zero to something, NaN where both are zero."""
        if self.before > 0:
            return self.after / self.before
        return math.inf if self.after > 0 else math.nan

    @property
    def size(self) -> float:
        """The larger of both errors over the scale."""
        return max(self.before, self.after) / self.scale

    @property
    def vanishes(self) -> bool:
        """Whether what is left of an error is rounding, in a floating-point number of the size of the scale."""
        return self.after < ROUNDING * self.scale <= self.before

    @property
    def outcome(self) -> Outcome:
        """Better below 0.9, worse above 1.1."""
        if not self.size >= ROUNDING:
            return Outcome.NO_DIFFERENCE
        return Outcome.BETTER if self.ratio < HELPS else Outcome.WORSE if self.ratio > HURTS else Outcome.NO_DIFFERENCE


def times(factor: float) -> str:
    """Return a factor in three digits and without a power of ten: 245 000 times; beyond a million its digits say nothing."""
    return f"{written_out(factor, 3)} times" if factor < _MANY else "more than a million times"


def outcome_of(changes: Mapping[str, Change]) -> Outcome:
    """Mixed where one coordinate is better and another worse; else what any of them is."""
    outcomes = {c.outcome for c in changes.values()}
    if {Outcome.BETTER, Outcome.WORSE} <= outcomes:
        return Outcome.MIXED
    return next((one for one in (Outcome.BETTER, Outcome.WORSE) if one in outcomes), Outcome.NO_DIFFERENCE)


def major(changes: Mapping[str, Change]) -> dict[str, Change]:
    """The changes that count beside the others, worst ratio first."""
    before, after = (max(getattr(c, w) / c.scale for c in changes.values()) for w in ("before", "after"))
    least = MINOR * min(before, after)
    counted = [c for c in changes.values() if c.size >= least]
    return {c.name: c for c in sorted(counted, key=lambda c: -c.ratio if c.ratio == c.ratio else 0.0)}


def scales(problem: Problem) -> dict[str, float]:
    """Return the scale of every judged coordinate."""
    moving = ranges(problem)
    return {name: moving.get(name) or _tolerance(problem, name) for name in problem.judged_names}


def ranges(problem: Problem, *, start: bool = True) -> dict[str, float]:
    """Return the range of every reference that moves, the start included or not."""
    plant = problem.plant
    function = problem.reference.function(plant)
    times = np.linspace(0.0, problem.duration, _SAMPLES)
    states = np.asarray(function.map(_SAMPLES)(times[None, :])[0].full())
    wanted = np.column_stack([problem.start_output, states]) if start else states
    moving = {}
    started = _AT_START * float(np.abs(problem.start_state).max(initial=0.0))
    for name in problem.judged_names:
        row = wanted[plant.output.elements.index(name)]
        if np.ptp(row) > max(started, ROUNDING * np.abs(row).max()):
            moving[name] = float(np.ptp(row))
    return moving


def quarter_turns(problem: Problem) -> dict[str, float]:
    """Return a quarter turn for every judged angle whose reference does not move; beyond it gravity and projections turn round."""
    moving, units = ranges(problem), followed_units(problem.plant)
    return {n: _QUARTER_TURN[units[n]] for n in problem.judged_names if n not in moving and units[n] in _QUARTER_TURN}


def _tolerance(problem: Problem, name: str) -> float:
    """The scale of a coordinate that is held where it starts."""
    weights = problem.cost.tracked if problem.cost is not None else None
    if weights and weights.get(name, 0.0) > 0:
        return float(weights[name] ** -0.5)
    low, high = problem.limits.states.get(name, (-math.inf, math.inf))
    return high - low if math.isfinite(high - low) else 1.0
