"""Arguments and results of a step: where its Function reads and writes them, and what is accepted as such.

A view takes arrays of float64 of its own shape and nothing else; numpy's assignment broadcasts, and is slower.
"""

from __future__ import annotations

from math import isnan
from typing import Protocol, cast

import casadi as ca
import numpy as np

from fpirhc.controllers.face import measured_signals
from fpirhc.controllers.gate import HELD
from fpirhc.controllers.own_reference import given_signals
from fpirhc.controllers.seeing import given_states, raw_signal
from fpirhc.errors import InvalidShape, InvalidValue
from fpirhc.simulation.machine import SKIPPED
from fpirhc.simulation.sample import numbers as numbers_of
from fpirhc.simulation.sample import one_number
from fpirhc.status import Status
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.layout import Layout
from fpirhc.task.problem import Problem

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
        settings: arguments of the live settings and derived numbers, by the name of their signal.
        setpoints: argument of the set-points; no entries without any.
        time, memory, state, realised, output, taken, command: views; `state` is that of the raw measurements where they are read.
        memory_before, memory_next, trace, command_next: arrays of the memory that is read, and of what is written.
        estimates: whether the step begins with raw measurements.
        beside: number of entries of `output`, which are read beside the sample: measured outputs, or the state where the sample is
            that of estimated outputs; 0 without any.
        ages: whether the time stamp of the sample is read.
    """

    def __init__(
        self, function: ca.Function, composite: Composite, problem: Problem, parameters: np.ndarray, *, ages: bool
    ) -> None:
        """Bind the Function of a composite."""
        self.ages = ages
        self.evaluator = Evaluator(function)
        arguments = dict(zip(function.name_in(), self.evaluator.arguments, strict=True))
        arguments["parameters"][:] = parameters
        places = {name: k + 1 for k, name in enumerate(composite.reads.names)}  # after the memory
        self.settings = {name: self.evaluator.arguments[places[name]] for name in composite.settings.names}
        self.setpoints = np.zeros(0)
        for signal in given_signals(problem):
            self.setpoints = self.evaluator.arguments[places[signal.name]]
            self.setpoints[:] = signal.start_vector()
        self.memory_next, self.trace, self.command_next = self.evaluator.results
        raw = raw_signal(problem)
        self.estimates = raw is not None
        beside = given_states(problem) if self.estimates else measured_signals(problem.plant)[1:]
        self.beside = sum(signal.size for signal in beside)
        self.output = _view(arguments[beside[0].name] if beside else NOTHING)
        sample = ("state", "realised") if raw is None else (raw.name,)
        self.memory, self.time, self.state, *rest = (_view(arguments[n]) for n in ("memory", "time", *sample))
        self.realised = rest[0] if rest else _view(NOTHING)
        self.memory_before = arguments["memory"]
        self.taken = _view(arguments["taken"]) if ages else self.time
        self.command = _view(self.command_next)

    def accept(self, time: object, state: object, realised: object, memory: object, measures: tuple[str, ...]) -> None:
        """Take arguments that are no arrays of float64, or say what is wrong with them.

        Raises:
            InvalidShape: a wrong number of entries, named; `measures` are the names of the raw measurements.
            InvalidValue: an argument that is not made of numbers.
        """
        if self.estimates and np.size(cast(float, realised)):
            raise InvalidShape(
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

    def take_more(self, time: float, taken: float | None, output: np.ndarray | None) -> None:
        """Take the time stamp of the sample, and measured outputs or the state beside them, where the step reads them."""
        if self.ages:
            self.taken[0] = one_number("taken", time if taken is None else taken)
        if self.beside:
            self.output[:] = numbers_of("output", output, self.beside)

    def hold(self, layout: Layout, signals: Layout, missing: int) -> np.ndarray:
        """Return the memory of a skipped cycle, and write status, command and count of it into the trace.

        Args:
            layout: of the memory.
            signals: of the trace.
            missing: number of cycles that the next step will count as skipped; 0: this cycle is counted now.
        """
        memory = np.where(np.isfinite(self.memory_before), self.memory_before, layout.start())
        self.trace[signals.slice("status")] = int(Status.SOLVER_FAILED)
        self.trace[signals.slice("command")] = memory[layout.slice(HELD)]
        memory[layout.slice(f"{SKIPPED}_before")] += not missing
        self.trace[signals.slice(SKIPPED)] = memory[layout.slice(f"{SKIPPED}_before")] + missing
        return memory

    def refuse_foreign_memory(self) -> None:
        """Raise for a memory with another fingerprint; a memory of NaN is a restart.

        Raises:
            InvalidValue: the memory of another controller.
        """
        if isnan(self.memory[0]):
            return
        raise InvalidValue(
            "argument 'memory' is not this controller's: it comes from another controller, another problem, or other settings; "
            "begin with start()"
        )


def _view(array: np.ndarray) -> View:
    return cast(View, memoryview(array.data))
