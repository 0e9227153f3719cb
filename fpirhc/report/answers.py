"""A review as text on the terminal and as one JSON object."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from fpirhc.report.terminal import say
from fpirhc.studies.view import to_json

if TYPE_CHECKING:
    from fpirhc.review.answer import Answer, Review

_COLOURS = {"yes": "green", "no": "red", "unknown": "yellow"}


def show_review(title: str, review: Review) -> None:
    """Print what to do about every no, then every answer under its controller, and the number of answers of each kind."""
    console = Console()
    say(title, "bold")
    for about, answer in review.to_do:
        head = Text(f"  no      {about}: {answer.question}", _COLOURS["no"])
        console.print(head + Text(f" -> {answer.advice}", "default"), highlight=False, soft_wrap=True)
    if review.to_do:
        say("\nproblem", "bold")
    _show(console, review.problem)
    for name, answers in review.controllers.items():
        say(f"\n{name}", "bold")
        _show(console, answers)
    say(f"\n{_summary(review)}")


def review_to_json(name: str, review: Review) -> str:
    """Return the review as JSON text; numbers that are not finite become null."""
    facts = {
        "problem": name,
        "mismatch": review.mismatch,
        "ready": review.ready,
        "to_do": [{"about": about, "question": a.question, "what": a.advice} for about, a in review.to_do],
        "answers": [_facts(a) for a in review.problem],
        "controllers": {c: [_facts(a) for a in answers] for c, answers in review.controllers.items()},
    }
    return to_json(facts)


def _show(console: Console, answers: Iterable[Answer]) -> None:
    for one in answers:
        console.print(Text(f"  {one.verdict:7s} ", _COLOURS[one.verdict]) + Text(one.question), highlight=False)
        console.print(Text(f"          {one.evidence}"), highlight=False, soft_wrap=True)
        if one.change:
            console.print(Text(f"          -> {one.change}"), highlight=False, soft_wrap=True)


def _summary(review: Review) -> str:
    counts = {v: sum(a.verdict == v for a in review.answers) for v in _COLOURS}
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def _facts(answer: Answer) -> dict[str, Any]:
    return {
        "question": answer.question,
        "verdict": str(answer.verdict),
        "evidence": answer.evidence,
        "change": answer.change,
        "numbers": answer.numbers,
    }
