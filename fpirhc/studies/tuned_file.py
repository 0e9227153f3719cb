"""The file in which `fpirhc tune` leaves what it found, and what a comparison says of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fpirhc.errors import OutputError, ProblemFileError
from fpirhc.studies.problem_file import Task
from fpirhc.studies.settings import Values

FORMAT = 1


@dataclass(frozen=True, eq=False)
class Tuned:
    """Tuned settings by controller and path, and a sentence for every controller of the task."""

    values: Mapping[str, Values]
    notes: Mapping[str, str]


def read_tuned(path: str | Path, task: Task) -> Tuned:
    """Read the file that `fpirhc tune` wrote for this problem.

    Raises:
        OutputError: it cannot be read. ProblemFileError: it is of another problem, or no such file.
    """
    try:
        facts = json.loads(Path(path).read_text(encoding="utf-8"))
        if facts["format"] != FORMAT:
            raise ProblemFileError(f"'{path}' has format {facts['format']}, this version reads {FORMAT}")
        if facts["problem"] != task.name:
            raise ProblemFileError(f"'{path}' is of problem '{facts['problem']}', not of '{task.name}'")
        values = {name: dict(entry["settings"]) for name, entry in facts["controllers"].items()}
        how = f"{facts['trials']} trials, seed {facts['seed']}, {facts['conditions']}"
        notes = {
            name: f"tuned ({how}): {', '.join(f'{p} = {v:g}' for p, v in entry['settings'].items())}; "
            f"cost {entry['cost_before']:.4g} before, {entry['cost']:.4g} after"
            for name, entry in facts["controllers"].items()
        }
    except OSError as error:
        raise OutputError(f"cannot read '{path}': {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise ProblemFileError(f"'{path}' is not a file that 'fpirhc tune' wrote") from None
    rest = {name: "not tuned: settings of the problem file" for name in task.controllers if name not in notes}
    return Tuned(values, {**notes, **rest})
