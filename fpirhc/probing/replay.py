"""A recording replayed through a controller: what would it have commanded, had it been given these measurements?

Nothing answers: the plant of the record moved under other commands. Where these are in the record the controller believes that they
were sent, so a model-referenced form compares the response with the model's response to them.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.errors import Mistakes, OutputError
from fpirhc.fields.checked import checked_call
from fpirhc.plant.motion import input_columns
from fpirhc.probing.recording import check_times, columns_of, lacking
from fpirhc.simulation.stepper import Stepper
from fpirhc.status import Status
from fpirhc.task.problem import Problem

_SENT = "_command_before"  # what a controller remembers of its last command


@dataclass(frozen=True, eq=False)
class Replay:
    """The commands of a controller over a recording.

    Args:
        times: of the cycles, shape (cycles,).
        inputs: names of the inputs.
        commands: that the controller would have sent, shape (cycles, inputs).
        recorded: commands in the recording; None: it has none.
        statuses: number of cycles by status.
    """

    times: np.ndarray
    inputs: tuple[str, ...]
    commands: np.ndarray
    recorded: np.ndarray | None
    statuses: Mapping[str, int]

    def differences(self) -> dict[str, tuple[float, float, float]]:
        """Return by input: the rms difference from the recorded command, the largest one, and its time; {} without a record."""
        if self.recorded is None:
            return {}
        away = self.commands - self.recorded
        at = np.nanargmax(np.abs(away), axis=0)
        rms = np.sqrt(np.nanmean(away**2, axis=0))
        return {
            name: (float(rms[k]), float(away[at[k], k]), float(self.times[at[k]])) for k, name in enumerate(self.inputs)
        }

    def write(self, path: Path) -> None:
        """Write a table: time and the commands by input.

        Raises:
            OutputError: the file cannot be written.
        """
        try:
            with path.open("w", newline="", encoding="utf-8") as file:
                table = csv.writer(file)
                table.writerow(("time", *self.inputs))
                table.writerows(np.column_stack([self.times, self.commands]).tolist())
        except OSError as error:
            raise OutputError(f"{path} cannot be written: {error.strerror}") from None


@checked_call
def replay(problem: Problem, controller: Controller, recording: Path) -> Replay:
    """Return what a controller would have commanded over a recording.

    Columns of the CSV file are "time", what the problem's controller is given ("q1", "q1'", "q1''", or what its sensors show), and
    the inputs that were sent, where they are known. A response ("q1''") without a column is the difference of its lower
    derivative. An empty entry is a sample that was lost: the cycle is skipped, as it would have been.

    Args:
        problem: the task.
        controller: any controller.
        recording: path of the file.

    Raises:
        InvalidValue: a file that is no table of numbers.
        InvalidProblem: missing columns, or times that are not a period apart; all together.
    """
    columns = columns_of(recording)
    stepper = Stepper(problem, controller, compiled=False)
    inputs = tuple(problem.plant.inputs)
    measured, recorded = _table(columns, problem, stepper.measures, recording.name)
    places = stepper.memory.slice(_SENT) if _SENT in stepper.memory else slice(0, 0)
    memory, commands, statuses = stepper.start(), np.empty((len(measured), len(inputs))), Counter[str]()
    for k, row in enumerate(measured):
        command, memory = stepper.step_measured(float(columns["time"][k]), row, memory)
        commands[k] = command
        statuses[Status(int(stepper.trace()["status"].item())).name] += 1
        if recorded is not None and np.isfinite(recorded[k]).all():
            memory[places] = recorded[k]
    return Replay(columns["time"], inputs, commands, recorded, dict(statuses))


def _table(
    columns: Mapping[str, np.ndarray], problem: Problem, measures: tuple[str, ...], name: str
) -> tuple[np.ndarray, np.ndarray | None]:
    """Measurements in the order of the controller, and recorded commands."""
    mistakes, period, inputs = Mistakes(f"recording {name}"), problem.period, input_columns(problem.plant)
    values = dict(columns)
    for one in measures:
        lower = one.removesuffix("'")
        if one not in columns and lower in columns:
            values[one] = np.diff(columns[lower], prepend=columns[lower][:1]) / period
    lacking(columns, [one for one in measures if one not in values], mistakes, ", which the controller is given")
    present = [one for one in inputs if one in columns]
    if present and len(present) < len(inputs):
        mistakes.add(
            f"it has the commands of {', '.join(present)} alone; expected those of {', '.join(inputs)}, or of none"
        )
    check_times(columns, problem, mistakes)
    mistakes.raise_if_any()
    recorded = np.column_stack([columns[one] for one in inputs]) if present else None
    return np.column_stack([values[one] for one in measures]), recorded
