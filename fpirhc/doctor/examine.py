"""Runs every check and returns the findings, as lines or as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

from fpirhc.doctor import machine
from fpirhc.doctor.finding import Finding, Outcome, ask


@dataclass(frozen=True)
class Diagnosis:
    """The results of all checks.

    Args:
        versions: versions of fpirhc and of what its numbers depend on.
        findings: findings in the order of the checks.
    """

    versions: dict[str, str]
    findings: Sequence[Finding]

    @property
    def outcome(self) -> Outcome:
        """The worst of all findings."""
        return max((f.outcome for f in self.findings), default=Outcome.OK)

    def text(self) -> str:
        """Return one line per finding, with the remedy under each that is not OK."""
        lines = [", ".join(f"{name} {number}" for name, number in self.versions.items())]
        for finding in self.findings:
            lines.append(f"{finding.outcome.name.lower():4s}  {finding.name}: {finding.evidence}")
            if finding.remedy:
                lines.append(f"      to do: {finding.remedy}")
        counts = [sum(f.outcome == outcome for f in self.findings) for outcome in Outcome]
        return "\n".join([*lines, f"{counts[0]} ok, {counts[1]} to look at, {counts[2]} failed"])

    def json(self) -> str:
        """Return one JSON object."""
        checks = [
            {"name": f.name, "outcome": f.outcome.name.lower(), "evidence": f.evidence, "remedy": f.remedy}
            for f in self.findings
        ]
        return json.dumps({"outcome": self.outcome.name.lower(), "versions": self.versions, "checks": checks}, indent=2)


def examine() -> Diagnosis:
    """Return the versions of the installation and the results of all checks."""
    return Diagnosis(machine.versions(), ask(machine.CHECKS))
