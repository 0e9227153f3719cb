"""The contents of a check in the order of every output: the walk over judgements that terminal and Markdown share.

All texts in an outline are on one line and free of control characters.
An output lays them out and escapes the characters that its format reads.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fpirhc.baselines.judging import OUTCOME, Judgement, Row
from fpirhc.baselines.measuring import Number
from fpirhc.errors import OutputError

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


HEADS = ("controller", "metric", "verdict", "change", "old", "new", "band")
_UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")  # control, format, surrogate, private, line and paragraph marks


def clean(text: str) -> str:
    """Return the text on one line without control characters and without '::', which a hosted CI could read as a command."""
    seen = "".join("\ufffd" if unicodedata.category(c) in _UNSEEN else c for c in text.replace("\n", " "))
    return seen.replace("::", ": :")


def number(value: Number | None) -> str:
    """Return a value as text for a table."""
    if value is None:
        return "-"
    return clean(value) if isinstance(value, str) else f"{value:.7g}"


def cells(row: Row) -> tuple[str, ...]:
    """Return the entries of one row, in the order of HEADS."""
    band = "exact" if row.band is None else f"\u00b1 {row.band:.2g}"
    names = clean(row.controller), clean(row.metric)
    return *names, row.verdict, change(row.change), number(row.old), number(row.new), band


def change(share: float | None) -> str:
    """Return a change in percent of the old value."""
    if share is None:
        return "-"
    if share == 0:
        return "0 %"
    return f"{100 * share:+.3g} %" if math.isfinite(share) else "from zero"


def headline(judgement: Judgement) -> str:
    """Return one sentence about a problem."""
    name = clean(judgement.problem)
    if judgement.broken:
        return f"{name}: cannot be run"
    if judgement.unusable:
        stale = all(text.startswith("stale") for text in judgement.unusable)
        return f"{name}: the baseline is stale" if stale else f"{name}: no usable baseline"
    controllers = len({row.controller for row in judgement.rows})
    if judgement.changed:
        return f"{name}: {len(judgement.changed)} of {len(judgement.rows)} metrics changed"
    return f"{name}: {len(judgement.rows)} metrics of {controllers} controllers hold"


def remarks(judgement: Judgement) -> list[str]:
    """Return everything about a problem that is no row: why it cannot be judged, why runs ended, and what to do."""
    texts = [clean(text) for text in (judgement.broken, *_unusable(judgement), *judgement.notes) if text]
    if judgement.changed or any(text.startswith("stale") for text in judgement.unusable):
        texts.append(
            f"baseline of {clean(judgement.date)}: {clean(judgement.reason)}. If the new numbers are right: "
            "fpirhc accept PROBLEM --reason '...'"
        )
    return texts


def _unusable(judgement: Judgement) -> list[str]:
    """Reasons why nothing can be concluded, without the settings that changed: those stand first, with their consequences."""
    return [text for text in judgement.unusable if text not in {f"stale: {cause.text}" for cause in judgement.causes}]


def sentence(row: Row) -> str:
    """Return one comparison as a line of plain text."""
    controller, metric, verdict, percent, old, new, band = cells(row)
    within = "" if row.metric == OUTCOME else f" ({band})" if row.change is None else f" ({percent}, band {band})"
    return f"{controller}: {metric} was {old}, is {new}{within}: {verdict}"


def check_replaceable(path: Path, mark: str) -> None:
    """Raise unless `path` is free or holds an earlier report: a check overwrites nothing else.

    Raises:
        OutputError: the path holds something else, or its folder does not exist.
    """
    if not path.parent.is_dir():
        raise OutputError(f"cannot write to '{path}': there is no folder '{path.parent}'")
    try:
        if not path.exists():
            return
        with path.open("rb") as file:
            head = file.read(400)
    except OSError as error:
        raise OutputError(f"cannot write to '{path}': {error.strerror}") from None
    if head and mark.encode() not in head:
        raise OutputError(
            f"'{path}' exists and is no report of 'fpirhc check'; it is not overwritten: choose another name"
        )
