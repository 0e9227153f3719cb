"""Texts that all outputs of a check share: numbers, verdicts, and names that cannot hide commands."""

from __future__ import annotations

import math
import unicodedata
from pathlib import Path

from fpirhc.baselines.judging import OUTCOME, Judgement, Row
from fpirhc.baselines.measuring import Number
from fpirhc.errors import OutputError

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
