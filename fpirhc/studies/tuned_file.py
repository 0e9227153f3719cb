"""The file that `fpirhc tune` writes, and the notes about it in a comparison."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fpirhc.errors import InvalidValue, Mistakes, ProblemFileError
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.settings import Values, with_settings
from fpirhc.simulation.metrics import RELATIVE_ERROR
from fpirhc.studies.comparison.comparison import Comparison
from fpirhc.whole_file import write_whole

FORMAT = 1


@dataclass(frozen=True, eq=False)
class TunedSettings:
    """The content of a file of `fpirhc tune`."""

    values: Mapping[str, Values]  # settings by controller and path
    notes: Mapping[str, str]  # a sentence for every controller of the task


def read_tuned(path: str | Path, task: Task) -> TunedSettings:
    """Read the file that `fpirhc tune` wrote for this problem."""
    try:
        facts = json.loads(Path(path).read_text(encoding="utf-8"))
        if facts["format"] != FORMAT:
            raise ProblemFileError(f"'{path}' has format {facts['format']}, this version reads {FORMAT}")
        if facts["problem"] != task.name:
            raise ProblemFileError(f"'{path}' is of problem '{facts['problem']}', not of '{task.name}'")
        values = {name: dict(entry["settings"]) for name, entry in facts["controllers"].items()}
        by = "" if facts.get("metric", RELATIVE_ERROR) == RELATIVE_ERROR else f" by {facts['metric']}"
        how = f"{facts['trials']} trials{by}, seed {facts['seed']}, {facts['conditions']}"
        notes = {
            name: f"tuned ({how}): {', '.join(f'{p} = {v:g}' for p, v in entry['settings'].items())}; "
            f"cost {entry['cost_before']:.4g} before, {entry['cost']:.4g} after"
            for name, entry in facts["controllers"].items()
        }
    except OSError as error:
        raise ProblemFileError(
            f"cannot read '{path}': {error.strerror}; 'fpirhc tune {task.name}' writes such a file"
        ) from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise ProblemFileError(f"'{path}' is not a file that 'fpirhc tune' wrote") from None
    rest = {name: "not tuned: settings of the problem file" for name in task.controllers if name not in notes}
    return TunedSettings(values, {**notes, **rest})


def noted(comparison: Comparison, notes: Mapping[str, str]) -> Comparison:
    """Return the comparison with a note on every controller that `notes` names."""
    all_notes = {e.name: (*e.notes, notes[e.name]) if e.name in notes else e.notes for e in comparison.entries}
    return replace(comparison, entries=tuple(replace(e, notes=all_notes[e.name]) for e in comparison.entries))


def check_apart(tuned: Mapping[str, Values], settings: Collection[str], file: Path) -> None:
    """Raise if a number is both tuned and set; `settings`: paths that are set."""
    for name, values in tuned.items():
        for path in values:
            if path in settings:
                raise InvalidValue(f"--set {path}: '{file}' has this number of '{name}' too; leave one of them out")


def with_tuned(task: Task, tuned: Mapping[str, Values]) -> Task:
    """Return the task with these settings of these controllers changed."""
    mistakes = Mistakes(f"tuned settings of problem '{task.name}'")
    mistakes.unknown("controller", tuned, task.controllers)
    changed = dict(task.controllers)
    for name, values in tuned.items():
        if name in changed:
            with mistakes.caught(f"controller '{name}': "):
                changed[name] = with_settings(changed[name], values)
    mistakes.raise_if_any()
    return replace(task, controllers=changed)


def as_python(tuned: Mapping[str, Values], notes: Mapping[str, str]) -> str:
    """Return the lines that give a problem file's controllers these settings; `notes` stand behind them."""
    lines = []
    for name, values in tuned.items():
        inside = ", ".join(f"{path!r}: {value!r}" for path, value in values.items())
        note = f"  # {notes[name]}" if name in notes else ""
        lines.append(f"controllers[{name!r}] = fp.with_settings(controllers[{name!r}], {{{inside}}}){note}")
    return "\n".join(lines)


def write_tuned(facts: Mapping[str, Any], path: Path) -> None:
    """Write the facts of a tuning, atomically."""
    content = json.dumps({"format": FORMAT, **facts}, indent=2, allow_nan=False) + "\n"
    write_whole(content, path, "tuned settings")
