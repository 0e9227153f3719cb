"""The result of one check."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum


class Outcome(IntEnum):
    """Outcomes of a check, from best to worst."""

    OK = 0
    WARN = 1
    FAIL = 2


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Args:
        name: name of the check.
        outcome: its outcome.
        evidence: the facts in a sentence.
        remedy: what to do; empty: nothing.
    """

    name: str
    outcome: Outcome
    evidence: str
    remedy: str = ""


Check = Callable[[], tuple[Outcome, str, str]]


def ask(checks: Sequence[Check]) -> list[Finding]:
    """Run checks one by one; a check that raises has failed."""
    findings = []
    for check in checks:
        name = check.__name__.replace("_", "-")
        try:
            findings.append(Finding(name, *check()))
        except Exception as error:  # noqa: BLE001 -- a broken installation may raise anything, and the other checks count
            lines = str(error).strip().splitlines() or [""]
            remedy = "install fpirhc and its dependencies again in a fresh environment"
            findings.append(Finding(name, Outcome.FAIL, f"{type(error).__name__}: {lines[0]}", remedy))
    return findings


def fine(text: str) -> tuple[Outcome, str, str]:
    """Return OK, with nothing to do."""
    return Outcome.OK, text, ""


def judged(holds: bool, text: str, remedy: str, otherwise: Outcome = Outcome.FAIL) -> tuple[Outcome, str, str]:
    """Return OK where a condition holds, else `otherwise` with the remedy."""
    return (Outcome.OK, text, "") if holds else (otherwise, text, remedy)
