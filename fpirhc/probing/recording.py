"""A recording of a run: commands and measurements of every cycle, from a CSV file."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.motion import input_columns
from fpirhc.probing.excitation import Record
from fpirhc.sensing.base import response_names
from fpirhc.task.problem import Problem

_EVEN = 0.01  # share of the period by which a time may be off


def read_recording(path: Path, problem: Problem) -> Record:
    """Return the record in a CSV file.

    Its columns are "time", every input by name (the command that is sent at this time;
    "input NAME" where a coordinate has the same name), the elements of the model's state, and the
    responses ("q1''"); a response without a column is the difference of its lower derivative over a cycle.

    Args:
        path: of the file.
        problem: whose model and period it is of.

    Raises:
        InvalidValue: missing columns, other times than those of the period, entries that are no numbers; all mistakes together.
    """
    columns = columns_of(path)
    plant, period, mistakes = problem.plant, problem.period, Mistakes(f"recording {path.name}")
    responses = response_names(plant)
    lower = {name: name[:-1] for name in responses}
    needed = ("time", *input_columns(plant), *plant.state.elements)
    lacking(columns, needed, mistakes)
    for name in responses:
        if name not in columns and lower[name] not in columns:
            mistakes.add(f"it has no column '{name}', nor '{lower[name]}' to take the difference of")
    mistakes.raise_if_any()
    check_times(columns, problem, mistakes)
    mistakes.raise_if_any()
    states = np.column_stack([columns[e] for e in plant.state.elements])
    commands = np.column_stack([columns[n] for n in input_columns(plant)])
    measured = np.column_stack(
        [columns[n] if n in columns else np.diff(columns[lower[n]], prepend=np.nan) / period for n in responses]
    )[1:]
    modelled = np.array(plant.equations.controlled_response(states[1:].T, commands[:-1].T, plant.approximate)).T
    usable = np.isfinite(measured).all(axis=1) & np.isfinite(modelled).all(axis=1)
    if usable.sum() < len(usable):
        measured, modelled = (np.where(np.isfinite(one), one, 0.0) for one in (measured, modelled))
    return Record(measured, modelled, usable)


def lacking(columns: Mapping[str, np.ndarray], needed: Sequence[str], mistakes: Mistakes, what: str = "") -> None:
    """Add one mistake that names all columns that are missing, and those that there are."""
    missing = [name for name in needed if name not in columns]
    if missing:
        some = "a column" if len(missing) == 1 else "columns"
        mistakes.add(f"it lacks {some} for {', '.join(missing)}{what}; its columns are {', '.join(columns)}")


def check_times(columns: Mapping[str, np.ndarray], problem: Problem, mistakes: Mistakes) -> None:
    """Add a mistake where the times are missing, or are not a period apart."""
    if "time" not in columns:
        lacking(columns, ["time"], mistakes)
        return
    steps = np.diff(columns["time"])
    if not len(steps) or not np.all(np.abs(steps - problem.period) <= _EVEN * problem.period):
        mistakes.add(f"its times are not {problem.period:g} {problem.time_unit} apart, the period of the problem")


def columns_of(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a CSV file by name; an empty entry is NaN.

    Raises:
        InvalidValue: it cannot be read, or is not made of numbers.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = csv.reader(file)
            numbered = [(lines.line_num, row) for row in lines if row and not row[0].startswith("#")]
    except OSError as error:
        raise InvalidValue(f"recording '{path}' cannot be read: {error.strerror}") from None
    except (ValueError, csv.Error) as error:
        raise InvalidValue(f"recording {path}: cannot be read as a CSV file with a line of names ({error})") from None
    if not numbered:
        raise InvalidValue(f"recording {path}: is empty; expected a line of names, such as time, and rows of numbers")
    (_, head), *rows = numbered
    values = []
    for number, row in rows:
        if len(row) != len(head):
            raise InvalidValue(
                f"recording {path.name}: line {number} has {len(row)} entries, the line of names {len(head)}"
            )
        try:
            values.append([float(entry) if entry.strip() else np.nan for entry in row])
        except ValueError:
            raise InvalidValue(
                f"recording {path.name}: line {number} is not made of numbers: {', '.join(row)}"
            ) from None
    table = np.array(values).reshape(-1, len(head))
    return {name.strip(): column for name, column in zip(head, table.T, strict=True)}
