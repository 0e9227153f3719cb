"""Outcomes of a comparison, and findings: sentences with the outcome that they state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from fpirhc.by_name import FoundByName
from fpirhc.summary import numbers_written_out


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
    """One sentence of a verdict.

    Args:
        text: the sentence.
        outcome: of the pair that it is about; None for a remark.
        pair: names of the controllers without and with adaptation, where it is about a pair.
        ratios: rms error with adaptation over that without, by judged coordinate, largest first; NaN where both are zero.
    """

    text: str
    outcome: Outcome | None = None
    pair: tuple[str, str] | None = None
    ratios: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", numbers_written_out(self.text))
        super().__post_init__()
