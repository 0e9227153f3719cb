"""Laws that every controller keeps, tried in short closed loops, and laws about what it says of itself and may know.

A review, a comparison and a reader believe the facts of a controller. They are compared with what its cycles do when they are given
the motion of a recorded run: with another deformation, other exact parameters, a state near the reference.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fpirhc.conformance.laws import frozen_value, hold, keep, within
from fpirhc.conformance.loops import REPLAYED, Replay, Trial, coarse_steps, spelled_by_states, two_masses
from fpirhc.controllers.base import Controller
from fpirhc.controllers.built import build, checked
from fpirhc.controllers.composed import compose_controller
from fpirhc.controllers.contract import tracking_law, with_field
from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Identity, automatic, with_inner
from fpirhc.describe import describe
from fpirhc.errors import FpirhcError
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.simulation.step_arguments import raw_measurements
from fpirhc.simulation.stepper import Stepper
from fpirhc.simulation.trials import without_warning
from fpirhc.status import Status
from fpirhc.task.problem import Problem

Array = npt.NDArray[Any]

_OTHER = 1.01  # factor of exact parameters
_PROBE = 0.3  # effective gain of the map with which a controller's wiring is looked at
_SAME = 1e-9  # relative difference that counts as none
_NEAR = 1e-6  # distance from the reference at which a law is linear
_SLOPE = 1e-3  # relative error of a difference quotient
_ALIKE = 0.05  # of the largest command: what two spellings of a plant may differ by in unconverged plans
_SHORT = 40  # cycles
_TIGHT = 0.5  # limits in the law on limits, as a share of the largest command
_STEPS = 8  # cycles before a bad measurement, and after it


def exact_parameters_are_unknown(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """The command does not depend on the exact parameters, which nobody knows of a real plant, unless `plant_model` says so."""
    plant = trial.problem.plant
    if trial.controller.plant_model(trial.problem).exact or not plant.parameters:
        return
    other = replace(trial.problem, plant=with_exact_parameters(plant, plant.exact * _OTHER))
    one, its = trial.replay.commands, Replay(other, trial.controller, trial.run).commands
    differ = ~((one == its) | (np.isnan(one) & np.isnan(its))).all(axis=1)
    k = int(np.argmax(differ))
    hold(
        not differ[k],
        f"with exact parameters {_OTHER - 1:.0%} larger, and the same approximate ones and measurements, its command of cycle "
        f"{k} is {its[k]} in place of {one[k]}; use plant.approximate, or say PlantModel(..., exact=True) where this is meant",
    )


def deformation_acts(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A deformation acts: with half of its gain the commands are others, or adaptation is compared that is not there."""
    deformation = trial.controller.deformation
    if not deformation.adapts:
        return
    weaker = _with_deformation(trial, deformation.with_effective_gain(0.5 * deformation.effective_gain()))
    if weaker is None:
        return
    commands = trial.replay.commands
    others = Replay(trial.problem, weaker, trial.run).cycles()
    hold(
        any(not np.array_equal(cycle["command"], its) for cycle, its in zip(others, commands, strict=True)),
        f"with half of the effective gain {deformation.effective_gain():.3g} its commands are the same in the first "
        f"{len(commands)} cycles of a run with a wrong model; use the deformation, closing_blocks(built, self.deformation)",
    )


def desired_response_is_deformed(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Where `deforms` is "response" the signal 'deformed' is the map of the logged 'desired', and only there."""
    ready = checked(trial.problem, trial.controller)
    gain = _PROBE if ready.deformation.effective_gain() >= 0 else -_PROBE
    probe = _with_deformation(trial, Affine(gain=-2 * gain))
    if probe is None or not ready.deformation.adapts or ready.deforms == "turns":
        return
    before, missed, moved = None, 0.0, 0.0
    for k, cycle in enumerate(Replay(trial.problem, probe, trial.run).cycles()):
        free = cycle["clipped"][0] == 0 and k > trial.problem.warm_up_cycles
        if free and before is not None:
            expected = before - gain * (trial.run["realised"][k] - cycle["desired"])
            size = 1 + np.abs(expected).max()
            missed = max(missed, float(np.abs(cycle["deformed"] - expected).max() / size))
            moved = max(moved, float(np.abs(cycle["deformed"] - cycle["desired"]).max() / size))
        before = cycle["deformed"] if free else None
    does, told = missed <= _SAME, ready.deforms == "response"
    rule = f"r - {gain:g} (realised - desired)"
    hold(
        does or not told,
        f"deforms is 'response', but with the affine map of gain {gain:g} its 'deformed' misses {rule} by the share {missed:.3g}; "
        "log the desired response that is deformed",
    )
    hold(
        told or not does or moved <= _SAME,
        f"deforms is '{ready.deforms}', but its 'deformed' is {rule} in every cycle: reviews would look for it elsewhere",
    )


def learning_remembers(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A controller that `learns` commands otherwise later: without its deformation, for the same measurement."""
    if not trial.controller.learns:
        return
    plain = trial.controller
    if plain.deformation.adapts:
        plain = _with_deformation(trial, Identity()) or plain
    replay = Replay(trial.problem, plain, trial.run)
    memories = [cycle.memory for cycle in replay.cycles()]
    begin = min(int(np.ceil(trial.problem.warm_up_cycles)) + 2, len(memories) - 1)
    early, late = (replay.cycle(begin, memories[k])["command"] for k in (begin, -1))
    hold(
        not np.array_equal(early, late),
        f"learns is true, but after {len(memories)} cycles with a wrong model its command for the measurement of cycle {begin} is "
        f"still {late}: reviews would take its convergence for unknown",
    )


def model_is_of_the_plant(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """The parameters of its `plant_model` have the exact values of the plant that a run moves, or of the problem's."""
    problem = trial.problem
    own = trial.controller.plant_model(problem).plant.parameters
    plants = (problem.plant, problem.real_plant)
    for name, one in own.items():
        known = [plant.parameters[name].exact for plant in plants if name in plant.parameters]
        hold(
            len(known) < len(plants) or one.exact in known,
            f"plant_model() says that the exact '{name}' is {one.exact:.6g}, the plant has {(known or [0.0])[0]:.6g}: results "
            "would be compared with a plant that is not there",
        )


def notes_are_sentences(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Its `notes` are sentences for a reader: a tuple of texts, none of them empty."""
    notes = checked(trial.problem, trial.controller).notes(trial.problem)
    texts = isinstance(notes, tuple) and all(isinstance(one, str) and one.strip() for one in notes)
    hold(texts, f"its notes are {notes!r}")


def law_is_what_it_does(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Near the reference it feeds the error back with the gains of its `tracking` law, from which reviews read its speed."""
    ready, plant = checked(trial.problem, trial.controller), trial.problem.plant
    law = tracking_law(ready)
    if law is None or ready.planner is not None or ready.inner is not None:
        return
    k = min(int(np.ceil(trial.problem.warm_up_cycles)) + 2, trial.run.cycles - 1)
    replay = Replay(trial.problem, ready, trial.run)
    memory = [cycle.memory for cycle, _ in zip(replay.cycles(), range(k), strict=False)][-1]
    on = replay.cycle(k, memory)["reference"]
    at = replay.cycle(k, memory, **{plant.output.name: on})["desired"]
    for row, (name, order) in enumerate(plant.response_orders.items()):
        gains = law.gains(order) if order else None
        if gains is None:
            continue
        for s, gain in enumerate(gains[-order:]):
            place = plant.output.elements.index(name + "'" * s)
            near = on - _NEAR * (np.arange(on.size) == place)
            moved = replay.cycle(k, memory, **{plant.output.name: near})["desired"]
            slope = float(moved[row] - at[row]) / _NEAR
            hold(
                within(slope - gain, _SLOPE * (1 + abs(gain))),
                f"near the reference the error of '{plant.output.elements[place]}' is fed back with {slope:.6g}, its law "
                f"{type(law).__name__} says {gain:.6g}",
            )


def outputs_are_controlled(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """The same plant given by states, with the coordinates as outputs, gets the same commands, or is refused by `check`."""
    spelled = spelled_by_states(trial.problem)
    if spelled is None:
        return
    short = (replace(p, duration=_SHORT * p.period, measure_from=0.0) for p in (trial.exact, spelled))
    trials = [_moved(p, trial, "a plant with outputs") for p in short]
    if None in trials:
        return
    one, other = (run["command"] for run in trials if run is not None)
    size = 1e-12 + float(np.abs(one).max())
    missed = float(np.abs(one - other).max()) if one.shape == other.shape else np.inf
    hold(
        within(missed, _ALIKE * size),
        f"where the coordinates are outputs of states in another order its commands differ by {missed:.3g}, of {size:.3g}; read "
        "plant.output and not plant.state for what follows the reference, or raise NotSupported in check() with the reason",
    )


def maps_are_controlled(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A map that it does not refuse, which moves in coarse steps and is known exactly, it does not drive away."""
    problem = coarse_steps()
    run = _moved(problem, trial, "a map")
    if run is None:
        return
    errors = np.abs(run["true_error"])
    rest, first = float(errors[-run.cycles // 4 :].max()), float(errors[0].max())
    hold(
        run.stop is None and within(rest, first * (1 + _SAME)),
        f"it takes a map, but the error {first:.3g} of stocks that are filled in steps of {problem.period:g} s is "
        f"{rest:.3g} after {run.cycles} steps; write its law for differences of steps, or raise NotSupported in check() with "
        "the reason",
    )


def _moved(problem: Problem, trial: Trial, kind: str) -> Run | None:
    """A run on another problem, with a plant of this kind; None where the controller refuses it, for a reason of its own."""
    try:
        return simulate(problem, trial.controller, seed=trial.seed, compiled=False)
    except FpirhcError:
        return None
    except Exception as error:
        words = " ".join(str(error).split())
        hold(False, f"it says that it can control {kind}, but cannot be built for one: {words}")
        raise


def _with_deformation(trial: Trial, deformation: Any) -> Controller | None:
    """The controller with another deformation; None where it takes none, or not this one."""
    try:
        other = trial.controller.with_deformation(deformation)
        checked(trial.problem, other)
    except FpirhcError:
        return None
    return other


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
        same = with_field(ready, "optimiser", planner.optimiser)
        hold(describe(same) == describe(ready), "with its own optimiser it has another description")


def writes_a_command_and_a_status(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A cycle writes what every run logs: reference, error, desired, deformed, command, clipped, status."""
    written = compose_controller(build(trial.problem, trial.controller)).trace
    expected = ("reference", "error", "desired", "deformed", "command", "clipped", "status")
    missing = [name for name in expected if name not in written]
    hold(not missing, f"its blocks do not write {missing}; end them with closing_blocks()")
    size, own = trial.problem.plant.input.size, written["command"].size
    hold(own == size, f"its command has {own} entries, the plant has {size} inputs")


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
    run, scale = trial.run, 1 + float(np.abs(trial.run["command"]).max())
    equal = copy(trial.controller)  # the same value is composed once
    made = {"a Stepper": (trial.controller, False), "a second Stepper": (equal, False)}
    for what, (controller, c) in (made | ({"compiled C": (equal, True)} if trial.compiled else {})).items():
        stepper = Stepper(trial.problem, controller, compiled=c, bounded=False)
        memory, measured = stepper.start(), raw_measurements(run)
        for k in range(min(run.cycles, REPLAYED) if c == stepper.compiled else 0):
            command, memory = stepper.step_measured(float(run.time[k]), measured[k], memory)
            missed = np.abs(command - run["command"][k]).max()
            hold(
                within(missed, _SAME * scale),
                f"in cycle {k} the loop's command is {run['command'][k]}, from {what} it is {command}",
            )


def command_keeps_the_limits(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """No command leaves the limits of the inputs, also where they are half of the commands without limits."""
    plant, commands = trial.problem.plant, trial.run["command"]
    middle, most = 0.5 * (commands.max(axis=0) + commands.min(axis=0)), 0.5 * np.ptp(commands, axis=0)
    ends = zip(plant.inputs, (middle - _TIGHT * most).tolist(), (middle + _TIGHT * most).tolist(), strict=True)
    tight = replace(trial.problem.limits, inputs={name: (low, high) for name, low, high in ends})
    narrow = replace(trial.problem, limits=tight)
    # A weak actuator may lose the plant: every command up to there counts.
    for problem, run in ((trial.problem, trial.run), (narrow, trial.simulated(narrow))):
        lower, upper = problem.limits.input_bounds(plant)
        sent = run["command"]
        outside = np.maximum(lower - sent, sent - upper)
        k, j = np.unravel_index(int(np.argmax(outside)), outside.shape)
        hold(
            bool((outside <= 0).all()),
            f"the command '{plant.input.elements[j]}' is {sent[k, j]:.6g} at t = {run.time[k]:g} s, outside ({lower[j]:g}, "
            f"{upper[j]:g})",
        )
        if "command_unclipped" in run.layout:
            cut = np.abs(run["command_unclipped"] - sent).max(axis=1) > _SAME * (1 + np.abs(sent).max(axis=1))
            at_limit = (np.isclose(sent, lower) | np.isclose(sent, upper)).any(axis=1)
            silent = cut & at_limit & (run["clipped"][:, 0] < 0.5)
            at = float(run.time[int(np.argmax(silent))])
            hold(not silent.any(), f"it clips at t = {at:g} s, and its signal 'clipped' is 0")


def bad_measurement_never_acts(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """A measurement that is not finite gives a finite command within the limits and a status, and does no lasting harm."""
    for bad in (np.nan, np.inf):
        for k, name in enumerate(trial.problem.plant.state.elements):
            _measured_once(trial, bad, k, f"'{name}' measured as {bad} in cycle {_STEPS}")
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
    same_command_everywhere,
    command_keeps_the_limits,
    bad_measurement_never_acts,
    exact_model_tracks,
    facts_hold,
    exact_parameters_are_unknown,
    deformation_acts,
    desired_response_is_deformed,
    learning_remembers,
    model_is_of_the_plant,
    law_is_what_it_does,
    notes_are_sentences,
    outputs_are_controlled,
    maps_are_controlled,
)
