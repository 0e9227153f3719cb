"""Colours of outcomes: green is better, red worse, amber mixed or doubtful; no difference and not comparable have none."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fpirhc.studies.comparison.outcome import Outcome

_STYLES = {
    "better": "green",
    "worse": "bold red",
    "mixed": "yellow",
    "doubtful": "yellow",
    "no difference": "",
    "not comparable": "dim",
}


def terminal_style(outcome: Outcome | None) -> str:
    """Return the style of a sentence on the terminal; none for a remark."""
    return "" if outcome is None else _STYLES[outcome]


def css_class(outcome: Outcome | None) -> str:
    """Return the class of a sentence in HTML."""
    return "remark" if outcome is None else f"outcome-{outcome.value.replace(' ', '-')}"
