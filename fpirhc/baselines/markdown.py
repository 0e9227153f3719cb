"""The output of a check as Markdown, for the summary of a pull request."""

from __future__ import annotations

from collections.abc import Sequence

from fpirhc.baselines.outline import Folded, Line, Outline
from fpirhc.baselines.words import HEADS

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
