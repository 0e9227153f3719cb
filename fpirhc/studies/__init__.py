"""Questions that take several runs. All have circumstances, and a view that page, terminal, notebook and JSON lay out."""

from __future__ import annotations

import json
import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from fpirhc.describe import as_written
from fpirhc.studies.verdict import IN_FULL, Outcome
from fpirhc.summary import Table, in_percent, printable

if TYPE_CHECKING:
    from fpirhc.controllers.base import Controller
    from fpirhc.problem_files.problem_file import Task

Progress = Callable[[str, int, int], None]  # of (controller, what is done, what there is in all)


@dataclass(frozen=True, eq=False)
class View:
    """What is said of a study; all texts are as they are in a user's file, and every output escapes them."""

    study: Study
    # the verdict, with the outcome that each sentence states; None for a remark
    sentences: Sequence[tuple[str, Outcome | None]]
    conditions: str  # what the numbers of the first table are measured on
    tables: Sequence[Table]  # its tables, the controllers first; those without rows are not shown
    facts: Mapping[str, Any] = field(repr=False)  # what the JSON object holds
    # sentences by the heading under which a page has them
    lists: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def others(self) -> str:
        """How many sentences behind the first one state which outcome, without those that every output shows in full."""
        counts = Counter(str(outcome) for _, outcome in self.sentences[1:] if outcome not in IN_FULL)
        return ", ".join(f"{count} {outcome}" for outcome, count in counts.items())


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Study(ABC):
    """The result of a study, and the circumstances in which it was made."""

    problem: str
    title: str
    description: str
    settings: Mapping[str, str]  # as Python, of the problem and of every controller, by name
    versions: Mapping[str, str]  # of fpirhc and of what its numbers depend on
    command: str  # that reproduces it; '' where there is none
    elapsed: float  # wall time, s

    @property
    @abstractmethod
    def view(self) -> View:
        """What every output says of it."""

    def __repr__(self) -> str:
        from pandas import DataFrame

        view, shown = self.view, self.view.tables[0].narrow
        rows = DataFrame([row.cells for row in shown.rows], columns=[c.head for c in shown.columns])
        said = [self.title, *(text for text, _ in view.sentences), rows.to_string(index=False)]
        return printable("\n".join(said))

    def _repr_html_(self) -> str:
        """Verdict and first table, for notebooks."""
        view = self.view
        notes = [*(text for text, _ in view.sentences), *(text for texts in view.lists.values() for text in texts)]
        return replace(view.tables[0].narrow, title=self.title).html(notes)


def circumstances(task: Task, controllers: Mapping[str, Controller], command: str, begin: float) -> dict[str, Any]:
    """Return the fields of a `Study` that has run these controllers of a task since `begin`, on the performance counter."""
    return {
        "problem": task.name,
        "title": task.title,
        "description": task.description,
        "settings": {n: as_written(v, "fp.", 100) for n, v in {"problem": task.problem, **controllers}.items()},
        "versions": versions(),
        "command": command,
        "elapsed": time.perf_counter() - begin,
    }


def versions() -> dict[str, str]:
    """Return the versions of fpirhc and of what its numbers depend on."""
    import platform

    packages = {name: version(name) for name in ("fpirhc", "casadi", "numpy", "scipy")}
    return {**packages, "python": platform.python_version(), "machine": platform.machine()}


def to_json(facts: Mapping[str, Any]) -> str:
    """Return facts as JSON text; numbers that are not finite become null."""
    return json.dumps(finite_alone(facts), indent=2, allow_nan=False)


def status_shares(statuses: Mapping[str, int]) -> str:
    """The shares of cycles whose status is not ok, such as 'not converged in 1.67 % of the cycles'."""
    cycles, words = sum(statuses.values()), {"HELD": "plan failed"}
    other = {words.get(k, k.lower().replace("_", " ")): v for k, v in statuses.items() if v and k != "OK"}
    return ", ".join(f"{what} in {in_percent(v / cycles)} of the cycles" for what, v in other.items())


def finite_alone(value: Any) -> Any:
    """Return plain data with None in place of numbers that are not finite."""
    if isinstance(value, Mapping):
        return {k: finite_alone(v) for k, v in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [finite_alone(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
