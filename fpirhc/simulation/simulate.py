"""Runs a closed loop and logs every signal.

The loop's one-cycle Function is accumulated over a chunk of cycles inside CasADi (compiled when a C compiler is found), so Python
is entered once per chunk: for disturbances and noise, to check that all signals are finite, to report progress.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeAlias

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.believed import plant_model
from fpirhc.controllers.contract import innermost, name_in_task
from fpirhc.controllers.live_settings import LiveSettings, Numbers, live_settings
from fpirhc.describe import describe
from fpirhc.errors import FpirhcError
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Seed
from fpirhc.simulation.loop import closed_loop, plans_exactly, start_memory
from fpirhc.simulation.moved import moving
from fpirhc.simulation.ranges import Dropped, Ranges
from fpirhc.simulation.replay import cycles_per_call, replaying, silence
from fpirhc.simulation.run import Run, with_common_columns
from fpirhc.simulation.step_arguments import Setpoints, set_point_record
from fpirhc.simulation.tables import run_tables
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.dotted import paths_to
from fpirhc.symbolic.evaluate import Evaluator, Latest
from fpirhc.symbolic.native import Native, native
from fpirhc.symbolic.program import chained
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem

_DESCRIBED: Latest[object] = Latest(16)
_CHAIN = 5  # cycles of the inner chain of the virtual machine
Progress = Callable[[int, int], None]
Patch: TypeAlias = tuple[int, np.ndarray, np.ndarray]  # cycle, places in the memory, their values
SWITCHED_OFF = "compiled=False was given"  # a reason why a loop is not compiled
_TOO_SHORT = "the run is short, and a compiler would take longer"
_SHORT_RUN = 150_000  # cycles times stages of plans, below which a compiler takes longer than the virtual machine


@dataclass(frozen=True, eq=False)
class Simulator:
    """A closed loop that is built once and runs many times, with other seeds, exact parameters and live settings.

    It works in one thread only and cannot be pickled: build one in each process.

    Args:
        problem: the task.
        live: the settings that a run may change.
        loop: the closed loop as one step.
        compiles: whether the loop is compiled; None: unless the run is short.
    """

    problem: Problem
    live: LiveSettings
    loop: Composite
    compiles: bool | None

    @classmethod
    def of(
        cls,
        problem: Problem,
        controller: Controller,
        compiled: bool | None,
        live: Sequence[str] = (),
        *,
        any_gain: bool = False,
    ) -> Self:
        """Return the loop of problem and controller, compiled when it first runs; arguments and errors as in `simulator`."""
        settings = live_settings(problem, controller, live)
        return cls(problem, settings, settings.composed(closed_loop, any_gain=any_gain), compiled)

    @classmethod
    def adjustable(cls, problem: Problem, controller: Controller) -> Self:
        """Return a loop in which gains and finite limits of inputs are live, those that can be so together; it is not compiled."""
        paths = [path for path in paths_to("gain", controller) if not path.startswith("optimiser.")]
        ends = ((name, k, end) for name, pair in problem.limits.inputs.items() for k, end in enumerate(pair))
        paths += [f"limits.inputs.{name}.{k}" for name, k, end in ends if np.isfinite(end)]
        ready = cls.of(problem, controller, False)
        for path in paths:
            with suppress(FpirhcError):
                ready = cls.of(problem, controller, False, [*ready.live.paths, path])
        return ready

    @cached_property
    def numbers(self) -> dict[str, tuple[str, float, Interval, int]]:
        """Unit, number of the build, bounds, and place in the first memory of each live setting, by path."""
        live, units, places = self.live, self.loop.memory.units, self.live.places(self.loop.memory).tolist()
        return {p: (units[k], live.start[p], live.bounds[p], k) for p, k in zip(live.paths, places, strict=True)}

    @property
    def controller(self) -> Controller:
        """The controller with its automatic settings chosen."""
        return self.live.controller

    @property
    def calls(self) -> int:
        """Cycles of a call of the compiled loop; 0 where no compiler is asked."""
        horizon, plans = self.problem.horizon, innermost(self.controller).planner is not None
        long = self.problem.cycles * (horizon.stages if plans and horizon is not None else 1) > _SHORT_RUN
        return cycles_per_call(self.problem, compiled=True) * bool(self.compiles or (self.compiles is None and long))

    @cached_property
    def backend(self) -> Native:
        """What runs the loop's cycles, and the reason where it is not compiled C."""
        function = self.loop.function
        if self.calls:
            return native(function, required=bool(self.live.paths), calls=self.calls)
        return Native(function, False, SWITCHED_OFF if self.compiles is False else _TOO_SHORT)

    @cached_property
    def evaluator(self) -> Evaluator:
        """The loop over so many cycles as a call runs."""
        interpreted, function = cycles_per_call(self.problem, compiled=False), self.backend.function
        return Evaluator(function if self.compiled else chained(function, interpreted, _CHAIN))

    @property
    def compiled(self) -> bool:
        """Whether the loop is compiled C."""
        return self.backend.compiled

    def outdated_by(self, problem: Problem) -> bool:
        """Whether a variant needs a loop of its own: plans that know the exact parameters begin their line search with a step that
        was measured with those of the build, which a plan that is solved forgets, and one of so many iterations does not.
        """
        planner = self.controller.planner
        counted = planner is not None and getattr(planner.optimiser, "iterations", None) is not None
        return counted and plans_exactly(self.loop, problem, self.controller)

    @checked_call
    def run(
        self,
        *,
        seed: Seed,
        name: str = "",
        variant: Problem | None = None,
        disturbed: bool = True,
        progress: Progress | None = None,
        settings: Numbers | None = None,
        setpoints: Setpoints | None = None,
    ) -> Run:
        """Run the loop once and return its signals.

        Args:
            seed: of the noise of disturbances and sensors.
            name: of the controller in the results; '': its name in the task from which it comes, else the name of its class.
            variant: the simulator's problem with other exact parameters or another duration; None: the problem itself. A loop is
                built for it where plans with the exact model have a fixed number of iterations.
            disturbed: whether disturbances act; the sensors' noise always does.
            progress: called with (cycles done, cycles in all).
            settings: numbers of live settings by path; the others have the numbers of the build. None: all have them.
            setpoints: by coordinate, in place of those of the reference: a number, or pairs (time, set-point).

        Raises:
            InvalidName: a setting that is not live; a coordinate without set-point.
            InvalidValue: a number that a setting does not accept; a set-point that cannot be reached.
            NotContractive: a gain with which the deformation cannot converge.
        """
        problem = variant or self.problem
        own: Simulator = self
        if self.outdated_by(problem):
            own = simulator(problem, self.live.unresolved, compiled=self.compiles, live=self.live.paths)
        problem, controller, numbers = replace(own.live, problem=problem).changed(settings or {})
        start = start_memory(own.loop, problem, controller)
        start[own.live.places(own.loop.memory)] = list(numbers.values())
        tables = run_tables(problem, seed, _padded(problem, ()), disturbed=disturbed, setpoints=setpoints)
        logged, stop = run_cycles(problem, start, own.loop, own.evaluator, tables, seed, progress)
        layout, log = with_common_columns(own.loop.trace, logged)
        log.setflags(write=False)
        model, gain = plant_model(problem, controller), float(controller.deformation.effective_gain())
        facts: dict[str, object] = {
            "effective_gain": gain,
            "iterates": gain != 0 and controller.deforms in ("response", "command"),
            "parameters": [float(v) for v in model.parameters(model.plant)],
            "controller": _DESCRIBED.of((controller,), (), lambda: describe(controller)),
            "problem": describe(problem),
            "limits": [ends.tolist() for ends in problem.limits.input_bounds(problem.plant)],  # in force
            "backend": "compiled C" if own.compiled else "CasADi virtual machine",
            "why not compiled": own.backend.reason,
        }
        if controller.deformation.form.weights is not None:
            facts["weights"] = [list(row) for row in controller.deformation.form.weights]
        if numbers:
            facts["live"] = numbers
        points = set_point_record(problem, setpoints)
        if points:
            facts["setpoints"] = points
        if problem.reality is not None:
            facts["model is reality"] = model.plant is not problem.plant
        title = name or name_in_task(own.controller)
        return Run(problem.name, title, seed, problem.period, layout, log, stop, own.compiled, facts)


@checked_call
def simulator(
    problem: Problem, controller: Controller, *, compiled: bool | None = True, live: Sequence[str] = ()
) -> Simulator:
    """Return the closed loop of problem and controller, ready to run.

    Args:
        problem: the task.
        controller: its automatic settings are chosen here.
        compiled: whether the loop is compiled to C where there is a compiler; None: unless the run is short.
        live: paths of settings that a run may change without another build: 'deformation.gain', 'cost.states.q1',
            'limits.inputs.Q1.1'.

    Raises:
        InvalidName: no such setting; the nearest one is offered.
        NotSupported: a setting that decides what the loop is made of, or that this loop needs as a number.
        CompileError: the compiler fails on a loop with live settings.
    """
    ready = Simulator.of(problem, controller, compiled, live)
    ready.backend  # noqa: B018 -- what cannot be compiled is an error here
    return ready


@checked_call
def simulate(
    problem: Problem,
    controller: Controller,
    *,
    seed: Seed,
    name: str = "",
    compiled: bool | None = True,
    progress: Progress | None = None,
    setpoints: Setpoints | None = None,
) -> Run:
    """Run the closed loop of problem and controller and return every signal.

    A signal that becomes NaN or infinite, a state that leaves its physical range, or an error of more than a million times the
    reference ends the run there. The run keeps the cycles before it, and `Run.stop` is the reason.

    Args:
        problem: the task.
        controller: its automatic settings are chosen here.
        seed: of the noise of disturbances and sensors.
        name: of the controller in the results; '': its name in the task from which it comes, else the name of its class.
        compiled: whether the loop is compiled to C where there is a compiler; None: unless the run is short.
        progress: called with (cycles done, cycles in all).
        setpoints: by coordinate, in place of those of the reference: a number, or pairs (time, set-point).
    """
    ready = simulator(problem, controller, compiled=compiled)
    return ready.run(seed=seed, name=name, progress=progress, setpoints=setpoints)


def run_cycles(
    problem: Problem,
    start: np.ndarray,
    loop: Composite,
    evaluator: Evaluator,
    tables: Sequence[np.ndarray],
    seed: int,
    progress: Progress | None = None,
    patches: Sequence[Patch] = (),
) -> tuple[np.ndarray, str | None]:
    """Return the log, shape (cycles, trace.size), and the reason why the run ended early.

    Args:
        evaluator: of the loop over as many cycles as a call runs, see `chained`.
        tables: disturbances and the sensors' random series, one row per cycle, in whole chunks.
        seed: for a plant outside.
        progress: called with (cycles done, cycles in all).
    """
    cycles, trace, dropped, padded = problem.cycles, loop.trace, Dropped(loop), _padded(problem, patches)
    count = evaluator.results[1].size // trace.size  # a call
    log, ranges = np.empty((padded, trace.size)), Ranges(problem, trace, silence(problem, loop))
    memory, *read, run = evaluator.arguments
    windows = [(argument.reshape(count, -1), table) for argument, table in zip(read, tables, strict=False)]
    after, sent = evaluator.results[0], evaluator.results[2:]
    mover, again = moving(problem), replaying(problem, loop, evaluator)
    memory[:] = start
    try:
        mover.begin(read[len(tables) :], seed)
        for at, end in pieces(cycles, count, [cycle for cycle, _, _ in patches]):
            for cycle, places, values in patches:
                if cycle == at:
                    memory[places] = values
            for argument, table in windows:
                argument[:] = table[at : at + count]
            run[:] = end - at
            evaluator.redirect(1, log[at : at + count])
            why = evaluator.failure() or again(memory, log[at])
            if why:
                words = f"a solver failed ({why})" + (f" within {count} cycles, at the earliest" if count > 1 else "")
                return log[:at].copy(), stopped(problem, at, words)
            rows = log[at:end]
            bad = dropped.first_bad(rows, log[at - 1] if at else None) or ranges.first_outside(rows)
            if bad is not None:
                row, what = bad
                return log[: at + row].copy(), stopped(problem, at + row, what)
            memory[:] = after
            ended = mover.after(end - 1, sent)
            if ended and end < cycles:
                return log[:end].copy(), stopped(problem, end, ended)
            if progress:
                progress(end, cycles)
        return log[:cycles], None
    finally:
        mover.end()


def _padded(problem: Problem, patches: Sequence[Patch]) -> int:
    """Rows of a log in whole chunks, with one to spare where a call ends at a change of the memory."""
    chunk = cycles_per_call(problem, compiled=True)
    return (-(-problem.cycles // chunk) + (1 if patches else 0)) * chunk


def pieces(cycles: int, most: int, cuts: Sequence[int]) -> list[tuple[int, int]]:
    """Return (first cycle, end) of the calls that make up a run: so many cycles at most, and none goes beyond a cut."""
    calls, at, ends = [], 0, sorted({c for c in cuts if 0 < c < cycles} | {cycles})
    for end in ends:
        while at < end:
            calls.append((at, min(at + most, end)))
            at = calls[-1][1]
    return calls


def stopped(problem: Problem, cycle: int, what: str) -> str:
    """Return the reason why a run ended before this cycle."""
    when = f"at t = {cycle * problem.period:g} {problem.time_unit} (cycle {cycle})"
    return f"{what} {when}; the run keeps the cycles before it"
