"""What a check says, in the order in which every output says it: the walk over judgements that terminal, JUnit and Markdown share.

All texts in an outline are on one line and free of control characters; a form only lays them out and escapes what its format reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fpirhc.baselines.judging import Judgement, Row
from fpirhc.baselines.words import cells, clean, headline, remarks, sentence

_ALWAYS = "rms_error."  # metrics that a summary shows also where they hold


@dataclass(frozen=True)
class Line:
    """One metric: its texts in the order of HEADS, whether it holds, whether a summary shows it, and all of it as a sentence."""

    cells: tuple[str, ...]
    verdict: str
    holds: bool
    in_summary: bool
    sentence: str


@dataclass(frozen=True)
class Case:
    """One controller and its metrics."""

    controller: str
    lines: tuple[Line, ...]

    @property
    def changed(self) -> tuple[Line, ...]:
        """The lines that do not hold."""
        return tuple(line for line in self.lines if not line.holds)


@dataclass(frozen=True)
class Section:
    """One problem: its headline, its controllers, and remarks; `unclear` where nothing can be concluded."""

    problem: str
    headline: str
    cases: tuple[Case, ...]
    remarks: tuple[str, ...]
    holds: bool
    unclear: bool

    @property
    def lines(self) -> tuple[Line, ...]:
        """The metrics of all controllers."""
        return tuple(line for case in self.cases for line in case.lines)


@dataclass(frozen=True)
class Outline:
    """A whole check: its problems, and (name, reason) of those that are not checked."""

    sections: tuple[Section, ...]
    unchecked: tuple[tuple[str, str], ...]


def outline(judgements: Sequence[Judgement], unchecked: Sequence[tuple[str, str]] = ()) -> Outline:
    """Return what to say about the judgements."""
    left_out = tuple((clean(name), clean(reason)) for name, reason in unchecked)
    return Outline(tuple(_section(judgement) for judgement in judgements), left_out)


def _section(judgement: Judgement) -> Section:
    rows: dict[str, list[Row]] = {}
    for row in judgement.rows:
        rows.setdefault(row.controller, []).append(row)
    return Section(
        problem=clean(judgement.problem),
        headline=headline(judgement),
        cases=tuple(Case(clean(name), tuple(map(_line, own))) for name, own in rows.items()),
        remarks=tuple(remarks(judgement)),
        holds=judgement.holds,
        unclear=bool(judgement.broken or judgement.unusable or not rows),
    )


def _line(row: Row) -> Line:
    summary = not row.holds or row.metric.startswith(_ALWAYS)
    return Line(cells(row), row.verdict, row.holds, summary, sentence(row))
