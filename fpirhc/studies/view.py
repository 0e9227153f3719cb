"""The view of a study: everything that page, terminal, notebook and JSON say of it, each laying it out in its way."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from fpirhc.studies.comparison.outcome import Outcome
from fpirhc.summary import Table, in_percent


@dataclass(frozen=True, eq=False)
class View:
    """What is said of a study; all texts are as they are in a user's file, and every output escapes them.

    Args:
        title: its title.
        about: the problem's description.
        sentences: the verdict, with the outcome that each sentence states; None for a remark.
        conditions: what the numbers of the first table are measured on.
        tables: its tables, the controllers first; those without rows are not shown.
        lists: sentences by the heading under which a page has them.
        skipped: reasons why controllers did not run, by name.
        settings: settings of the problem and of every controller, by name.
        versions: versions of fpirhc and of what its numbers depend on.
        command: the command that reproduces it; '' where there is none.
        elapsed: wall time, s.
        facts: what the JSON object holds.
    """

    title: str
    about: str
    sentences: Sequence[tuple[str, Outcome | None]]
    conditions: str
    tables: Sequence[Table]
    lists: Mapping[str, Sequence[str]]
    skipped: Mapping[str, str]
    settings: Mapping[str, Any]
    versions: Mapping[str, str]
    command: str
    elapsed: float
    facts: Mapping[str, Any] = field(repr=False)

    def html(self) -> str:
        """Return the verdict and the first table for a notebook."""
        notes = [*(text for text, _ in self.sentences), *(text for texts in self.lists.values() for text in texts)]
        return replace(self.tables[0].narrow, title=self.title).html(notes)


def to_json(facts: Mapping[str, Any]) -> str:
    """Return facts as JSON text; numbers that are not finite become null."""
    return json.dumps(_finite(facts), indent=2, allow_nan=False)


def status_shares(statuses: Mapping[str, int]) -> str:
    """The shares of cycles whose status is not ok, such as 'not converged 1.67 %'; 'ok' where there are none."""
    cycles = sum(statuses.values())
    other = {name: count for name, count in statuses.items() if count and name != "OK"}
    return ", ".join(f"{k.lower().replace('_', ' ')} {in_percent(v / cycles)}" for k, v in other.items()) or "ok"


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
