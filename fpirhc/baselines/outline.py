"""The contents of a check in the order of every output: the walk over judgements that terminal, JUnit and Markdown share.

All texts in an outline are on one line and free of control characters.
An output lays them out and escapes the characters that its format reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fpirhc.baselines.judging import Judgement, Row
from fpirhc.baselines.words import cells, clean, headline, remarks, sentence

_ALWAYS = "rms_error."  # metrics that a summary shows also where they hold


@dataclass(frozen=True)
class Line:
    """One metric.

    Args:
        cells: its texts in the order of HEADS.
        verdict: its verdict.
        holds: whether it holds.
        in_summary: whether a summary shows it.
        sentence: the metric in one sentence.
        size: of the change, by which lines are sorted.
    """

    cells: tuple[str, ...]
    verdict: str
    holds: bool
    in_summary: bool
    sentence: str
    size: float


@dataclass(frozen=True)
class Folded:
    """A setting that is not that of the baseline, with the changes that can be its consequences.

    Args:
        text: the setting in one sentence.
        lines: the changes, the largest first; those of several settings stand under the first one.
    """

    text: str
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Case:
    """One controller and its metrics.

    Args:
        controller: name of the controller.
        lines: its metrics.
    """

    controller: str
    lines: tuple[Line, ...]

    @property
    def changed(self) -> tuple[Line, ...]:
        """The lines that do not hold."""
        return tuple(line for line in self.lines if not line.holds)


@dataclass(frozen=True)
class Section:
    """One problem.

    Args:
        problem: name of the problem.
        headline: one sentence about it.
        causes: settings that are not those of the baseline.
        cases: its controllers.
        remarks: everything about it that is no metric.
        holds: whether all metrics hold.
        unclear: whether nothing can be concluded.
    """

    problem: str
    headline: str
    causes: tuple[Folded, ...]
    cases: tuple[Case, ...]
    remarks: tuple[str, ...]
    holds: bool
    unclear: bool

    @property
    def lines(self) -> tuple[Line, ...]:
        """The metrics of all controllers."""
        return tuple(line for case in self.cases for line in case.lines)

    @property
    def by_size(self) -> tuple[Line, ...]:
        """The metrics that no setting explains, the largest change first, those that hold last."""
        folded = {line for cause in self.causes for line in cause.lines}
        return tuple(sorted((line for line in self.lines if line not in folded), key=lambda line: -line.size))


@dataclass(frozen=True)
class Outline:
    """A whole check.

    Args:
        sections: the problems.
        unchecked: (name, reason) of every problem that is not checked.
    """

    sections: tuple[Section, ...]
    unchecked: tuple[tuple[str, str], ...]


def outline(judgements: Sequence[Judgement], unchecked: Sequence[tuple[str, str]] = ()) -> Outline:
    """Return the outline of the judgements; `unchecked` are (name, reason) of problems that are not checked."""
    left_out = tuple((clean(name), clean(reason)) for name, reason in unchecked)
    return Outline(tuple(_section(judgement) for judgement in judgements), left_out)


def _section(judgement: Judgement) -> Section:
    rows: dict[str, list[Row]] = {}
    for row in judgement.rows:
        rows.setdefault(row.controller, []).append(row)
    return Section(
        problem=clean(judgement.problem),
        headline=headline(judgement),
        causes=tuple(_causes(judgement)),
        cases=tuple(Case(clean(name), tuple(map(_line, own))) for name, own in rows.items()),
        remarks=tuple(remarks(judgement)),
        holds=judgement.holds,
        unclear=bool(judgement.broken or judgement.unusable or not rows),
    )


def _causes(judgement: Judgement) -> list[Folded]:
    """Every stale setting with its changes; each change stands once, under the first setting that can have caused it."""
    left, causes = list(judgement.changed), []
    for cause in judgement.causes:
        own = [row for row in left if cause.explains(row)]
        left = [row for row in left if row not in own]
        lines = tuple(map(_line, sorted(own, key=lambda row: -row.size)))
        causes.append(Folded(clean(f"stale: {cause.text}"), lines))
    return causes


def _line(row: Row) -> Line:
    summary = not row.holds or row.metric.startswith(_ALWAYS)
    return Line(cells(row), row.verdict, row.holds, summary, sentence(row), row.size)
