"""Probing signals, and a recording of a run from a CSV file."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import any_gain
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation.base import Deformation, Iteration
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.motion import input_columns
from fpirhc.sensing.base import response_names
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.symbolic.layout import Expression, Layout, scalar
from fpirhc.task.problem import Problem

_HOLDS = (1, 2, 4, 8, 16)  # cycles
_NOISES, _SHARE = 2.0, 0.1  # amplitude: of the noise, and of the deviation of the desired response
_BEGUN = 3  # cycles after which a response is one of the run


@dataclass(frozen=True)
class Excitation(Deformation):
    """r_k = d_k + A s_k with a random binary sequence s, independent in every channel."""

    amplitude: tuple[float, ...]  # A of every channel, in the unit of the response; 0 only listens
    cycles: int  # length of the sequence; after it the request is the desired response
    seed: int = 0  # of the sequence

    @property
    def iteration(self) -> Iteration:
        return Iteration(limited=False)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        del elements
        return Layout(
            (*(scalar(f"{name}_before") for pair in self._names for name in pair), scalar("excitation_cycle"))
        )

    def shown(self) -> Mapping[str, str]:
        return {name: f"{name}_before" for pair in self._names for name in pair}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        table = sequence(self.cycles, len(self.amplitude), self.seed) * np.array(self.amplitude)
        cycle = memory["excitation_cycle"]
        grid = [np.arange(self.cycles, dtype=float).tolist()]
        added = [
            ca.interpolant(f"excitation{k}", "linear", grid, column.tolist())(ca.fmin(cycle, self.cycles - 1))
            for k, column in enumerate(table.T)
        ]
        remembered = {"excitation_cycle": cycle + 1}
        for k, (model, measured) in enumerate(self._names):
            remembered |= {f"{model}_before": request[k], f"{measured}_before": response[k]}
        return desired + ca.vertcat(*added), remembered

    def effective_gain(self) -> float:
        """Next to nothing; zero would be no adaptation, with which no loop passes its response on."""
        return 1e-9

    def secant_gain(self) -> float:
        return self.effective_gain()

    def largest_step(self) -> float:
        return float("inf")

    def with_effective_gain(self, gain: float) -> Self:
        del gain
        return replace(self)

    @property
    def _names(self) -> list[tuple[str, str]]:
        return [(f"excitation_model_{k}", f"excitation_response_{k}") for k in range(len(self.amplitude))]


@dataclass(frozen=True, eq=False)
class Record:
    """What was recorded."""

    measured: np.ndarray  # responses, shape (cycles, n)
    modelled: np.ndarray  # the model's responses to the commands that acted
    usable: np.ndarray  # which cycles count: those with an answer
    amplitude: tuple[float, ...] = ()  # of the excitation
    stop: str = ""  # why the run ended early; empty where it did not
    clipped: float = 0.0  # share of the cycles with a command at a limit


def sequence(cycles: int, channels: int, seed: int) -> np.ndarray:
    """Return +-1, shape (cycles, channels), held for 1 to 16 cycles: power at all frequencies of interest; 0 in the end."""
    random, signs = np.random.default_rng(seed), np.zeros((cycles, channels))
    for j in range(channels):
        k, sign = 0, 1.0
        while k < cycles:
            hold = int(random.choice(_HOLDS))
            sign = float(random.choice([-1.0, 1.0])) if random.random() < 0.5 else -sign
            signs[k : k + hold, j] = sign
            k += hold
    signs[-1] = 0
    return signs


def excited(
    problem: Problem, controller: Controller, *, cycles: int, amplitude: float | Mapping[str, float] | None, seed: int
) -> Record:
    """Return the record of a run under the controller without its deformation, excited.

    Args:
        amplitude: in the unit of the response, by controlled coordinate or one for all; None: twice the noise of a silent run of
            the same length and a tenth of the deviation of its desired response.
    """
    names = problem.plant.controlled_names
    short, bare = replace(problem, duration=cycles * problem.period, measure_from=0.0), without_deformation(controller)
    if amplitude is None:
        run, silent = _run(short, bare, (0.0,) * len(names), cycles, seed)
        noise = np.median(np.abs(np.diff((silent.measured - silent.modelled)[_BEGUN:], axis=0)), axis=0) / 0.6745
        sizes = _NOISES * noise / np.sqrt(2) + _SHARE * np.std(np.asarray(run["desired"])[_BEGUN:], axis=0)
        chosen = tuple(map(float, sizes))
    elif isinstance(amplitude, Mapping):
        chosen = tuple(float(amplitude.get(name, 0.0)) for name in names)
    else:
        chosen = (float(amplitude),) * len(names)
    return _run(short, bare, chosen, cycles, seed)[1]


def _run(
    problem: Problem, bare: Controller, amplitude: tuple[float, ...], cycles: int, seed: int
) -> tuple[Run, Record]:
    excitation = Excitation(amplitude, cycles, seed)
    at_once = ModelReferenced(excitation, cycles=0.0, lag=0.0)  # all lateness is identified, the stated one too
    with any_gain():  # nothing is iterated, so the sign of the plant's gain does not matter
        run = simulate(problem, bare.with_deformation(at_once), seed=seed, compiled=False)
    if run.stop is None:
        require_moving(run["command"], problem.plant.inputs, "probe")
    modelled, measured = (np.column_stack([run[pair[k]] for pair in excitation._names]) for k in (0, 1))
    held = np.asarray(run["foreign_held"]).ravel() if "foreign_held" in run.layout.names else np.zeros(len(measured))
    clipped = float(np.mean(np.asarray(run["clipped"]) > 0)) if len(measured) else 0.0
    return run, Record(measured, modelled, held == 0, amplitude, run.stop or "", clipped)


def require_moving(commands: np.ndarray, inputs: Iterable[str], where: str) -> None:
    """Raise if an input never changes."""
    still = np.ptp(commands, axis=0) <= 1e-9 * np.abs(commands).max(axis=0)  # NaN moves
    if still.any():
        raise InvalidValue(
            f"{where}: the input '{list(inputs)[int(np.argmax(still))]}' never changes, so nothing can be known of its gain; "
            "record a run in which it steps, or excite it"
        )


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
    require_moving(commands, plant.inputs, f"recording {path.name}")
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
    times, period, unit = columns["time"], problem.period, problem.time_unit
    if len(times) < 2:
        mistakes.add("it has fewer than two rows of numbers below the line of names")
        return
    uneven = ~(np.abs(np.diff(times) - period) <= _EVEN * period)
    if uneven.any():
        k = int(np.argmax(uneven))
        mistakes.add(
            f"its times are not {period:g} {unit} apart, the period of the problem: {times[k]:g} is followed by {times[k + 1]:g}"
        )


def columns_of(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a CSV file by name; an empty entry is NaN."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = csv.reader(file)
            numbered = [(lines.line_num, row) for row in lines if row and not row[0].startswith("#")]
    except OSError as error:
        raise InvalidValue(f"recording '{path}' cannot be read: {error.strerror}") from None
    except (ValueError, csv.Error) as error:
        raise InvalidValue(f"recording {path}: cannot be read as a CSV file with a line of names ({error})") from None
    if not numbered:
        raise InvalidValue(
            f"recording {path.name}: it is empty; expected a line of names, such as time, and rows of numbers"
        )
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
