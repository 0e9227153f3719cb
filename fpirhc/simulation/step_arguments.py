"""Arguments and results of a step: where its Function reads and writes them, and what is accepted as such.

A view takes arrays of float64 of its own shape and nothing else; numpy's assignment broadcasts, and is slower.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isnan
from typing import Protocol, cast

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidName, InvalidValue, nearest
from fpirhc.fields.kinds import described, named_entries, real_number
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.checks import check_values
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Steps, in_force, pairs

Setpoints = Mapping[str, Steps]  # by coordinate: a number, or pairs (time, set-point)
SetpointsNow = Mapping[str, float]  # by coordinate


def set_point_table(problem: Problem, setpoints: Setpoints | None, cycles: int) -> np.ndarray:
    """Return what the reference is given in every cycle, shape (cycles, entries); no entries for a reference without set-points."""
    signals, steps = problem.given_signals, _steps(problem, setpoints)
    if not signals:
        return np.zeros((cycles, 0))
    times = np.arange(cycles) * problem.period
    columns = {n: in_force(pairs(n, steps[n]), times, problem.period) for n in problem.plant.chains}
    check_values(problem.plant, problem.limits, {n: c.tolist() for n, c in columns.items()})
    return np.stack([*columns.values()], axis=1)


def set_point_record(problem: Problem, setpoints: Setpoints | None) -> dict[str, object]:
    """Return the set-points of a run as plain data: [[time, set-point], ...] by coordinate."""
    return {n: [list(pair) for pair in pairs(n, steps)] for n, steps in _steps(problem, setpoints).items()}


def set_points_now(problem: Problem, setpoints: SetpointsNow, before: np.ndarray) -> np.ndarray:
    """Return the row of one step: `before` with other set-points of some coordinates, shape (entries,)."""
    _check_names(problem, setpoints)
    row = dict(zip(problem.plant.chains, before.tolist(), strict=True))
    for name, value in setpoints.items():
        number = real_number(value)
        if number is None:
            raise InvalidValue(f"set-point of '{name}': expected a number, got {described(value)}")
        row[name] = number
    check_values(problem.plant, problem.limits, {name: [row[name]] for name in setpoints})
    return np.array([*row.values()])


def _steps(problem: Problem, setpoints: Setpoints | None) -> Setpoints:
    changed = {} if setpoints is None else setpoints
    _check_names(problem, changed)
    return {**problem.reference.set_points, **changed}


def _check_names(problem: Problem, setpoints: Mapping[str, object]) -> None:
    known = problem.reference.set_points
    for name in named_entries("setpoints", setpoints):
        if not known:
            raise InvalidName(
                f"set-point '{name}': the reference of the problem, a {type(problem.reference).__name__}, has no set-points; "
                "use fp.Setpoint(...) in the problem file"
            )
        if name not in known:
            raise InvalidName(f"set-point '{name}' is unknown.{nearest(str(name), known)}")


NOTHING = np.zeros(0)
NOT_WRITTEN = float("nan")  # the gate's command is finite: what is still NaN was not written


class View(Protocol):
    """A memoryview of float64 as it is used here; its stub has views of bytes only."""

    def __getitem__(self, k: int) -> float: ...
    def __setitem__(self, k: int | slice, value: object) -> None: ...
    def __len__(self) -> int: ...


class StepArguments:
    """The arguments and results of one step's Function, bound once for all steps.

    Attributes:
        evaluator: of the Function.
        setpoints: argument of the set-points; no entries without any.
        time, memory, state, realised, output, command: views; `state` is that of the raw measurements where they are read.
        memory_before, memory_next, trace, command_next: arrays of the memory that is read, and of what is written.
        estimates: whether the step begins with raw measurements.
        beside: number of entries of `output`, which are read beside the sample: measured outputs, or the state where the sample is
            that of estimated outputs; 0 without any.
        sample: arguments by name.
    """

    def __init__(self, function: ca.Function, composite: Composite, problem: Problem, parameters: np.ndarray) -> None:
        """Bind the Function of a composite."""
        self.evaluator = Evaluator(function)
        arguments = dict(zip(function.name_in(), self.evaluator.arguments, strict=True))
        arguments["parameters"][:] = parameters
        self.sample = arguments
        places = {name: k + 1 for k, name in enumerate(composite.reads.names)}  # after the memory
        self.setpoints = np.zeros(0)
        for signal in problem.given_signals:
            self.setpoints = self.evaluator.arguments[places[signal.name]]
            self.setpoints[:] = signal.start_vector()
        self.memory_next, self.trace, self.command_next = self.evaluator.results
        self.estimates, every = problem.sensing.estimates, [signal.name for signal in problem.sample]
        beside, sample = (every[:-1], every[-1:]) if self.estimates else (every[1:-1], [every[0], every[-1]])
        self.output = _view(arguments[beside[0]] if beside else NOTHING)
        self.beside = len(self.output)
        self.memory, self.time, self.state, *rest = (_view(arguments[n]) for n in ("memory", "time", *sample))
        self.realised = rest[0] if rest else _view(NOTHING)
        self.memory_before = arguments["memory"]
        self.command = _view(self.command_next)

    def accept(self, time: object, state: object, realised: object, memory: object, measures: tuple[str, ...]) -> None:
        """Take arguments that are no arrays of float64, or say what is wrong with them."""
        if self.estimates and np.size(cast(float, realised)):
            raise InvalidValue(
                f"this controller estimates its state and response from {', '.join(measures)}: use "
                "step_measured(time, measured, memory) with these, in this order"
            )
        values = {"measured" if self.estimates else "state": (self.state, state), "memory": (self.memory, memory)}
        if not self.estimates:
            values["realised"] = (self.realised, realised)
        checked_values = {name: numbers_of(name, value, len(view)) for name, (view, value) in values.items()}
        self.time[0] = one_number("time", time)
        for name, (view, _) in values.items():
            view[:] = checked_values[name]

    def refuse_foreign_memory(self) -> None:
        """Raise for a memory with another fingerprint; a memory of NaN is a restart."""
        if isnan(self.memory[0]):
            return
        raise InvalidValue(
            "argument 'memory' is not this controller's: it comes from another controller, another problem, or other settings; "
            "begin with start()"
        )


def _view(array: np.ndarray) -> View:
    return cast(View, memoryview(array.data))


def numbers_of(name: str, value: object, size: int) -> np.ndarray:
    """Return `value` as float64, shape (size,)."""
    if isinstance(value, np.ma.MaskedArray):
        raise InvalidValue(f"argument '{name}' is a masked array; {name}.filled(np.nan) skips the cycle")
    if isinstance(value, list | tuple) and any(isinstance(v, bool | np.bool_) for v in value):
        raise InvalidValue(f"argument '{name}' must be real numbers, got {described(value)} with a truth value")
    try:
        array = np.asarray(value)
    except Exception:  # noqa: BLE001 -- rows of different lengths; an object of a stranger's that raises where numpy asks it
        raise InvalidValue(f"argument '{name}' is not made of numbers, got {described(value)}") from None
    if array.dtype.kind == "O":
        raise InvalidValue(f"argument '{name}' is not made of numbers, got {described(value)}; expected {size} numbers")
    if array.dtype.kind not in "fiu":
        raise InvalidValue(f"argument '{name}' must be real numbers, got {described(value)} of type '{array.dtype}'")
    if array.size != size or sum(n != 1 for n in array.shape) > 1 or array.ndim == 0:
        raise InvalidValue(f"argument '{name}' has {size} entries (shape ({size},)), got shape {array.shape}")
    return np.ascontiguousarray(array.ravel(), dtype=np.float64)


def one_number(name: str, value: object) -> float:
    """Return `value` as a float."""
    number = real_number(value)
    if number is None:
        raise InvalidValue(f"argument '{name}' must be a number of seconds, got {described(value)}")
    return number
