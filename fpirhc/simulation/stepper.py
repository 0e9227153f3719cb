"""A controller stepped by hand: against real hardware, another simulator, or a test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isnan
from typing import NoReturn, Protocol, cast

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import checked
from fpirhc.controllers.face import measured_signals
from fpirhc.controllers.gate import HELD, Gate
from fpirhc.controllers.live_settings import LiveSettings, Numbers, live_settings
from fpirhc.controllers.own_reference import given_signals
from fpirhc.controllers.plausible import plausible_range
from fpirhc.controllers.seeing import compose_seeing, given_states, raw_signal
from fpirhc.errors import ConcurrentUse, FpirhcError, InvalidName, InvalidShape, InvalidValue, NotSupported
from fpirhc.sensing.base import names_of_responses
from fpirhc.simulation.machine import FINGERPRINT, SKIPPED, Watch, machine_step
from fpirhc.simulation.sample import numbers as numbers_of
from fpirhc.simulation.sample import one_number
from fpirhc.simulation.set_points import SetpointsNow, set_points_now
from fpirhc.status import Status
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.live import PREFIX
from fpirhc.symbolic.native import native
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem


class _View(Protocol):
    """A memoryview of float64 as it is used here; its stub has views of bytes only."""

    def __getitem__(self, k: int) -> float: ...
    def __setitem__(self, k: int | slice, value: object) -> None: ...
    def __len__(self) -> int: ...


class Stepper:
    """One controller, ready to be called once per control cycle.

        stepper = Stepper(problem, controller)
        memory = stepper.start()
        command, memory = stepper.step(time, state, realised, memory)

    All memory is in the argument: the same arguments give the same command. `trace()` returns every signal of the last step.

    Where the problem's sensing estimates state or response, the estimator is part of the step, which is given what the sensors
    show, in the order of `measures`:

        command, memory = stepper.step_measured(time, measured, memory)

    Of a plant with outputs raw measurements are those of the outputs; the state stands before them, unless it is believed.

    A bad sample skips the cycle: one that is not finite, outside its plausible range, or (with `max_age`) out of date. The command
    is the last one, every memory stays as it was, the status is BAD_SAMPLE, and the signal 'skipped' counts. Before the first good
    sample the command is the one before the run. A memory that is not finite is forgotten: the controller begins anew, with the
    status RESTARTED. Where a solver raises, the cycle is skipped with the status SOLVER_FAILED; `why_failed` has its words.
    Commands at a limit for long and an iteration that does not contract have the statuses SATURATED and NOT_CONTRACTING.

    One stepper serves one thread. Two threads at the same time are refused; give each a stepper of its own.

    With live settings, `Stepper(problem, controller, live=["deformation.gain"])`, a step may change numbers without another build,
    `stepper.step(..., settings={"deformation.gain": -0.4})`. `numbers` are in force until the next change. Numbers that a setting
    does not accept are refused: the old ones stay, `refused` counts, and `why_refused` states the last reason. Restarts begin with
    the memory of the build, and SATURATED is judged by the limits of the build.
    """

    def __init__(
        self,
        problem: Problem,
        controller: Controller,
        *,
        compiled: bool = True,
        plausible: Mapping[str, Interval] | None = None,
        max_age: float | None = None,
        watch: Watch | None = None,
        bounded: bool = True,
        live: Sequence[str] = (),
    ) -> None:
        """Compose the controller's Function, and compile it where `compiled` is set and there is a compiler.

        Args:
            problem: the task.
            controller: its automatic settings are chosen here.
            compiled: whether it is compiled to C.
            plausible: intervals (lower, upper) by name of a state ("q1", "q1'") or response ("q1''"), which replace the automatic
                ones (see `fpirhc.controllers.plausible`).
            max_age: oldest sample that is used, s; the time stamps of samples must then increase. None: they are not looked at.
            watch: when SATURATED and NOT_CONTRACTING are reported; None: after 1 s, and over 50 cycles.
            bounded: whether an optimiser whose call may take any time is refused.
            live: paths of the live settings.

        Raises:
            InvalidProblem: an unknown name or a wrong interval in `plausible`.
            InvalidName: a live setting that does not exist.
            NotSupported: an optimiser without a bound of its time; a setting that cannot be live.
            CompileError: the compiler fails on a controller with live settings.
        """
        self._live = live_settings(problem, controller, live)
        ready = checked(problem, self._live.controller)
        if bounded:
            _refuse_unbounded(ready)
        plausible_ranges = plausible_range(problem, plausible)
        self._composite, self.memory = _composed(self._live, ready, plausible_ranges, max_age, watch or Watch())
        backend = native(self._composite.function, required=bool(live)) if compiled else None
        self.compiled = bool(backend and backend.compiled)
        self.signals: Layout = self._composite.trace
        self.why_failed = ""
        self._ages = max_age is not None
        self._may_fail = self._composite.opaque  # scalar code cannot fail
        self._bind(
            backend.function if backend else self._composite.function, ready.parameters(ready.model_plant(problem))
        )
        self.measures = _measures(problem, ready)  # names of the raw measurements
        self.refused, self.why_refused = 0, ""
        self.numbers: dict[str, float] = self._live.start
        self._force(self.numbers)

    def start(self) -> np.ndarray:
        """Return the memory of the controller before its first cycle, with the settings in force."""
        remembered = self._composite.derived(self.numbers).memory() if self.numbers else {}
        return self._composite.memory.pack(remembered)

    def step(
        self,
        time: float,
        state: np.ndarray,
        realised: np.ndarray,
        memory: np.ndarray,
        *,
        output: np.ndarray | None = None,
        taken: float | None = None,
        settings: Numbers | None = None,
        setpoints: SetpointsNow | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (command, memory for the next cycle).

        Args:
            time: s.
            state: the measured state, shape (nx,). Where it is estimated, use `step_measured`.
            realised: the measured response of the controlled coordinates to the last command; any finite value in the first cycle,
                and for a controller that does not adapt.
            memory: from `start` or from the step before.
            output: the measured outputs and their derivatives of a plant that has outputs, as `Plant.output` lays them out. Where
                they are estimated, use `step_measured`.
            taken: time stamp of the sample, s; None: it was taken at `time`. Read with `max_age` only.
            settings: numbers of live settings from this step on, by path. Checks and derived numbers are computed in Python before
                 the step, a tenth of a millisecond for gains and some tens for the weights of a horizon; see `change`.
            setpoints: set-points from this step on, by coordinate: a number, or where they are announced one number per node of the
                 horizon; see `aim`.

        Raises:
            InvalidShape: a wrong number of entries, named.
            InvalidValue: an argument that is not made of numbers, or the memory of another controller.
            InvalidName: a setting that is not live; a coordinate without set-point.
            ConcurrentUse: another thread is inside this stepper.
        """
        # Taking the only token out of a list is atomic, and five times as fast as a lock.
        try:
            token = self._tokens.pop()
        except IndexError:
            _refuse_thread()
        try:
            if settings or setpoints or isinstance(time, bool):
                self._take(time, settings, setpoints)
            try:
                # A view takes arrays of float64 of its own shape and nothing else; numpy's assignment broadcasts, and is slower.
                self._time[0] = time
                self._state[:] = state
                self._realised[:] = realised
                self._memory[:] = memory
            except (TypeError, ValueError, NotImplementedError):
                self._accept(time, state, realised, memory)
            if self._memory[0] != self._fingerprint:
                self._inspect()
            if self._ages or self.beside:
                self._take_more(time, taken, output)
            if self._may_fail:
                self._command[0] = _NOT_WRITTEN
            try:
                self._evaluate()
            except RuntimeError as error:
                return self._failed(str(error))
            if self._may_fail and isnan(self._command[0]):
                return self._failed("the compiled solver failed")
            return self._new_command(), self._new_memory()
        finally:
            self._tokens.append(token)

    def step_measured(
        self,
        time: float,
        measured: np.ndarray,
        memory: np.ndarray,
        *,
        taken: float | None = None,
        settings: Numbers | None = None,
        setpoints: SetpointsNow | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (command, memory for the next cycle) from raw measurements.

        Args:
            time: s.
            measured: what the sensors show, in the order of `measures`; late by the dead time of the measurement, as it arrives.
            memory: from `start` or from the step before.
            taken: time stamp of the sample, as in `step`.
            settings: numbers of live settings from this step on, as in `step`.
            setpoints: as in `step`.

        Raises:
            FpirhcError: as in `step`.
        """
        if self.estimates and not self.beside:
            return self.step(time, measured, _NOTHING, memory, taken=taken, settings=settings, setpoints=setpoints)
        column = numbers_of("measured", measured, len(self.measures))
        if self.estimates:
            seen, raw = np.split(column, [self.beside])
            return self.step(
                time, raw, _NOTHING, memory, output=seen, taken=taken, settings=settings, setpoints=setpoints
            )
        state, seen, realised = np.split(column, [len(self._state), len(self._state) + self.beside])
        return self.step(
            time, state, realised, memory, output=seen, taken=taken, settings=settings, setpoints=setpoints
        )

    def change(self, settings: Numbers) -> bool:
        """Put numbers of live settings in force from the next step on, by path, and return whether they were accepted.

        Raises:
            InvalidName: a setting that is not live.
        """
        asked = {path: value for path, value in self.numbers.items() if path in self._live.paths}
        try:
            _, _, numbers = self._live.changed({**asked, **self._live.flat(settings)})
            self._force(numbers)
        except InvalidName:
            raise
        except FpirhcError as error:
            self.refused, self.why_refused = self.refused + 1, str(error)
            return False
        self.numbers = numbers
        return True

    def aim(self, setpoints: SetpointsNow) -> bool:
        """Put set-points in force from the next step on, by coordinate, and return whether they were accepted.

        A set-point that is not finite, or outside the range or the limits of its state, is refused with all others of the call: the
        old ones stay, `refused` counts, and `why_refused` states the reason.

        Raises:
            InvalidName: a coordinate without set-point.
            InvalidShape: neither one number nor one per node.
        """
        try:
            row = set_points_now(self._live.problem, setpoints, self._setpoints)
        except InvalidValue as error:
            self.refused, self.why_refused = self.refused + 1, str(error)
            return False
        self._setpoints[:] = row
        return True

    @property
    def setpoints(self) -> dict[str, float | list[float]]:
        """The set-points in force, by coordinate; where they are announced, one per node of the horizon."""
        names = self._live.problem.plant.names
        rows = self._setpoints.reshape(-1, len(names)).T
        return {
            name: row.tolist() if row.size > 1 else float(row[0])
            for name, row in zip(names, rows, strict=True)
            if row.size
        }

    def _force(self, numbers: Mapping[str, float]) -> None:
        """Write the settings and what follows from them into the arguments; nothing is written where something is refused."""
        if not numbers:
            return
        values = {PREFIX + path: np.array([value]) for path, value in numbers.items()}
        values |= self._composite.derived(numbers).signals
        for name, argument in self._settings.items():
            argument[:] = values[name]

    def stale(self) -> dict[str, str]:
        """Return what follows from live settings by way of Python, and what becomes of a device that goes on with the old number.

        Gains, scales, limits, weights and dead times themselves are data, and may be written at any time. An empty text
        says that the number must not stay as it was: change the settings that it follows from only where Python computes it.
        """
        return dict(self._composite.derived(self.numbers).stale) if self.numbers else {}

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
            return {name: value.copy() for name, value in self.signals.unpack(self._trace).items()}
        finally:
            self._tokens.append(token)

    def _bind(self, function: ca.Function, parameters: np.ndarray) -> None:
        """Views of the arguments and results, once for all steps."""
        self._tokens = [True]
        self._evaluator = Evaluator(function)
        self._evaluate = self._evaluator.evaluate
        arguments = dict(zip(function.name_in(), self._evaluator.arguments, strict=True))
        arguments["parameters"][:] = parameters
        places = {name: k + 1 for k, name in enumerate(self._composite.reads.names)}  # after the memory
        self._settings = {name: self._evaluator.arguments[places[name]] for name in self._composite.settings.names}
        self._setpoints = np.zeros(0)
        for signal in given_signals(self._live.problem):
            self._setpoints = self._evaluator.arguments[places[signal.name]]
            self._setpoints[:] = signal.start_vector()
        memory_next, self._trace, command = self._evaluator.results
        self._new_command, self._new_memory = command.copy, memory_next.copy
        raw = raw_signal(self._live.problem)
        self.estimates = raw is not None  # whether the step begins with raw measurements
        sample = ("state", "realised") if raw is None else (raw.name,)
        beside = given_states(self._live.problem) or measured_signals(self._live.problem.plant)[1:] * (raw is None)
        self.beside = sum(
            signal.size for signal in beside
        )  # entries beside the sample: measured outputs, or their state
        self._output = _view(arguments[beside[0].name] if beside else _NOTHING)
        self._memory, self._time, self._state, *rest = (_view(arguments[n]) for n in ("memory", "time", *sample))
        self._realised = rest[0] if rest else _view(_NOTHING)
        self._memory_array = arguments["memory"]
        self._taken = _view(arguments["taken"]) if self._ages else self._time
        self._command = _view(command)
        self._fingerprint = float(self.memory[FINGERPRINT].start[0])

    def _take(self, time: object, settings: Numbers | None, setpoints: SetpointsNow | None) -> None:
        """Put numbers in force, and refuse a truth value as time."""
        if settings:
            self.change(settings)
        if setpoints:
            self.aim(setpoints)
        if isinstance(time, bool):
            one_number("time", time)

    def _take_more(self, time: float, taken: float | None, output: np.ndarray | None) -> None:
        """Take the time stamp of the sample, and measured outputs or their state, where the step reads them."""
        if self._ages:
            self._taken[0] = one_number("taken", time if taken is None else taken)
        if self.beside:
            self._output[:] = numbers_of("output", output, self.beside)

    def _accept(self, time: object, state: object, realised: object, memory: object) -> None:
        """Take arguments that are no arrays of float64, or say what is wrong with them."""
        first = "measured" if self.estimates else "state"
        if self.estimates and np.size(cast(float, realised)):
            raise InvalidShape(
                f"this controller estimates its state and response from {', '.join(self.measures)}: use "
                "step_measured(time, measured, memory) with these, in this order"
            )
        values = {first: (self._state, state), "memory": (self._memory, memory)}
        if not self.estimates:
            values["realised"] = (self._realised, realised)
        checked_values = {name: numbers_of(name, value, len(view)) for name, (view, value) in values.items()}
        self._time[0] = one_number("time", time)
        for name, (view, _) in values.items():
            view[:] = checked_values[name]

    def _inspect(self) -> None:
        """Raise for another controller's memory; a memory of NaN is a restart."""
        number = self._memory[0]
        if isnan(number):
            return
        raise InvalidValue(
            "argument 'memory' is not this controller's: it comes from another controller, another problem, or other settings; "
            "begin with start()"
        )

    def _failed(self, why: str) -> tuple[np.ndarray, np.ndarray]:
        """The last command and the memory as it was, after a solver that raised or failed."""
        self.why_failed = why
        memory = np.where(np.isfinite(self._memory_array), self._memory_array, self.memory.start())
        self._trace[self.signals.slice("status")] = int(Status.SOLVER_FAILED)
        self._trace[self.signals.slice("command")] = memory[self.memory.slice(HELD)]
        memory[self.memory.slice(f"{SKIPPED}_before")] += 1
        self._trace[self.signals.slice(SKIPPED)] = memory[self.memory.slice(f"{SKIPPED}_before")]
        return memory[self.memory.slice(HELD)].copy(), memory


def _composed(
    live: LiveSettings, ready: Controller, plausible: Mapping[str, Interval], max_age: float | None, watch: Watch
) -> tuple[Composite, Layout]:
    """The step behind its gate and the layout of its memory. Gate and watch have the numbers of the build, and no live ones."""
    gates: list[Gate] = []

    def compose(problem: Problem, controller: Controller) -> Composite:
        inner = compose_seeing(problem, controller)
        gates.append(Gate(live.problem, inner, plausible=plausible, max_age=max_age))
        return machine_step(live.problem, ready, gates[-1], watch)

    composite = live.composed(compose) if live.paths else compose(live.problem, ready)
    return composite, gates[-1].named(composite.memory)


_NOTHING = np.zeros(0)
_NOT_WRITTEN = float("nan")  # the gate's command is finite: what is still NaN was not written


def _measures(problem: Problem, controller: Controller) -> tuple[str, ...]:
    """Names of what a step is given: the state and the responses, or what the sensors show."""
    raw, plant, own = raw_signal(problem), problem.plant, controller.response(problem)
    if raw is not None:
        return (*(e for signal in given_states(problem) for e in signal.elements), *raw.elements)
    outputs = plant.output.elements if plant.outputs else ()
    responses = plant.response_signal("realised") if own is None else own.signal
    return (*plant.state.elements, *outputs, *names_of_responses(plant.face, responses))


def _view(array: np.ndarray) -> _View:
    return cast(_View, memoryview(array.data))


def _refuse_thread() -> NoReturn:
    raise ConcurrentUse("this Stepper is in use by another thread: one stepper serves one thread, build one for each")


def _refuse_unbounded(controller: Controller) -> None:
    planner = controller.planner
    why = planner.optimiser.unbounded if planner is not None else ""
    if why:
        raise NotSupported(f"{why}; Stepper(..., bounded=False) accepts it away from a machine")
