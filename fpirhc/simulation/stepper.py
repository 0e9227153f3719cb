"""A controller stepped by hand: against real hardware, another simulator, or a test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isnan
from typing import NoReturn, Self

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.believed import plant_model
from fpirhc.controllers.contract import name_in_task
from fpirhc.controllers.gate import HELD, SKIPPED, named_memory
from fpirhc.controllers.live_settings import LiveSettings, Numbers, live_settings
from fpirhc.errors import ConcurrentUse, FpirhcError, InvalidName, InvalidValue, require
from fpirhc.fields.checked import ByName, Checked
from fpirhc.fields.kinds import named_entries
from fpirhc.simulation.machine import FINGERPRINT, machine_step
from fpirhc.simulation.replay import CLOCK_MEMORY, Bound, Replay, missed_cycles
from fpirhc.simulation.step_arguments import (
    NOT_WRITTEN,
    NOTHING,
    SetpointsNow,
    StepArguments,
    numbers_of,
    one_number,
    set_points_now,
)
from fpirhc.simulation.trials import warn_of_harm
from fpirhc.status import Status
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import unwrapped
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.native import native
from fpirhc.symbolic.open import settings_among
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem

_TRUTHS = (bool, np.bool_)
_NOT_SOLVED = "the compiled solver failed"


@dataclass(frozen=True, eq=False)
class ComposedStep:
    """The step of a controller that is composed, and not compiled."""

    settings: LiveSettings
    composite: Composite
    memory: Layout
    replay: Replay

    @property
    def function(self) -> ca.Function:
        """The step itself."""
        return self.composite.function

    @classmethod
    def of(
        cls,
        problem: Problem,
        controller: Controller,
        *,
        saturated_after: float = 1.0,
        bounded: bool = True,
        live: Sequence[str] = (),
        bridged: int | None = None,
    ) -> Self:
        """Return the step of a controller; arguments as of `Stepper`."""
        settings = live_settings(problem, controller, live)
        ready, planner = settings.controller, settings.controller.planner
        why = planner.optimiser.unbounded if bounded and planner is not None else ""
        require(not why, f"{why}; Stepper(..., bounded=False) accepts it away from a real plant")
        composite = settings.composed(lambda built: machine_step(problem, ready, built.step, saturated_after))
        return cls(settings, composite, named_memory(composite)[1], Replay.of(problem, composite, bridged))


class Stepper(Checked):
    """One controller, ready to be called once per control cycle.

        stepper = Stepper(problem, controller)
        memory = stepper.start()
        command, memory = stepper.step(time, state, realised, memory)

    All memory is in the argument: the same arguments give the same command. `trace()` returns every signal of the last step.

    A plant with outputs is measured by these, too, `step(..., output=...)`. Where the problem's sensing estimates state or
    response, the estimator is part of the step, which is given what the sensors show, in the order of `measures`:

        command, memory = stepper.step_measured(time, measured, memory)

    Where the outputs of a plant are estimated, its state stands before them, unless it is believed.

    A bad sample skips the cycle: one that is not finite or outside the range of its sensor. Give NaN for one that is too old. The
    command is the last one, the status is BAD_SAMPLE, the signal 'skipped' counts, and every memory stays as it was. With the
    next good sample the step runs once more for every missing cycle, on samples between those around the gap, with the status
    BRIDGED; after more than `bridged` cycles for the last ones alone, as many as fill the windows of estimators, with the
    status SETTLING. Cycles that the caller missed, by the times of two steps, are missing too. Before the first good sample
    the command is the one before the run. A sample for which the model has no number skips the cycle too, as NON_FINITE. So
    does a time that cannot follow the last one, as BAD_TIME (`fpirhc.simulation.replay`). A memory that is not finite is
    forgotten, and so is one with which good samples give nothing finite: the controller begins anew, with the status
    RESTARTED. Where a solver raises, the cycle is skipped with the status SOLVER_FAILED; `why_failed` has its words. A command
    at a limit for long has the status SATURATED.

    One stepper serves one thread. Two threads at the same time are refused; give each a stepper of its own.

    With live settings, `Stepper(problem, controller, live=["deformation.gain"])`, a step may change numbers without another build,
    `stepper.step(..., settings={"deformation.gain": -0.4})`. `numbers` are in force until the next change. Numbers that a setting
    does not accept are refused: the old ones stay, `refused` counts, and `why_refused` states the last reason. Restarts begin with
    the memory of the build, and SATURATED is judged by the limits of the build. Set-points of the reference change in the same way,
    `stepper.step(..., setpoints={"q1": 2.5})`, and need no live setting; `setpoints` are in force.

    `function` is the step itself, a CasADi Function (memory, each of `reads`) -> (memory, trace, command), for code generation of
    one's own. `reads`, `memory`, `signals`, `settings` and `parameters` are the layouts of what it takes and gives: names, units,
    and start values, which are the numbers of the build for parameters, settings and set-points. It has gate and watch
    inside; not inside are missed cycles, a solver that raises, and the check of settings (`bounds`).

    A controller that does better without its adaptation is warned of once, `HarmfulAdaptation`, after four runs of 300 cycles on
    the problem's plant and on its own model. `warnings.simplefilter("ignore", fpirhc.HarmfulAdaptation)` spares these runs.
    """

    def __init__(
        self,
        problem: Problem,
        controller: Controller,
        *,
        compiled: bool = True,
        saturated_after: float = 1.0,
        bounded: bool = True,
        live: Sequence[str] = (),
        bridged: int | None = None,
    ) -> None:
        """Compose the controller's Function, and compile it where `compiled` is set and there is a compiler.

        Args:
            saturated_after: time at a limit from which the status is SATURATED, s; in the plant's unit where that has no seconds.
            bounded: whether an optimiser whose call may take any time is refused.
            bridged: number of missing cycles up to which each of them is run afterwards; None: 5, or 20 behind differences of
                positions.
        """
        step = ComposedStep.of(
            problem, controller, saturated_after=saturated_after, bounded=bounded, live=live, bridged=bridged
        )
        self._bind(step, compiled=compiled)
        warn_of_harm(problem, controller)

    @classmethod
    def of(cls, step: ComposedStep, *, compiled: bool) -> Self:
        """Return the stepper of a step that is composed already; its user is not warned of harm."""
        own = cls.__new__(cls)
        own._bind(step, compiled=compiled)
        return own

    def _bind(self, step: ComposedStep, *, compiled: bool) -> None:
        """Compile the step, and bind its arguments."""
        problem, composite = step.settings.problem, step.composite
        self.memory = step.memory
        self.function: ca.Function = composite.function
        backend = native(self.function, required=bool(step.settings.paths)) if compiled else None
        self.compiled = bool(backend and backend.compiled)
        self.signals: Layout = composite.trace
        self.measures = problem.sampled  # names of the raw measurements
        self.why_failed = ""
        self._title = f"{problem.name or 'problem'}, {name_in_task(step.settings.unresolved)}"
        self._may_fail = composite.opaque  # scalar code cannot fail
        function = backend.function if backend else self.function
        model = plant_model(problem, step.settings.controller)
        parameters = model.parameters(model.plant)
        arguments = StepArguments(function, composite, problem, parameters)
        self._live, self._composite, self._arguments = step.settings, composite, arguments
        self.refused = 0  # number of changes that were refused
        self.why_refused = ""  # reason of the last change that was refused
        self._numbers = step.settings.start
        self._write(self._numbers)
        self.reads: Layout = composite.reads.starting_at(np.concatenate(arguments.evaluator.arguments[1:]))
        self.estimates, self.beside = arguments.estimates, arguments.beside
        self._tokens = [True]
        self._fingerprint = float(self.memory[FINGERPRINT].start[0])
        sample, a = arguments.sample, arguments
        self._bound = Bound(a.memory_before, a.memory_next, a.trace, sample, sample, sample["time"], sample["time"])
        # Attributes of the stepper itself are found faster in every step.
        self._evaluate = arguments.evaluator.evaluate
        self._time, self._state, self._realised = arguments.time, arguments.state, arguments.realised
        self._memory, self._command = arguments.memory, arguments.command
        self._new_command, self._new_memory = arguments.command_next.copy, arguments.memory_next.copy
        self._before, self._period = self.memory.slice(CLOCK_MEMORY.name).start, float(problem.period)
        self._skipped = self.memory.slice(f"{SKIPPED}_before").start
        self._counted = self.signals.slice(SKIPPED).start
        self._late, self.replay, self._missing = 1.5 * self._period, step.replay, step.replay.missing

    @property
    def parameters(self) -> Layout:
        """The parameters among `reads`, which start with those of the model; empty where none is read."""
        return Layout(tuple(s for s in self.reads.signals if s.name == "parameters"))

    def __repr__(self) -> str:
        backend = "compiled C" if self.compiled else "virtual machine"
        return f"Stepper({self._title}, {backend})"

    def start(self) -> np.ndarray:
        """Return the memory of the controller before its first cycle."""
        return self._composite.memory.start()

    def step(
        self,
        time: float,
        state: np.ndarray,
        realised: np.ndarray,
        memory: np.ndarray,
        *,
        output: np.ndarray | None = None,
        settings: Numbers | None = None,
        setpoints: SetpointsNow | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (command, memory for the next cycle).

        A sample that is not finite, or outside its sensor's range, skips the cycle: the command is the last one, in the first cycle
        `Problem.input_before`, by default 0 clipped to its limits; the status is BAD_SAMPLE, and `skipped` counts.

        Args:
            time: in the plant's unit of time.
            state: the measured state, shape (nx,). Where it is estimated, use `step_measured`.
            realised: the measured response of the controlled coordinates to the last command; any finite value in the first cycle,
                and for a controller that does not adapt.
            memory: from `start` or from the step before.
            output: the measured outputs and their derivatives of a plant that has outputs, as `Plant.output` lays them out. Where
                they are estimated, use `step_measured`.
            settings: numbers of live settings from this step on, by path. They are checked in Python before the
                step, which takes a tenth of a millisecond; see `change`.
            setpoints: set-points from this step on, by coordinate or output; see `set_reference`.

        Raises:
            InvalidValue: an argument of another size, or not made of numbers, named; the memory of another controller.
            InvalidField: settings or set-points that are no mapping of names.
            InvalidName: a setting that is not live; a coordinate without set-point.
            ConcurrentUse: another thread is inside this stepper.
        """
        # Taking the only token out of a list is atomic, and five times as fast as a lock.
        try:
            token = self._tokens.pop()
        except IndexError:
            _refuse_thread()
        try:
            if settings is not None or setpoints is not None or isinstance(time, _TRUTHS):
                self._take(time, settings, setpoints)
            try:
                if not (state.__class__ is realised.__class__ is memory.__class__ is np.ndarray):
                    raise TypeError  # masked arrays are arrays to a view
                self._time[0] = time
                self._state[:] = state
                self._realised[:] = realised
                self._memory[:] = memory
            except (TypeError, ValueError, OverflowError, NotImplementedError):
                self._arguments.accept(time, state, realised, memory, self.measures)
            if self._memory[0] != self._fingerprint:
                self._arguments.refuse_foreign_memory()
            if self.beside:
                self._arguments.output[:] = numbers_of("output", output, self.beside)
            failure = self._run()
            return self._failed(failure) if failure else (self._new_command(), self._new_memory())
        finally:
            self._tokens.append(token)

    def step_measured(
        self,
        time: float,
        measured: np.ndarray,
        memory: np.ndarray,
        *,
        settings: Numbers | None = None,
        setpoints: SetpointsNow | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (command, memory for the next cycle) from raw measurements.

        Args:
            time: in the plant's unit of time.
            measured: what the sensors show, in the order of `measures`; late by the dead time of the measurement, as it arrives.
            memory: from `start` or from the step before.
            settings, setpoints: as in `step`.

        Raises:
            FpirhcError: as in `step`.
        """
        if self.estimates and not self.beside:
            return self.step(time, measured, NOTHING, memory, settings=settings, setpoints=setpoints)
        column = numbers_of("measured", measured, len(self.measures))
        if self.estimates:
            seen, raw = np.split(column, [self.beside])
            return self.step(time, raw, NOTHING, memory, output=seen, settings=settings, setpoints=setpoints)
        state, seen, realised = np.split(column, [len(self._state), len(self._state) + self.beside])
        return self.step(time, state, realised, memory, output=seen, settings=settings, setpoints=setpoints)

    @property
    def skipped(self) -> int:
        """Number of skipped cycles since the start: the signal 'skipped' of the last step, without the others."""
        return int(self._arguments.trace[self._counted])

    def trace(self) -> dict[str, np.ndarray]:
        """Return every signal of the last step by name.

        In a skipped cycle 'command', 'status' and 'skipped' are those that hold; the others are those of the step that was dropped.

        Raises:
            ConcurrentUse: another thread is inside this stepper.
        """
        try:
            token = self._tokens.pop()
        except IndexError:
            _refuse_thread()
        try:
            trace = self.signals.unpack(self._arguments.trace)
            return ByName({name: value.copy() for name, value in trace.items()}, "Stepper.trace()")
        finally:
            self._tokens.append(token)

    def change(self, settings: Numbers) -> bool:
        """Put numbers of live settings in force from the next step on, by path, and return whether they were accepted.

        Raises:
            InvalidName: a setting that is not live.
        """
        if not named_entries("settings", settings):
            return True
        try:
            _, _, numbers = self._live.changed({**self._numbers, **self._live.flat(settings)})
            self._write(numbers)
        except InvalidName:
            raise
        except FpirhcError as error:
            return self._refuse(error)
        self._numbers = numbers
        return True

    def set_reference(self, setpoints: SetpointsNow) -> bool:
        """Put set-points in force from the next step on, by coordinate or output, and return whether they were accepted.

        A set-point that is not finite, or outside the range or the limits of its state, is refused with all others of the call: the
        old ones stay, `refused` counts, and `why_refused` states the reason.

        Raises:
            InvalidName: a coordinate without set-point.
        """
        if not named_entries("setpoints", setpoints):
            return True
        try:
            row = set_points_now(self._live.problem, setpoints, self._arguments.setpoints)
        except InvalidValue as error:
            return self._refuse(error)
        self._arguments.setpoints[:] = row
        return True

    @property
    def settings(self) -> Layout:
        """The vector of the live settings among `reads`, 'settings'; an element is a path."""
        return Layout(settings_among([self._composite.reads]))

    def bounds(self) -> dict[str, Interval]:
        """Return for each live setting the interval of the numbers that a device without Python may accept, by path.

        It is the interval around the number of the build in which the setting is accepted while the others stay, found by trials of
        Python's own check, to a millionth of the number. A limit of an input ends at that of the build; infinite ends refuse
        nothing.
        """
        return ByName(self._live.bounds, "Stepper.bounds()")

    @property
    def numbers(self) -> dict[str, float]:
        """The live settings in force, by path."""
        return ByName(self._numbers, "Stepper.numbers")

    @property
    def setpoints(self) -> dict[str, float]:
        """The set-points in force, by coordinate or output."""
        values = zip(self._live.problem.plant.chains, self._arguments.setpoints.tolist(), strict=False)
        return ByName(dict(values), "Stepper.setpoints")

    def _write(self, numbers: Mapping[str, float]) -> None:
        for signal in self.settings.signals:
            self._arguments.sample[signal.name][:] = list(numbers.values())

    def _refuse(self, error: FpirhcError) -> bool:
        self.refused, self.why_refused = self.refused + 1, str(error)
        return False

    def _take(self, time: object, settings: Numbers | None, setpoints: SetpointsNow | None) -> None:
        """Put numbers in force, and refuse a truth value as time."""
        if settings is not None:
            self.change(settings)
        if setpoints is not None:
            self.set_reference(setpoints)
        if isinstance(time, _TRUTHS):
            one_number("time", time)

    def _run(self) -> str:
        """Evaluate the step, and before it those of missed cycles; return why it failed, empty where it did not."""
        try:
            if self._time[0] - self._memory[self._before] > self._late:
                self._count(missed_cycles(self._time[0], self._memory[self._before], self._period))
            missing = self._memory[self._missing]
            why = self._solve()
            return self.replay.after(self._bound, self._solve) if missing > 0 and not why else why
        except (RuntimeError, SystemError) as error:
            cause = unwrapped(error)
            if not isinstance(cause, RuntimeError):
                raise cause from None
            return str(error) or "a solver raised"

    def _solve(self) -> str:
        if self._may_fail:
            self._command[0] = NOT_WRITTEN
        self._evaluate()
        return _NOT_SOLVED if self._may_fail and isnan(self._command[0]) else ""

    def _count(self, missed: int) -> None:
        """Count the cycles that the caller missed: none has a sample."""
        self._memory[self._skipped] += missed
        self._memory[self._before] = self._time[0] - self._period if missed else self._memory[self._before]
        if self._memory[self._missing] > -0.5:
            self._memory[self._missing] += missed

    def _failed(self, why: str) -> tuple[np.ndarray, np.ndarray]:
        """The last command and the memory as it was, after a solver that raised or failed.

        The next step finds the times of this cycle and of those before it that failed missing, steps over them, and counts them;
        without any this cycle is counted now.
        """
        self.why_failed, a = why, self._arguments
        missing = missed_cycles(self._time[0] + self._period, self._memory[self._before], self._period)
        memory = np.where(np.isfinite(a.memory_before), a.memory_before, self.memory.start())
        command = memory[self.memory.slice(HELD)].copy()
        memory[self._skipped] += not missing
        a.trace[self.signals.slice("status")] = int(Status.SOLVER_FAILED)
        a.trace[self.signals.slice("command")] = command
        a.trace[self._counted] = memory[self._skipped] + missing
        return command, memory


def _refuse_thread() -> NoReturn:
    raise ConcurrentUse("this Stepper is in use by another thread: one stepper serves one thread, build one for each")
