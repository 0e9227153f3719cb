"""The output of a check on the terminal, and as Markdown for the summary of a pull request."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from fpirhc.baselines.bands import FACTOR, Metric
from fpirhc.baselines.baseline import Baseline
from fpirhc.baselines.outline import HEADS, Folded, Line, Outline, clean, number
from fpirhc.report.terminal import say, show_table
from fpirhc.summary import Column, Table

_NAMED = 3  # consequences of a setting that are named
_MOSTLY = 0.9  # share of a band; its digits are rounded
_say = partial(say, wrap=False)
_STYLES = {"holds": "", "better": "bold green", "worse": "bold red"}


def show_check(outline: Outline, every: bool) -> None:
    """Print a table and a sentence for every problem.

    Args:
        outline: the check.
        every: whether to print every metric, and not only those that changed and the rms errors.
    """
    for section in outline.sections:
        for cause in section.causes:
            _say(f"{section.problem}: {cause.text}")
            if cause.lines and not every:
                _say(f"  {_consequences(cause)}")
        lines = section.by_size if not every else sorted(section.lines, key=lambda line: -line.size)
        shown = [line for line in lines if every or line.in_summary]
        if shown:
            table = Table(section.problem, [Column(head, left=head == "verdict") for head in HEADS], names=2)
            for line in shown:
                table.add(line.cells, _STYLES.get(line.verdict, "bold yellow"))
            show_table(table)
        _say(section.headline)
        for text in section.remarks:
            _say(f"  {text}")
    for name, reason in outline.unchecked:
        _say(f"{name}: not checked ({reason})")


def _consequences(cause: Folded) -> str:
    """How many changes a setting can explain, and the largest of them."""
    largest = "; ".join(f"{line.cells[0]}: {line.cells[1]} {line.cells[3]}" for line in cause.lines[:_NAMED])
    more = ", ..." if len(cause.lines) > _NAMED else ""
    return f"{len(cause.lines)} metrics changed with it ({largest}{more}); --all shows them"


def show_baseline(baseline: Baseline, path: str) -> None:
    """Print the metrics of an accepted baseline with their bands; only rms errors and metrics with loose bands."""
    heads = ("controller", "metric", "value", "band", "made of")
    table = Table(f"{clean(baseline.problem)}, baseline", [Column(head, left=True) for head in heads], names=2)
    loose = []
    for name, one in baseline.controllers.items():
        if not one.metrics:
            table.add([clean(name), "outcome", clean(" or ".join(one.outcomes)), "", ""])
        for metric, value in one.metrics.items():
            if value.loose:
                loose.append(f"{name}: {metric}")
            if value.loose or metric.startswith("rms_error."):
                band = f"\u00b1 {value.band:.2g}"
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


def to_markdown(outline: Outline) -> str:
    """Return the page: all metrics that changed, and one line for every problem that holds."""
    good = sum(section.holds for section in outline.sections)
    parts = [MARK, f"### fpirhc check: {good} of {len(outline.sections)} problems hold", ""]
    for section in outline.sections:
        parts += [f"**{_escaped(section.headline)}**", ""]
        for cause in section.causes:
            parts += [f"- {_escaped(cause.text)}", *_folded(cause)]
        parts += _table([line for line in section.by_size if not line.holds])
        parts += [f"- {_escaped(text)}" for text in section.remarks]
        parts.append("")
    parts += [f"- {_code(name)} is not checked: {_escaped(reason)}" for name, reason in outline.unchecked]
    return "\n".join(parts).rstrip() + "\n"


def _folded(cause: Folded) -> list[str]:
    """The consequences of a setting, which a reader may open."""
    if not cause.lines:
        return []
    summary = f"<details><summary>{len(cause.lines)} metrics changed with it</summary>"
    return ["", summary, "", *_table(cause.lines), "</details>", ""]


def _table(lines: Sequence[Line]) -> list[str]:
    if not lines:
        return []
    table = ["| " + " | ".join(HEADS) + " |", "| --- | --- | --- | ---: | ---: | ---: | ---: |"]
    for line in lines:
        controller, metric, verdict, *numbers = line.cells
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
