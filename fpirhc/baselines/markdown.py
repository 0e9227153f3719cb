"""A check as Markdown, for the summary of a pull request."""

from __future__ import annotations

from collections.abc import Sequence

from fpirhc.baselines.judging import Judgement, Row
from fpirhc.baselines.words import HEADS, cells, headline, remarks

MARK = "<!-- fpirhc check -->"
_PLAIN = set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 .,+-=/'\u00b1")


def to_markdown(judgements: Sequence[Judgement], unchecked: Sequence[tuple[str, str]]) -> str:
    """Return the page: what changed in full, what holds in one line per problem."""
    good = sum(j.holds for j in judgements)
    parts = [MARK, f"### fpirhc check: {good} of {len(judgements)} problems hold", ""]
    for judgement in judgements:
        parts.append(f"**{_escaped(headline(judgement))}**")
        parts.append("")
        if judgement.changed:
            parts += _table(judgement.changed)
        parts += [f"- {_escaped(text)}" for text in remarks(judgement)]
        parts.append("")
    parts += [f"- {_code(name)} is not checked: {_escaped(reason)}" for name, reason in unchecked]
    return "\n".join(parts).rstrip() + "\n"


def _table(rows: Sequence[Row]) -> list[str]:
    lines = ["| " + " | ".join(HEADS) + " |", "| --- | --- | ---: | ---: | ---: | --- |"]
    for row in rows:
        controller, metric, old, new, band, verdict = cells(row)
        texts = (_code(controller), _code(metric), _escaped(old), _escaped(new), _escaped(band), f"**{verdict}**")
        lines.append("| " + " | ".join(texts) + " |")
    return [*lines, ""]


def _code(text: str) -> str:
    """A name from elsewhere: as code, in which nobody is mentioned."""
    return f"<code>{_escaped(text)}</code>"


def _escaped(text: str) -> str:
    """Every character that HTML or Markdown could read becomes an entity."""
    return "".join(c if c in _PLAIN or (c.isalnum() and not c.isascii()) else f"&#{ord(c)};" for c in _one_line(text))


def _one_line(text: str) -> str:
    return " ".join(text.split())
