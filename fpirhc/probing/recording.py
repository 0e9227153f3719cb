"""Probing signals, and a recording of a run from a CSV file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
import pandas as pd

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation.base import Identity
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.chain import response_names
from fpirhc.probing.identification import require_cycles
from fpirhc.simulation.replay import raw_measurements, where_given
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.symbolic.layout import Expression, Layout, scalar
from fpirhc.task.exogenous import model_values
from fpirhc.task.problem import Problem

_NOISES, _SHARE = 2.0, 0.1  # amplitude: of the noise, and of the deviation of the desired response
_EVEN, _BEGUN = 0.01, 3  # share of the period by which a time may be off; cycles before a response is one of the run


@dataclass(frozen=True)
class Excitation(Identity):
    """r_k = d_k + A s_k with a random binary sequence s, independent in every channel."""

    amplitude: tuple[float, ...]  # A of every channel, in the unit of the response; 0 only listens
    cycles: int  # length of the sequence; after it the request is the desired response
    seed: int = 0  # of the sequence

    def memory(self, elements: tuple[str, ...]) -> Layout:  # noqa: ARG002
        return Layout((scalar("excitation_cycle"),))

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        del request, response
        table = sequence(self.cycles, len(self.amplitude), self.seed) * np.array(self.amplitude)
        cycle, grid = memory["excitation_cycle"], np.arange(self.cycles, dtype=float)
        added = ca.interpolant("excitation", "linear", [grid.tolist()], table.ravel().tolist())
        return desired + added(ca.fmin(cycle, self.cycles - 1)), {"excitation_cycle": cycle + 1}

    def effective_gain(self) -> float:
        return 1e-12  # nothing, of either sign; but without adaptation no loop passes its response on


@dataclass(frozen=True, eq=False)
class Record:
    """What was recorded, from the second cycle on."""

    measured: np.ndarray  # responses, shape (cycles - 1, n)
    modelled: np.ndarray  # the model's responses to the commands that acted
    usable: np.ndarray  # which cycles count: those with numbers
    shown: tuple[str, ...]  # what each response is a difference of, or itself where it is measured
    differences: tuple[int, ...]  # how often
    limited: np.ndarray  # share of the cycles in which each command stands at a limit
    room: np.ndarray  # amplitude of every response that goes half of the way between the limits of the inputs
    stop: str  # why the run ended early; empty where it did not
    amplitude: tuple[float, ...] = ()  # of the excitation of every response; empty: a recording


def _record(
    problem: Problem, where: str, times: np.ndarray, states: np.ndarray, commands: np.ndarray, seen: Mapping[str, np.ndarray],
    stop: str = "",
) -> Record:  # fmt: skip
    """The responses to the commands of the row before, beside the model's: differences of what is seen, late by no window."""
    plant = problem.plant
    require_cycles(len(times))
    still = np.ptp(commands, axis=0) <= 1e-9 * np.abs(commands).max(axis=0)  # NaN moves
    if still.any():
        one = f"the input '{list(plant.inputs)[int(np.argmax(still))]}' never changes, so nothing can be known of its gain"
        raise InvalidValue(f"{where}: {one}; let it step, leave it room within its limits, or check the model's sign")
    told, parameters = model_values(plant, problem.signals), plant.approximate
    known = parameters if told is None else told.map(len(times) - 1)(times[None, 1:], parameters)
    respond = lambda sent: np.array(plant.equations.controlled_response(states[1:].T, sent, known)).T  # noqa: E731
    modelled, bounds = respond(commands[:-1].T), problem.limits.input_bounds(plant)
    low, high = (respond(np.tile(np.clip(one, -1e100, 1e100)[:, None], len(times) - 1)) for one in bounds)
    measured, shown = np.full((len(times), len(plant.response_orders)), np.nan), list[str]()
    for column, (name, order) in zip(measured.T, plant.response_orders.items(), strict=True):
        shown.append(max((n for n in seen if n.rstrip("'") == name), key=len))
        missing = order - shown[-1].count("'")
        column[missing:] = np.diff(seen[shown[-1]], missing) / problem.period**missing
    differences = tuple(n - one.count("'") for n, one in zip(plant.response_orders.values(), shown, strict=True))
    both = pd.DataFrame(np.hstack([measured[1:], modelled])).replace([np.inf, -np.inf], np.nan)
    limited = np.isclose(commands, np.array(bounds)[:, None]).any(axis=0).mean(axis=0)
    room = np.median(np.abs(high - low), axis=0) / 4
    # What does not count passes through filters, as lines between what does.
    parts = np.hsplit(both.interpolate(limit_direction="both").fillna(0.0).to_numpy(), [measured.shape[1]])
    usable = both.notna().all(axis=1).to_numpy()
    return Record(parts[0], parts[1], usable, tuple(shown), differences, limited, room, stop)


def _preferred(first: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The first columns, and others of coordinates that these show nothing of."""
    known = {name.rstrip("'") for name in first}
    return {**first, **{name: column for name, column in other.items() if name.rstrip("'") not in known}}


def sequence(cycles: int, channels: int, seed: int) -> np.ndarray:
    """Return +-1, shape (cycles, channels), held for 1 to 16 cycles: power at all frequencies of interest; 0 in the end."""
    random, signs = np.random.default_rng(seed), np.zeros((cycles, channels))
    for j in range(channels):
        signs[:, j] = np.repeat(random.choice([-1.0, 1.0], cycles), random.choice((1, 2, 4, 8, 16), cycles))[:cycles]
    signs[-1] = 0
    return signs


def excited(
    problem: Problem, controller: Controller, cycles: int, amplitude: Mapping[str, float] | None, seed: int
) -> Record:
    """Return the record of a run without deformation, excited; amplitude None: twice the noise and a tenth of what is desired."""
    require_cycles(cycles)
    short, bare = replace(problem, duration=cycles * problem.period, measure_from=0.0), without_deformation(controller)

    def run_with(amplitude: tuple[float, ...]) -> tuple[Run, Record]:
        # All lateness is identified, the stated one too.
        at_once = ModelReferenced(Excitation(amplitude, cycles, seed), cycles=0.0, lag=0.0)
        run = simulate(short, bare.with_deformation(at_once), seed=seed, compiled=False)
        plant = problem.plant
        seen = dict(zip(response_names(plant), where_given(run, run["realised"]).T, strict=True))
        if problem.sensing.spreads(plant):
            measures = problem.sensing.measures(plant)
            seen = _preferred(dict(zip(measures, raw_measurements(run).T[-len(measures) :], strict=True)), seen)
        record = _record(problem, "probe", run.time, run["state"], run["command"], seen, run.stop or "")
        return run, replace(record, amplitude=amplitude)

    names = problem.plant.controlled_names
    if amplitude is not None:
        return run_with(tuple(float(amplitude.get(name, 0.0)) for name in names))[1]
    run, silent = run_with((0.0,) * len(names))
    rest = (np.asarray(run["realised"])[1:] - silent.modelled)[_BEGUN:]
    noise = np.median(np.abs(np.diff(rest, axis=0)), axis=0) / 0.6745
    sizes = _NOISES * noise / np.sqrt(2) + _SHARE * np.std(np.asarray(run["desired"])[_BEGUN:], axis=0)
    return run_with(tuple(map(float, sizes)))[1]


def read_recording(path: Path, problem: Problem) -> Record:
    """Return the record in a CSV file; a derivative without a column is the difference of the lower one over a cycle."""
    table = _table(path)
    plant, period, mistakes = problem.plant, problem.period, Mistakes(f"recording {path}")
    given = {str(name): column.to_numpy() for name, column in table.items()}
    for name in sorted(plant.state.elements, key=len):
        if name not in table and name.rstrip("'") != name and name[:-1] in table:
            table[name] = table[name[:-1]].diff() / period
    missing = [n for n in ("time", *plant.inputs, *plant.state.elements) if n not in table]
    if missing:
        mistakes.add(f"it lacks columns for {', '.join(missing)}; its columns are {', '.join(given)}")
    for name in {*plant.response_orders} - {n.rstrip("'") for n in given}:
        mistakes.add(f"it has no column '{name}', nor one of its derivatives")
    mistakes.raise_if_any()
    times = table["time"].to_numpy()
    for before, after in pairwise(times):
        if not abs(after - before - period) <= _EVEN * period:
            apart = f"its times are not {period:g} {problem.time_unit} apart, the period of the problem"
            raise InvalidValue(f"recording {path}: {apart}: {before:g} is followed by {after:g}")
    commands, states = (table[list(names)].to_numpy() for names in (plant.inputs, plant.state.elements))
    measures = problem.sensing.measures(plant)
    seen = _preferred({name: column for name, column in given.items() if name in measures}, given)
    return _record(problem, f"recording {path}", times, states, commands, seen)


def _table(path: Path) -> pd.DataFrame:
    """The numbers of a CSV file; an entry that is empty or not there is NaN."""
    try:
        table = pd.read_csv(path, comment="#", encoding="utf-8-sig", skipinitialspace=True).rename(columns=str.strip)
    except OSError as error:
        raise InvalidValue(f"recording '{path}' cannot be read: {error.strerror}") from None
    except ValueError as error:
        expected = "expected a line of names, such as time, and rows of as many numbers"
        raise InvalidValue(f"recording {path}: {expected}; {error}") from None
    numbers = table.apply(pd.to_numeric, errors="coerce").astype(float)
    for row, column in np.argwhere((numbers.isna() & table.notna()).to_numpy())[:1]:
        wrong = f"row {row + 1} of numbers has {table.iat[row, column]!r} for {table.columns[column]}"
        raise InvalidValue(f"recording {path}: {wrong}")
    return numbers
