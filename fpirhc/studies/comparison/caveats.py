"""Why a smaller error is no success: the plant left alone does better, the reference is not followed, or plans and limits decide.

Sentences of this module stand before a positive verdict, which is then doubtful.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fpirhc.plant.units import with_space
from fpirhc.studies.comparison.causes import chatter_cause, limit_cause, plan_cause

if TYPE_CHECKING:
    from fpirhc.studies.comparison.entry import Entry


@dataclass(frozen=True)
class Yardstick:
    """What errors are measured against, by judged coordinate.

    Args:
        scales: by which errors are judged, see `fpirhc.studies.comparison.changes`; 1 where not named.
        ranges: of the references that move, the start included.
        alone: rms error of the plant left alone; empty where it is not known.
    """

    scales: Mapping[str, float] = field(default_factory=dict)
    ranges: Mapping[str, float] = field(default_factory=dict)
    alone: Mapping[str, float] = field(default_factory=dict)


def not_followed(plain: Entry, adaptive: Entry, names: list[str], yardstick: Yardstick) -> str:
    """Return a sentence where neither controller follows a reference: both rms errors exceed its range; else nothing."""
    errors = [
        (n, plain.metrics.rms_error[n], adaptive.metrics.rms_error[n], yardstick.ranges[n])
        for n in names
        if n in yardstick.ranges
    ]
    lost = [one for one in errors if min(one[1], one[2]) > one[3]]
    if not lost:
        return ""
    texts = ", ".join(
        f"the rms error of {n} is {before:.3g} and {after:.3g}{_unit(adaptive, n)}, the range of its reference {span:.3g}"
        for n, before, after, span in lost
    )
    return f"Neither {plain.name} nor {adaptive.name} follows the reference: {texts}."


def caveats(plain: Entry, adaptive: Entry, names: list[str], yardstick: Yardstick) -> str:
    """Return the reasons not to trust a smaller error, each a sentence; empty where there is none."""
    sentences = (
        left_alone_is_better(plain, adaptive, names, yardstick),
        plan_cause(plain, adaptive),
        limit_cause(plain, adaptive),
        chatter_cause(plain, adaptive),
    )
    return " ".join(sentence for sentence in sentences if sentence)


def left_alone_is_better(plain: Entry, adaptive: Entry, names: list[str], yardstick: Yardstick) -> str:
    """Return a sentence where the adaptive controller does worse than the plant left alone, in every judged coordinate."""
    alone = {n: yardstick.alone[n] for n in names if n in yardstick.alone}
    if not alone or not all(adaptive.metrics.rms_error[n] > value for n, value in alone.items()):
        return ""
    both = all(plain.metrics.rms_error[n] > value for n, value in alone.items())
    who = f"{plain.name} and {adaptive.name} do" if both else f"{adaptive.name} does"
    errors = ", ".join(f"{value:.3g}{_unit(adaptive, n)} in {n}" for n, value in alone.items())
    return f"{who} worse than the plant left alone, whose input stays as it was before the run: rms error {errors}."


def _unit(entry: Entry, name: str) -> str:
    return with_space(entry.run.unit(f"error.{name}"))
