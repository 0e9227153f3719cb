"""An answer to one question, and all answers about one problem."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from fpirhc.fields.checked import FoundByName
from fpirhc.summary import line, numbers_written_out, table
from fpirhc.task.problem import Problem


class Verdict(StrEnum):
    """The verdict of an answer; yes is good in every question.

    Caution is known as well as yes and no: less than is wished for, and no reason to stop.
    """

    YES = "yes"
    CAUTION = "caution"
    NO = "no"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Answer(FoundByName):
    """The answer to one question.

    Args:
        question: in the words of a reader.
        verdict: yes, caution, no, unknown.
        evidence: the facts in a sentence, with the deciding number and its unit.
        change: what to change; empty after a yes.
        numbers: the same facts by name.
    """

    question: str
    verdict: Verdict
    evidence: str
    change: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "evidence", numbers_written_out(self.evidence))
        object.__setattr__(self, "change", numbers_written_out(self.change))
        super().__post_init__()

    @property
    def advice(self) -> str:
        """What to do, in one line; the facts before it where it points at them or at other answers."""
        points = not self.change or self.change.startswith("See ")
        return " ".join(f"{f'{self.evidence}. ' if points else ''}{self.change}".split())


@dataclass(frozen=True)
class Review(FoundByName):
    """All answers about a problem and its controllers.

    Args:
        problem: answers about the problem.
        controllers: answers about each controller, by name.
        mismatch: range of the exact parameters, percent, see `fpirhc.plant.plant`.
    """

    problem: tuple[Answer, ...]
    controllers: Mapping[str, tuple[Answer, ...]]
    mismatch: float

    def __repr__(self) -> str:
        return line(self, "ready" if self.ready else "not ready", self._counts(), f"mismatch {self.mismatch:g} %")

    def _repr_html_(self) -> str:
        """All answers as a table, for notebooks; those that are no come first."""
        groups = [("problem", self.problem), *self.controllers.items()]
        rows = [(name, a.question, str(a.verdict), a.evidence, a.change) for name, group in groups for a in group]
        rows.sort(key=lambda row: row[2] != Verdict.NO)
        title = f"Review: {'ready' if self.ready else 'not ready'}"
        return table(title, ("about", "question", "answer", "facts", "what to change"), rows, [self._counts()])

    def _counts(self) -> str:
        return ", ".join(f"{sum(a.verdict == v for a in self.answers)} {v}" for v in Verdict)

    @property
    def answers(self) -> tuple[Answer, ...]:
        """All answers, the problem's first."""
        return (*self.problem, *(a for group in self.controllers.values() for a in group))

    @property
    def to_do(self) -> tuple[tuple[str, Answer], ...]:
        """The answers that are no, each with what it is about: 'problem', or the name of a controller."""
        groups = [("problem", self.problem), *self.controllers.items()]
        return tuple((about, a) for about, group in groups for a in group if a.verdict == Verdict.NO)

    @property
    def ready(self) -> bool:
        """Whether no answer is no."""
        return not self.to_do


def decided(good: bool) -> Verdict:
    """Return yes where the condition holds, else no."""
    return Verdict.YES if good else Verdict.NO


def per_cycle(pole: float, problem: Problem) -> str:
    """Return 'is multiplied by 0.976 per cycle (time constant 41 ms)'; without the time where the mode does not decay."""
    text = f"is multiplied by {pole:.6g} per cycle"
    return f"{text} (time constant {duration(-problem.period / math.log(pole), problem)})" if 0 < pole < 1 else text


def duration(time: float, problem: Problem) -> str:
    """Return a time in the problem's unit; a time of less than a second in ms or us."""
    unit = problem.time_unit
    if unit != "s" or not 0 < time < 1:
        return f"{time:.3g} {unit}"
    return f"{1e3 * time:.3g} ms" if time >= 1e-3 else f"{1e6 * time:.3g} us"
