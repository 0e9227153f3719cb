"""Laws that every controller keeps, tried in short closed loops."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fpirhc.conformance.controller_facts import FACTS
from fpirhc.conformance.laws import hold, is_a_frozen_value, keep, within
from fpirhc.conformance.loops import REPLAYED, Trial, anything
from fpirhc.conformance.loops import two_masses as two_masses
from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import checked
from fpirhc.controllers.contract import resolved, with_optimiser
from fpirhc.controllers.sensing_chain import compose_controller
from fpirhc.deformation.base import automatic, with_inner
from fpirhc.describe import describe
from fpirhc.plant.chain import measured_signals
from fpirhc.simulation.run import Run
from fpirhc.simulation.sample import raw_measurements
from fpirhc.simulation.stepper import Stepper
from fpirhc.simulation.trials import without_warning
from fpirhc.status import Status
from fpirhc.task.problem import Problem

Array = npt.NDArray[Any]

_SAME = 1e-9  # relative difference of commands that counts as none
_TIGHT = 0.5  # limits in the law on limits, as a share of the largest command
_STEPS = 8  # cycles before a bad measurement, and after it


def check_controller(
    controller: Controller, *, seed: int, problem: Problem | None = None, left: float = 0.05, compiled: bool = True
) -> None:
    """Check every law on a controller.

    Args:
        controller: the controller.
        seed: of the noise and of all draws.
        problem: the problem that it controls; None: two masses between springs, with limits, a horizon and a cost, for 2 s.
        left: share of the largest first error that may be left in the last quarter of a run with the exact model.
        compiled: whether to compare with compiled C too, which costs a second or more the first time; skipped without a
            compiler.

    Raises:
        AssertionError: the first law that does not hold, in one sentence.
        FpirhcError: the controller cannot serve the problem.
    """
    keep(controller, Trial(controller, problem or two_masses(), seed, left, compiled), LAWS, seed)


def frozen_value(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A controller is a frozen value that can be hashed, copied and described."""
    is_a_frozen_value(trial.controller)
    is_a_frozen_value(resolved(trial.problem, trial.controller))


def facts_hold(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """The facts of a controller hold: its inner controller can be exchanged, no automatic setting is left, a planner plans."""
    ready = checked(trial.problem, trial.controller)
    left = automatic(ready.deformation)
    hold(not left, f"after resolved() its deformation still has the automatic settings {left}")
    if ready.inner is not None:
        same = with_inner(ready, ready.inner)
        hold(describe(same) == describe(ready), "around its own inner controller it has another description")
    planner = ready.planner
    hold(
        (planner is not None) == ("solve" in trial.stepper.signals),
        f"its planner is {planner}, and its cycle has {'a' if planner is None else 'no'} signal 'solve'",
    )
    if planner is not None:
        same = with_optimiser(ready, planner.optimiser)
        hold(describe(same) == describe(ready), "with its own optimiser it has another description")
    absent = {"output"} - {signal.name for signal in measured_signals(trial.problem.plant)}
    for read, name in ((r, n) for r, n in ready.feeds.items() if r not in absent):
        seen = name.startswith("_") or name in trial.stepper.signals
        hold(seen, f"its inner controller reads '{name}' for '{read}', which is no signal of the run")


def writes_a_command_and_a_status(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A cycle writes what every run logs: reference, error, desired, deformed, command, clipped, status."""
    written = compose_controller(trial.problem, trial.controller).trace
    expected = ("reference", "error", "desired", "deformed", "command", "clipped", "status")
    missing = [name for name in expected if name not in written]
    hold(not missing, f"its blocks do not write {missing}; end them with closing_blocks()")
    size = trial.problem.plant.input.size
    hold(
        written["command"].size == size,
        f"its command has {written['command'].size} entries, the plant has {size} inputs",
    )


def exact_model_tracks(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """With an exact model, ideal sensors and no disturbance, the error of every judged coordinate goes to zero."""
    problem = trial.exact
    run = trial.simulated(problem)
    hold(run.stop is None, f"with the exact model the run ends early: {run.stop}")
    errors = np.abs(run["true_error"])
    first, late = float(errors[0].max()), errors[-run.cycles // 4 :].max(axis=0)
    hold(first > 0, "the problem starts on its reference, so there is no error to decay; start elsewhere")
    for name, rest in zip(problem.judged_names, late, strict=True):
        hold(
            within(rest, trial.left * first),
            f"with the exact model the error of '{name}' is still {rest:.3g} in the last quarter of {problem.duration:g} s, "
            f"of {first:.3g} at first; more than the share {trial.left:g}",
        )


@without_warning()
def same_command_everywhere(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """The loop, a Stepper, a Stepper of an equal controller and compiled C give the same command for the same measurements."""
    equal = copy(trial.controller)  # the same value is composed once
    run, scale = trial.run, 1 + float(np.abs(trial.run["command"]).max())
    steppers = {
        "a Stepper": trial.stepper,
        "a second Stepper": Stepper(
            trial.problem, equal, compiled=False, bounded=False, plausible=anything(trial.problem)
        ),
    }
    if trial.compiled:
        compiled = Stepper(trial.problem, trial.controller, bounded=False, plausible=anything(trial.problem))
        if compiled.compiled:
            steppers["compiled C"] = compiled
    for what, stepper in steppers.items():
        commands = _replayed(stepper, run)
        missed = np.abs(commands - run["command"][: len(commands)]).max(axis=1)
        worst = int(np.argmax(np.nan_to_num(missed, nan=np.inf)))
        hold(
            within(missed, _SAME * scale),
            f"in cycle {worst} the loop's command is {run['command'][worst]}, from {what} it is {commands[worst]}",
        )


def _replayed(stepper: Stepper, run: Run) -> Array:
    memory, measured = stepper.start(), raw_measurements(run)
    commands = np.empty_like(run["command"][:REPLAYED])
    for k in range(len(commands)):
        commands[k], memory = stepper.step_measured(float(run.time[k]), measured[k], memory)
    return commands


def same_arguments_same_command(trial: Trial, generator: np.random.Generator) -> None:
    """A cycle depends on its arguments alone: two calls with the same arguments give the same result."""
    run, stepper = trial.run, trial.stepper
    memory, measured = stepper.start(), raw_measurements(run)
    for k in generator.integers(0, run.cycles, size=5):
        arguments = float(run.time[k]), measured[k]
        one, next_memory = stepper.step_measured(*arguments, memory)
        other, other_memory = stepper.step_measured(*arguments, memory)
        hold(
            np.array_equal(one, other, equal_nan=True) and np.array_equal(next_memory, other_memory, equal_nan=True),
            f"two calls with the same arguments give {one} and {other}",
        )
        memory = next_memory


def command_keeps_the_limits(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """No command leaves the limits of the inputs, also where they are half of the commands without limits."""
    plant, commands = trial.problem.plant, trial.run["command"]
    middle, most = 0.5 * (commands.max(axis=0) + commands.min(axis=0)), 0.5 * np.ptp(commands, axis=0)
    inputs = {
        name: (float(middle[k] - _TIGHT * most[k]), float(middle[k] + _TIGHT * most[k]))
        for k, name in enumerate(plant.inputs)
    }
    narrow = replace(trial.problem, limits=replace(trial.problem.limits, inputs=inputs))
    # A weak actuator may lose the plant: every command up to there counts.
    for problem, run in ((trial.problem, trial.run), (narrow, trial.simulated(narrow))):
        lower, upper = problem.limits.input_bounds(plant)
        outside = np.maximum(lower - run["command"], run["command"] - upper)
        worst = np.unravel_index(int(np.argmax(outside)), outside.shape)
        name = plant.input.elements[worst[1]]
        hold(
            bool((outside <= 0).all()),
            f"the command '{name}' is {run['command'][worst]:.6g} at t = {run.time[worst[0]]:g} s, outside "
            f"({lower[worst[1]]:g}, {upper[worst[1]]:g})",
        )
        clipped = np.isclose(run["command"], lower).any(axis=1) | np.isclose(run["command"], upper).any(axis=1)
        unreported = clipped & (run["clipped"][:, 0] < 0.5) & ("command_unclipped" in run.layout)
        if unreported.any():
            at = int(np.argmax(unreported))
            excess = np.abs(run["command_unclipped"][at] - run["command"][at]).max()
            hold(
                within(excess, _SAME * (1 + np.abs(run["command"][at]).max())),
                f"it clips at t = {run.time[at]:g} s, and its signal 'clipped' is 0",
            )


def bad_measurement_never_acts(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A measurement that is not finite gives a finite command within the limits and a status, and does no lasting harm."""
    for bad in (np.nan, np.inf):
        for k, name in enumerate(trial.problem.plant.state.elements):
            _measured_once(trial, bad, k, f"'{name}' measured as {bad} in cycle {_STEPS}")


def bad_response_never_acts(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A measured response that is not finite gives finite commands within the limits, then and later."""
    for bad in (np.nan, np.inf):
        _measured_once(trial, bad, None, f"a response measured as {bad} in cycle {_STEPS}")


def _measured_once(trial: Trial, bad: float, entry: int | None, what: str) -> None:
    """Replay a run with one bad value in one cycle: of an entry of the state, or (None) of the whole response."""
    run, lower, upper = trial.run, *trial.problem.limits.input_bounds(trial.problem.plant)
    # A stepper's gate keeps bad samples away; the controller itself must survive them too, inside of another one.
    memory, status = trial.replay.memory, 0.0
    for cycle in range(min(2 * _STEPS + 1, run.cycles)):
        state, realised = run["state"][cycle].copy(), run["realised"][cycle]
        matters = False
        if cycle == _STEPS and entry is None:
            realised = np.full_like(realised, bad)
        elif cycle == _STEPS and entry is not None:
            state[entry] += 0.1
            moved = trial.replay.cycle(cycle, memory, state=state, realised=realised)
            matters = not np.array_equal(moved["command"], run["command"][cycle])
            state[entry] = bad
        said = trial.replay.cycle(cycle, memory, state=state, realised=realised)
        memory, command, status = said.memory, said["command"], float(said["status"][0])
        if not (np.isfinite(command).all() and (command >= lower).all() and (command <= upper).all()):
            hold(False, f"{what}: the command of cycle {cycle} is {command}")
        hold(not matters or status != Status.OK, f"{what}: the status of that cycle is OK")
    hold(status != Status.NON_FINITE, f"{what}: {_STEPS} good measurements later the status is still NON_FINITE")


LAWS = (
    frozen_value,
    writes_a_command_and_a_status,
    same_arguments_same_command,
    same_command_everywhere,
    command_keeps_the_limits,
    bad_measurement_never_acts,
    bad_response_never_acts,
    exact_model_tracks,
    facts_hold,
    *FACTS,
)
