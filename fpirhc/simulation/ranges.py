"""What ends a run: physical ranges of states, errors that ran away, signals that are not finite; and how it kept its hard limits.

A level below zero is a run that no plant would make. An error of a million times the reference is no result of a controller.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from fpirhc.horizon.cost import view_of
from fpirhc.plant.motion import with_space
from fpirhc.simulation.run import Run
from fpirhc.status import STOPPED, Status
from fpirhc.summary import in_percent, number
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.layout import Layout
from fpirhc.task.problem import Problem

_RUNAWAY = 1e6  # times the largest value of the reference, or of the start
_INSTANTS, _MANY = 200, 2000  # of the reference
_MOTIONS: Latest[np.ndarray] = Latest(4)  # of references
_ERRORS = ("true_error", "error")  # where they are logged: the first that a run has
# where the moving state is logged: the first that a run has
_SIGNALS = ("foreign", "reality_state", "plant_state", "state")
_DIVERGED = 1e100  # size of numbers that no loop but a diverging one has


class Range(NamedTuple):
    """Where a logged number must be, and what is said of one that is not."""

    column: int  # of the log
    lower: float
    upper: float
    words: tuple[str, str]  # before and behind a number that is outside


class Ranges:
    """What ends a run: the physical ranges of what moves, and errors beyond all sense; one absurd sample of a body is none."""

    def __init__(self, problem: Problem, trace: Layout, more: Sequence[Range] = ()) -> None:
        every = [*_of_states(problem, trace), *(_of_errors(problem, trace) if problem.moves.simulated else ()), *more]
        self.columns = np.array([one.column for one in every], dtype=int)
        self.lower, self.upper = np.array([one.lower for one in every]), np.array([one.upper for one in every])
        self._words = [one.words for one in every]

    def first_outside(self, rows: np.ndarray) -> tuple[int, str] | None:
        """Return the first row of a log in which a number is outside, and which one; None where all are inside."""
        values = rows[:, self.columns]
        outside = (values < self.lower) | (values > self.upper)
        if not outside.any():
            return None
        row = int(np.argmax(outside.any(axis=1)))
        k = int(np.argmax(outside[row]))
        before, behind = self._words[k]
        return row, f"{before} {number(values[row, k])} {behind}"


def _of_states(problem: Problem, trace: Layout) -> Iterator[Range]:
    signal = trace[next(name for name in _SIGNALS if name in trace)]
    first = trace.slice(signal.name).start
    for name, (low, high) in problem.real_plant.ranges.items():
        if name in signal.elements:
            k = signal.elements.index(name)
            unit = signal.entry_units[k]
            behind = f"{unit}, outside its physical range of {low:g} to {high:g} {unit}"
            yield Range(first + k, low, high, (f"state '{name}' is", behind))


def _of_errors(problem: Problem, trace: Layout) -> Iterator[Range]:
    """Errors that no reference explains: the loop has run away, whatever its signals still are."""
    signal = trace[next(name for name in _ERRORS if name in trace)]
    plant, first = problem.plant, trace.slice(signal.name).start
    function = problem.reference.function(plant)

    def moved() -> np.ndarray:
        times = np.linspace(0.0, problem.duration, _INSTANTS)
        return np.asarray(function.map(_INSTANTS)(times[None, :])[0].full())

    motion = _MOTIONS.of((function,), (problem.duration,), moved)
    for k, (name, unit) in enumerate(zip(signal.elements, signal.entry_units, strict=True)):
        row = plant.output.elements.index(name)
        along = np.append(motion[row], problem.start_output[row])
        size = float(np.abs(along[np.isfinite(along)]).max(initial=0.0))
        if size > 0:
            behind = f"{unit}, more than a million times the {number(size)} {unit} of its reference and start"
            yield Range(first + k, -_RUNAWAY * size, _RUNAWAY * size, (f"the error of '{name}' is", behind))


class Dropped:
    """The rows of a log, and what ends a run in them: signals that are not finite, and numbers beyond all sense.

    What a controller computes in a cycle of status NON_FINITE reaches neither the plant nor its memory: that step was dropped, what
    it logged shows its last finite values, and the run goes on.
    """

    def __init__(self, loop: Composite) -> None:
        """Find the columns that the step behind the gate writes."""
        traces: list[Layout] = [block.inside.trace for block in loop.blocks if block.inside is not None]
        names = {name for trace in traces for name in trace.names} & set(loop.trace.names)
        self._own, self._columns = np.zeros(loop.trace.size, dtype=bool), loop.trace.columns
        for name in names - {STOPPED}:
            self._own[loop.trace.slice(name)] = True
        self._status = loop.trace.slice("status").start if "status" in names else None

    def first_bad(self, rows: np.ndarray, before: np.ndarray | None) -> tuple[int, str] | None:
        """Return row and signal of the first value that ends a run, in words; None where there is none.

        What is not finite in dropped steps gets the value of the row before, in place.

        Args:
            rows: of the log, shape (cycles, columns).
            before: the row before the first; None: there is none, and zeros are shown.
        """
        # A sum is finite only if every summand is, and it is fast; where it is not, the entries are checked one by one.
        with np.errstate(all="ignore"):
            if abs(np.sum(rows)) < _DIVERGED:
                return None
        for k, row in enumerate(rows):
            bad = ~np.isfinite(row)
            dropped = self._status is not None and row[self._status] == int(Status.NON_FINITE)
            if dropped and not (np.abs(row[~bad]) > _DIVERGED).any() and not (bad & ~self._own).any():
                last = rows[k - 1] if k else before
                row[bad] = 0.0 if last is None else last[bad]
            elif dropped or bad.any():
                worst = np.argmax(bad) if bad.any() else np.argmax(np.abs(row))
                return k, f"signal '{self._columns[worst]}' is not finite"
        return None


TOLERANCE = 1e-3  # of its range: a run that is further beyond has left a limit


@dataclass(frozen=True, eq=False)
class Followed:
    """One hard limit along a run."""

    name: str
    unit: str
    lower: float
    upper: float
    values: np.ndarray  # of the limited quantity in every cycle

    @property
    def beyond(self) -> np.ndarray:
        """How far every cycle is beyond it, as a share of its range; of one side's own size, and beside 0 of the value's."""
        span, size = self.upper - self.lower, abs(self.upper if np.isfinite(self.upper) else self.lower)
        largest = float(np.abs(self.values).max(initial=1e-300))
        room = span if np.isfinite(span) else size if size > 1e-3 * largest else largest
        return np.maximum(np.maximum(self.values - self.upper, self.lower - self.values), 0.0) / room

    @property
    def sentence(self) -> str:
        """How far it is left, and how often."""
        unit, worst = with_space(self.unit), float(self.values[self.beyond.argmax()])
        limit = number(self.upper if worst > self.upper else self.lower)
        share = in_percent(float((self.beyond > TOLERANCE).mean()))
        return f"{self.name} reaches {number(worst)}{unit}, beyond its hard limit of {limit}{unit}, in {share} of the cycles"


def hard_limits(problem: Problem, run: Run) -> list[Followed]:
    """Return the limits of states, rates and paths that have no price, along a run; none without cycles.

    A change of the command counts from cycle to cycle. Limits of states that a reality does not have are not known.
    """
    plant, weighed = problem.plant, problem.limits.prices.keys()
    limits = {**problem.limits.boxes(plant), **problem.limits.written(plant, problem.period)}
    rates = {f"{name} rate": name for name in problem.limits.rates}
    hard = {name: one for name, one in limits.items() if not {name, rates.get(name, name)} & weighed}
    if not hard or not run.cycles:
        return []
    shown = run.layout["plant_state"].elements if "plant_state" in run.layout else ()
    unknown = np.full(run.cycles, np.nan)
    states = np.column_stack([run[f"plant_state.{n}"] if n in shown else unknown for n in plant.state.elements])
    x, u, p = (ca.SX.sym(one.name, one.size) for one in (plant.state, plant.input, plant.parameter))
    before, t = ca.SX.sym("before", plant.input.size), ca.SX.sym("t")
    view = view_of(plant, x, u, p, t, before=before)
    column = ca.vertcat(*(one.named_value(name, view) for name, one in hard.items()))
    sent = run["command"].reshape(run.cycles, -1)
    past = np.vstack([problem.inputs_before, sent[:-1]])
    given = states, sent, past, np.tile(plant.approximate, (run.cycles, 1)), run["time"].reshape(-1, 1)
    along = ca.Function("fpirhc_limited", [x, u, before, p, t], [column]).map(run.cycles)(*(g.T for g in given)).full()
    pairs = zip(hard.items(), along, strict=True)
    return [Followed(n, one.unit, one.lower, one.upper, v) for (n, one), v in pairs if not np.isnan(v).all()]


def input_limits(problem: Problem, run: Run) -> list[Followed]:
    """Return the limits of inputs along a run, which every command keeps."""
    ends = zip(problem.plant.inputs.items(), *problem.limits.input_bounds(problem.plant), strict=True)
    return [Followed(n, unit, float(low), float(high), run[f"command.{n}"]) for (n, unit), low, high in ends]


def limits_left(limits: Sequence[Followed]) -> tuple[Followed, ...]:
    """Return those limits that are left by more than the tolerance, the worst first."""
    worst = {one: float(one.beyond.max(initial=0.0)) for one in limits}
    return tuple(sorted((one for one in worst if worst[one] > TOLERANCE), key=lambda one: -worst[one]))


def misplaced(problem: Problem) -> list[str]:
    """Return which states start, or have a reference, outside their hard limits, in words."""
    plant, times, found = problem.plant, np.linspace(0.0, problem.duration, _MANY), list[str]()
    along = problem.reference.function(plant).map(_MANY)(times[None, :])[0].full()
    for at, (name, place) in enumerate(zip(plant.state.elements, plant.equations.known_by_outputs, strict=True)):
        low, high = problem.limits.states.get(name, (-np.inf, np.inf))
        unit, wanted = with_space(plant.state.units[at]), along[place] if place >= 0 else np.zeros(0)
        for what, values in ("start", problem.start_state[[at]]), ("reference", wanted[np.isfinite(wanted)]):
            beyond = Followed(name, unit, low, high, values).beyond
            if name not in problem.limits.prices and beyond.max(initial=0.0) > TOLERANCE:
                worst = f"{number(values[beyond.argmax()])}{unit}"
                found.append(
                    f"the {what} of {name} is {worst}, outside its hard limits of {number(low)} and {number(high)}{unit}"
                )
    return found
