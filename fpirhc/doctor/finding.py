"""What one check found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum


class Outcome(IntEnum):
    """From best to worst."""

    OK = 0
    WARN = 1
    FAIL = 2


@dataclass(frozen=True)
class Finding:
    """Outcome of one check: its name, what was found, and what to do about it (empty: nothing)."""

    name: str
    outcome: Outcome
    found: str
    remedy: str = ""


Check = Callable[[], tuple[Outcome, str, str]]


def ask(checks: Sequence[Check]) -> list[Finding]:
    """Run checks one by one; one that raises has failed."""
    findings = []
    for check in checks:
        name = check.__name__.replace("_", "-")
        try:
            findings.append(Finding(name, *check()))
        except Exception as error:  # noqa: BLE001 -- a broken installation may raise anything, and the other checks count
            said = str(error).strip().splitlines() or [""]
            remedy = "install fpirhc and its dependencies again in a fresh environment"
            findings.append(Finding(name, Outcome.FAIL, f"{type(error).__name__}: {said[0]}", remedy))
    return findings


def fine(found: str) -> tuple[Outcome, str, str]:
    """Nothing to do."""
    return Outcome.OK, found, ""


def judged(holds: bool, found: str, remedy: str, otherwise: Outcome = Outcome.FAIL) -> tuple[Outcome, str, str]:
    """OK where something holds, else `otherwise` with what to do."""
    return (Outcome.OK, found, "") if holds else (otherwise, found, remedy)
