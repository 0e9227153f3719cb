"""The output of a check on the terminal, as Markdown for the summary of a pull request, and in the sentences of a failed test.

All texts are on one line and free of control characters; every output escapes what its own format reads.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from fpirhc.baselines.baseline import FACTOR, Baseline, Metric
from fpirhc.baselines.judging import OUTCOME, Judgement, Row
from fpirhc.baselines.measuring import Number
from fpirhc.errors import OutputError
from fpirhc.report.terminal import say, show_table
from fpirhc.summary import Column, Table, written_out

_ALWAYS = "rms_error"  # what a summary shows also where it holds, unless the problem has a headline metric
_NAMED = 3  # consequences of a setting that are named
_MOSTLY = 0.9  # share of a band; its digits are rounded
_say = partial(say, wrap=False)
_STYLES = {"holds": "", "better": "bold green", "worse": "bold red"}


def show_check(judgements: Sequence[Judgement], unchecked: Mapping[str, str], every: bool) -> None:
    """Print a table and a sentence for every problem.

    `every`: whether to print every metric, and not only those that changed and the headline metric.
    """
    for one in judgements:
        name, (causes, rows) = clean(one.problem), explained(one)
        for text, own in causes:
            _say(f"{name}: {text}")
            if own and not every:
                _say(f"  {_consequences(own)}")
        shown = _by_size(one.rows) if every else [row for row in rows if in_summary(row, one.headline)]
        if shown:
            table = Table(name, [Column(head, left=head == "verdict") for head in HEADS], names=2)
            for row in shown:
                table.add(cells(row), _STYLES.get(row.verdict, "bold yellow"))
            show_table(table)
        _say(headline(one))
        for text in remarks(one):
            _say(f"  {text}")
    for problem, reason in unchecked.items():
        _say(f"{clean(problem)}: not checked ({clean(reason)})")


def explained(judgement: Judgement) -> tuple[list[tuple[str, list[Row]]], list[Row]]:
    """Return every stale setting in a sentence with the changes that can be its consequences, and the rows that none explains.

    The largest changes come first. Each stands once, under the first setting that can have caused it.
    """
    left, causes = list(judgement.rows), []
    for cause in judgement.causes:
        own = [row for row in left if cause.explains(row)]
        left = [row for row in left if not cause.explains(row)]
        causes.append((clean(f"stale: {cause.text}"), _by_size(own)))
    return causes, _by_size(left)


def in_summary(row: Row, headline: str = "") -> bool:
    """Whether a summary shows a row: what does not hold, and the headline metric; '': the rms errors."""
    return not row.holds or _speaks(row.metric, headline)


def _speaks(metric: str, headline: str) -> bool:
    """Whether a metric is the headline's, or one of its coordinates."""
    name = headline or _ALWAYS
    return metric == name or metric.startswith(f"{name}.")


def _by_size(rows: Sequence[Row]) -> list[Row]:
    return sorted(rows, key=lambda row: -row.size)


def _consequences(rows: Sequence[Row]) -> str:
    """How many changes a setting can explain, and the largest of them."""
    texts = [cells(row) for row in rows[:_NAMED]]
    largest = "; ".join(f"{text[0]}: {text[1]} {text[3]}" for text in texts)
    more = ", ..." if len(rows) > _NAMED else ""
    return f"{len(rows)} metrics changed with it ({largest}{more}); --all shows them"


def show_baseline(baseline: Baseline, path: str, headline: str = "") -> None:
    """Print the headline metric of an accepted baseline ('': the rms errors), and what has a loose band, each with its band."""
    heads = ("controller", "metric", "value", "band", "made of")
    table = Table(f"{clean(baseline.problem)}, baseline", [Column(head, left=True) for head in heads], names=2)
    loose = []
    for name, one in baseline.controllers.items():
        if not one.metrics:
            table.add([clean(name), "outcome", clean(" or ".join(one.outcomes)), "", ""])
        for metric, value in one.metrics.items():
            if value.loose:
                loose.append(f"{name}: {metric}")
            if value.loose or _speaks(metric, headline):
                band = f"\u00b1 {written_out(value.band, 2)}"
                table.add([clean(name), clean(metric), number(value.value), band, _source(value)])
        for metric, why in one.not_compared.items():
            _say(f"not compared: {clean(name)}, {clean(metric)} ({clean(why)})")
    show_table(table)
    if loose:
        _say(f"{len(loose)} bands are wider than half their value, so that most changes stay inside")
    _say(f"wrote {clean(path)}")


def _source(metric: Metric) -> str:
    """The source of variants with the largest spread, or that the band has its least width."""
    if FACTOR * metric.widest < _MOSTLY * metric.band:
        return "least width"
    return max(metric.spread, key=lambda s: metric.spread[s])


MARK = "<!-- fpirhc check -->"
_PLAIN = set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 .,+-=/'\u00b1")


def to_markdown(judgements: Sequence[Judgement], unchecked: Mapping[str, str]) -> str:
    """Return the page: all metrics that changed, and one line for every problem that holds; arguments as in `show_check`."""
    good = sum(one.holds for one in judgements)
    parts = [MARK, f"### fpirhc check: {good} of {len(judgements)} problems hold", ""]
    for one in judgements:
        causes, rows = explained(one)
        parts += [f"**{_escaped(headline(one))}**", ""]
        for text, own in causes:
            parts += [f"- {_escaped(text)}", *_folded(own)]
        parts += _table([row for row in rows if not row.holds])
        parts += [f"- {_escaped(text)}" for text in remarks(one)]
        parts.append("")
    parts += [f"- {_code(clean(name))} is not checked: {_escaped(clean(reason))}" for name, reason in unchecked.items()]
    return "\n".join(parts).rstrip() + "\n"


def _folded(rows: Sequence[Row]) -> list[str]:
    """The consequences of a setting, which a reader may open."""
    if not rows:
        return []
    summary = f"<details><summary>{len(rows)} metrics changed with it</summary>"
    return ["", summary, "", *_table(rows), "</details>", ""]


def _table(rows: Sequence[Row]) -> list[str]:
    if not rows:
        return []
    table = ["| " + " | ".join(HEADS) + " |", "| --- | --- | --- | ---: | ---: | ---: | ---: |"]
    for row in rows:
        controller, metric, verdict, *numbers = cells(row)
        texts = (_code(controller), _code(metric), f"**{verdict}**", *map(_escaped, numbers))
        table.append("| " + " | ".join(texts) + " |")
    return [*table, ""]


def _code(text: str) -> str:
    """A name as code, in which an @ mentions nobody."""
    return f"<code>{_escaped(text)}</code>"


def _escaped(text: str) -> str:
    """Every character that HTML or Markdown could read becomes an entity."""
    return "".join(c if c in _PLAIN or (c.isalnum() and not c.isascii()) else f"&#{ord(c)};" for c in _one_line(text))


def _one_line(text: str) -> str:
    return " ".join(text.split())


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
    return clean(value) if isinstance(value, str) else written_out(value, 7)


def cells(row: Row) -> tuple[str, ...]:
    """Return the entries of one row, in the order of HEADS."""
    band = "exact" if row.band is None else f"\u00b1 {written_out(row.band, 2)}"
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
    texts = [
        clean(text) for text in (judgement.broken, *_unusable(judgement), *judgement.faults, *judgement.notes) if text
    ]
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
    """Raise unless `path` is free or holds an earlier report: a check overwrites nothing else."""
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
