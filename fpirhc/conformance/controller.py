"""Laws that every controller keeps, tried in short closed loops, and laws about what it says of itself and may know.

A review, a comparison and a reader believe the facts of a controller. They are compared with what its cycles do when they are given
the motion of a recorded run: with another deformation, other exact parameters, a state near the reference.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fpirhc.conformance.laws import (
    REPLAYED,
    Array,
    Broken,
    Draw,
    Replay,
    by_states,
    coarse_steps,
    keep,
    two_masses,
    within,
)
from fpirhc.controllers.base import Controller
from fpirhc.controllers.built import checked
from fpirhc.controllers.contract import tracking_law, with_field
from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation, Identity, automatic
from fpirhc.describe import describe
from fpirhc.errors import FpirhcError
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.sensing.sensing import Sensing
from fpirhc.simulation.replay import raw_measurements
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.simulation.stepper import Stepper
from fpirhc.simulation.trials import without_warning
from fpirhc.status import Status
from fpirhc.task.exogenous import really_known
from fpirhc.task.problem import Problem

_OTHER = 1.01  # factor of exact parameters
_SAME = 1e-9  # relative difference that counts as none
_NEAR = 1e-6  # distance from the reference at which a law is linear
_SLOPE = 1e-3  # relative error of a difference quotient
_TIGHT = 0.5  # limits in the law on limits, as a share of the largest command
_STEPS = 8  # cycles before a bad measurement, and after it


def check_controller(
    controller: Controller, *, seed: int, problem: Problem | None = None, left: float = 0.05, compiled: bool = True
) -> None:
    """Check every law on a controller.

    Args:
        problem: the problem that it controls; None: two masses between springs, with limits, a horizon and a cost, for 2 s.
        left: share of the largest first error that may be left in the last quarter of a run with the exact model.
        compiled: whether to compare with compiled C too, which costs a second or more the first time; skipped without a
            compiler.
    """
    keep(_Trial(controller, problem or two_masses(), seed, left, compiled), seed)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A controller on a problem."""

    controller: Controller
    problem: Problem
    seed: int  # of the noise
    left: float = 0.05  # share of the first error that may be left with the exact model
    compiled: bool = False  # whether compiled C is compared too

    @cached_property
    def ready(self) -> Controller:
        """The controller with its automatic settings chosen."""
        return checked(self.problem, self.controller)

    @cached_property
    def run(self) -> Run:
        return self.moved(self.problem)

    @cached_property
    def replay(self) -> Replay:
        return Replay(self.problem, self.controller, self.run)

    @property
    def begun(self) -> int:
        """A cycle after the warm-up."""
        return min(self.problem.warm_up_cycles + 2, min(self.run.cycles, REPLAYED) - 1)

    def moved(self, problem: Problem) -> Run:
        """A run of the controller, in CasADi's virtual machine."""
        return simulate(problem, self.controller, seed=self.seed, compiled=False)

    def with_deformation(self, deformation: Deformation) -> Replay | None:
        """The replay with another deformation; None where the controller takes none, or not this one."""
        try:
            other = self.controller.with_deformation(deformation)
            checked(self.problem, other)
        except FpirhcError:
            return None
        return Replay(self.problem, other, self.run)


def exact_parameters_are_unknown(trial: _Trial, draw: Draw) -> Broken:
    """The command does not depend on the exact parameters, which nobody knows of a real plant, unless `exact_model` says so."""
    plant = trial.problem.plant
    if trial.controller.exact_model or not plant.parameters:
        return
    other = replace(trial.problem, plant=with_exact_parameters(plant, plant.exact * _OTHER))
    one, its = trial.replay.commands, Replay(other, trial.controller, trial.run).commands
    differ = ~((one == its) | (np.isnan(one) & np.isnan(its))).all(axis=1)
    k = int(np.argmax(differ))
    if differ[k]:
        yield (
            f"with exact parameters {_OTHER - 1:.0%} larger, and the same approximate ones and measurements, its command of cycle "
            f"{k} is {its[k]} in place of {one[k]}; use plant.approximate, or say exact_model = True where this is meant"
        )


def deformation_acts(trial: _Trial, draw: Draw) -> Broken:
    """A weaker deformation gives other commands, and where `deforms` is "response" 'deformed' is its map of 'desired'."""
    gain = 0.5 * trial.ready.deformation.effective_gain()
    weaker = trial.with_deformation(Affine(gain=-2 * gain)) if trial.ready.deformation.adapts else None
    if weaker is None or trial.ready.deforms == "turns":
        return
    if np.array_equal(weaker.commands, trial.replay.commands, equal_nan=True):
        yield (
            f"with half of the effective gain {2 * gain:.3g} its commands are the same in the first "
            f"{len(weaker.commands)} cycles of a run with a wrong model; give it to closing_blocks(built, self.deformation)"
        )
    before, missed, moved = None, 0.0, 0.0
    for k, cycle in enumerate(weaker.cycles):
        free = cycle["clipped"][0] == 0 and k > trial.problem.warm_up_cycles
        if free and before is not None:
            expected = before - gain * (trial.run["realised"][k] - cycle["desired"])
            size = 1 + np.abs(expected).max()
            missed = max(missed, float(np.abs(cycle["deformed"] - expected).max() / size))
            moved = max(moved, float(np.abs(cycle["deformed"] - cycle["desired"]).max() / size))
        before = cycle["deformed"] if free else None
    does, told = missed <= _SAME, trial.ready.deforms == "response"
    if does != told and (told or moved > _SAME):
        yield (
            f"deforms is '{trial.ready.deforms}', but with the affine map of gain {gain:.3g} its 'deformed' misses r - {gain:.3g} "
            f"(realised - desired) by the share {missed:.3g}: reviews would look for it elsewhere"
        )


def learning_remembers(trial: _Trial, draw: Draw) -> Broken:
    """A controller that `learns` commands otherwise later: without its deformation, for the same measurement."""
    if not trial.controller.learns:
        return
    replay = trial.with_deformation(Identity()) if trial.controller.deformation.adapts else None
    replay = replay or trial.replay
    early, late = (replay.cycle(trial.begun, replay.cycles[k]["memory"])["command"] for k in (trial.begun, -1))
    if np.array_equal(early, late):
        yield (
            f"learns is true, but after {len(replay.cycles)} cycles with a wrong model its command for the measurement of cycle "
            f"{trial.begun} is still {late}: reviews would take its convergence for unknown"
        )


def law_is_what_it_does(trial: _Trial, draw: Draw) -> Broken:
    """Near the reference it feeds the error back with the gains of its `tracking` law, from which reviews read its speed."""
    law, output, replay, k = tracking_law(trial.ready), trial.problem.plant.output, trial.replay, trial.begun
    if law is None or trial.ready.planner is not None or trial.ready.inner is not None:
        return
    memory = replay.cycles[k - 1]["memory"]
    on = replay.cycle(k, memory)["reference"]
    at = replay.cycle(k, memory, **{output.name: on})["desired"]
    for row, (name, order) in enumerate(trial.problem.plant.response_orders.items()):
        gains = law.gains(order) if order else None
        for s, gain in enumerate(gains[-order:] if gains is not None else ()):
            element = name + "'" * s
            near = on - _NEAR * (np.arange(on.size) == output.elements.index(element))
            slope = float(replay.cycle(k, memory, **{output.name: near})["desired"][row] - at[row]) / _NEAR
            if not within(slope - gain, _SLOPE * (1 + abs(gain))):
                words = f"near the reference the error of '{element}' is fed back with {slope:.6g}"
                yield f"{words}, its law {type(law).__name__} says {gain:.6g}"


def exact_model_tracks(trial: _Trial, draw: Draw) -> Broken:
    """With an exact model, ideal sensors and no disturbance, the error of every judged coordinate goes to zero."""
    plant, signals = trial.problem.plant, really_known(trial.problem.signals)
    plant = replace(plant, parameters={n: replace(p, approximate=p.exact) for n, p in plant.parameters.items()})
    run = trial.moved(replace(trial.problem, plant=plant, disturbances={}, sensing=Sensing(), signals=signals))
    errors = np.abs(run["true_error"])
    first, late = float(errors[0].max()), errors[-run.cycles // 4 :].max(axis=0)
    if run.stop is not None or first == 0:
        yield f"with the exact model the run begins with the error {first:g} and ends with {run.stop}; start off the reference"
    for name, rest in zip(trial.problem.judged_names, late, strict=True):
        if not within(rest, trial.left * first):
            words = f"with the exact model the error of '{name}' is still {rest:.3g} in the last quarter of the run"
            yield f"{words}, of {first:.3g} at first; more than the share {trial.left:g}"


@without_warning()
def _moved(problem: Problem, trial: _Trial) -> tuple[Run | None, str]:
    """A run on another problem, None where the controller refuses it for a reason of its own; what it raises where it does not."""
    try:
        return trial.moved(problem), ""
    except FpirhcError:
        return None, ""
    except Exception as error:  # noqa: BLE001 -- whatever a member raises
        return None, " ".join(str(error).split()) or type(error).__name__


def what_it_takes_it_controls(trial: _Trial, draw: Draw) -> Broken:
    """A plant with outputs of its states, or a map in coarse steps, known exactly, it refuses, or does not drive away."""
    cures = {
        "a plant with outputs": (by_states(), "read plant.output and not plant.state for what follows the reference"),
        "a map": (coarse_steps(), "write its law for differences of steps"),
    }
    for kind, (problem, cure) in cures.items():
        run, error = _moved(problem, trial)
        if error:
            yield f"it says that it can control {kind}, but cannot be built for one: {error}"
        elif run is not None:
            errors = np.abs(run["true_error"])
            rest, first = float(errors[-run.cycles // 4 :].max()), float(errors[0].max())
            if run.stop is not None or not within(rest, first * (1 + _SAME)):
                words = f"it takes {kind}, but an error of {first:.3g} is {rest:.3g} after {run.cycles} steps"
                yield f"{words}; {cure}, or raise NotSupported in check() with the reason"


def facts_hold(trial: _Trial, draw: Draw) -> Broken:
    """Notes are sentences, no automatic setting is left, a planner plans, and its optimiser can be exchanged."""
    ready, notes = trial.ready, trial.ready.notes(trial.problem)
    if not isinstance(notes, tuple) or not all(isinstance(one, str) and one.strip() for one in notes):
        yield f"its notes are {notes!r}, expected is a tuple of sentences"
    if left := automatic(ready.deformation):
        yield f"after with_defaults() its deformation still has the automatic settings {left}"
    if (ready.planner is not None) != ("solve" in trial.run.layout):
        yield f"its planner is {ready.planner}, and its cycle has {'a' if ready.planner is None else 'no'} signal 'solve'"
    same = with_field(ready, "optimiser", ready.planner.optimiser) if ready.planner is not None else ready
    if describe(same) != describe(ready):
        yield "with its own optimiser it has another description"


@without_warning()
def _commands(trial: _Trial, *, compiled: bool) -> Array:
    """Commands of a Stepper of an equal controller that is given what the run measured."""
    stepper = Stepper(trial.problem, copy(trial.controller), compiled=compiled, bounded=False)
    memory, commands = stepper.start(), []
    for time, measured in zip(trial.run.time[:REPLAYED], raw_measurements(trial.run), strict=False):
        command, memory = stepper.step_measured(float(time), measured, memory)
        commands.append(command)
    return np.array(commands)


def same_command_everywhere(trial: _Trial, draw: Draw) -> Broken:
    """The loop, a Stepper of an equal controller, and its compiled C give the same command for the same measurements."""
    own = trial.run["command"][:REPLAYED]
    for compiled in (False, True)[: 1 + trial.compiled]:
        its = _commands(trial, compiled=compiled)
        missed = np.abs(its - own[: len(its)]).max(axis=1)
        k = int(np.argmax(np.nan_to_num(missed, nan=np.inf)))
        if not within(missed[k], _SAME * (1 + float(np.abs(own).max()))):
            what = "compiled C" if compiled else "a Stepper"
            yield f"in cycle {k} the loop's command is {own[k]}, from {what} it is {its[k]}"


def command_keeps_the_limits(trial: _Trial, draw: Draw) -> Broken:
    """No command leaves the limits of the inputs, also where they are half of the commands without limits."""
    plant, commands = trial.problem.plant, trial.run["command"]
    middle, most = 0.5 * (commands.max(axis=0) + commands.min(axis=0)), 0.5 * np.ptp(commands, axis=0)
    ends = zip(plant.inputs, (middle - _TIGHT * most).tolist(), (middle + _TIGHT * most).tolist(), strict=True)
    tight = replace(trial.problem.limits, inputs={name: (low, high) for name, low, high in ends})
    narrow = replace(trial.problem, limits=tight)
    # A weak actuator may lose the plant: every command up to there counts.
    for problem, run in ((trial.problem, trial.run), (narrow, trial.moved(narrow))):
        lower, upper = problem.limits.input_bounds(plant)
        outside = np.maximum(lower - run["command"], run["command"] - upper)
        k, j = np.unravel_index(int(np.argmax(outside)), outside.shape)
        if not (outside <= 0).all():
            words = f"the command '{plant.input.elements[j]}' is {run['command'][k, j]:.6g} at t = {run.time[k]:g} s"
            yield f"{words}, outside ({lower[j]:g}, {upper[j]:g})"


def bad_measurement_never_acts(trial: _Trial, draw: Draw) -> Broken:
    """A measurement that is not finite gives a finite command within the limits and a status, and does no lasting harm."""
    for bad in (np.nan, np.inf):
        for k, name in enumerate(trial.problem.plant.state.elements):
            yield from _measured_once(trial, bad, k, f"'{name}' measured as {bad} in cycle {_STEPS}")
        yield from _measured_once(trial, bad, None, f"a response measured as {bad} in cycle {_STEPS}")


def _measured_once(trial: _Trial, bad: float, entry: int | None, what: str) -> Broken:
    """Replay a run with one bad value in one cycle: of an entry of the state, or (None) of the whole response."""
    run, replay, lower, upper = trial.run, trial.replay, *trial.problem.limits.input_bounds(trial.problem.plant)
    # A stepper's gate keeps bad samples away; the controller itself must survive them too, inside of another one.
    memory, matters, instead = (
        replay.cycles[_STEPS - 1]["memory"],
        False,
        {"realised": np.full_like(run["realised"][0], bad)},
    )
    if entry is not None:
        state = run["state"][_STEPS] + 0.1 * (np.arange(run["state"].shape[1]) == entry)
        moved = replay.cycle(_STEPS, memory, state=state)["command"]
        matters = not np.array_equal(moved, run["command"][_STEPS])
        state[entry] = bad
        instead = {"state": state}
    for cycle in range(_STEPS, 2 * _STEPS + 1):
        said = replay.cycle(cycle, memory, **(instead if cycle == _STEPS else {}))
        memory, command, status = said["memory"], said["command"], float(said["status"][0])
        if not (np.isfinite(command).all() and (command >= lower).all() and (command <= upper).all()):
            yield f"{what}: the command of cycle {cycle} is {command}"
        if cycle == _STEPS and matters and status == Status.OK:
            yield f"{what}: the status of that cycle is OK"
    if status == Status.NON_FINITE:
        yield f"{what}: {_STEPS} good measurements later the status is still NON_FINITE"
