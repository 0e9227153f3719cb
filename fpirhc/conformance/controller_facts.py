"""Laws about what a controller says of itself, and about what it may know.

A review, a comparison and a reader believe the facts of a controller. They are compared with what its cycles do when they are given
the motion of a recorded run: with another deformation, other exact parameters, a state near the reference.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fpirhc.conformance.laws import hold, within
from fpirhc.conformance.loops import Replay, Trial, coarse_steps, spelled_by_states
from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import checked
from fpirhc.controllers.contract import tracking_law
from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Identity
from fpirhc.errors import FpirhcError
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.task.problem import Problem

Array = npt.NDArray[Any]

_OTHER = 1.01  # factor of exact parameters
_PROBE = 0.3  # effective gain of the map with which a controller's wiring is looked at
_SAME = 1e-9  # relative
_NEAR = 1e-6  # distance from the reference at which a law is linear
_SLOPE = 1e-3  # relative error of a difference quotient
_ALIKE = 0.05  # of the largest command: what two spellings of a plant may differ by in unconverged plans
_SHORT = 40  # cycles


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
    others = Replay(trial.problem, weaker, trial.run).cycles()
    differ = (
        not np.array_equal(cycle["command"], its) for cycle, its in zip(others, trial.replay.commands, strict=True)
    )
    hold(
        any(differ),
        f"with half of the effective gain {deformation.effective_gain():.3g} its commands are the same in the first "
        f"{len(trial.replay.commands)} cycles of a run with a wrong model; use the deformation, "
        "closing_blocks(problem, self.deformation)",
    )


def desired_response_is_deformed(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Where `deforms` is "response" the signal 'deformed' is the map of the logged 'desired', and only there."""
    ready = checked(trial.problem, trial.controller)
    gain = _PROBE if ready.deformation.effective_gain() >= 0 else -_PROBE
    probe = _with_deformation(trial, Affine(gain=-2 * gain))
    if probe is None or not ready.deformation.adapts or ready.response(trial.problem) is not None:
        return
    before, missed, moved = None, 0.0, 0.0
    for k, cycle in enumerate(Replay(trial.problem, probe, trial.run).cycles()):
        free = cycle["clipped"][0] == 0 and k > trial.problem.longest_warm_up
        if free and before is not None:
            expected = before - gain * (trial.run["realised"][k] - cycle["desired"])
            size = 1 + np.abs(expected).max()
            missed = max(missed, float(np.abs(cycle["deformed"] - expected).max() / size))
            moved = max(moved, float(np.abs(cycle["deformed"] - cycle["desired"]).max() / size))
        before = cycle["deformed"] if free else None
    does = missed <= _SAME
    if ready.deforms == "response":
        hold(
            does,
            f"deforms is 'response', but with the affine map of gain {gain:g} its 'deformed' misses "
            f"r - {gain:g} (realised - desired) by the share {missed:.3g}; log the desired response that is deformed",
        )
    else:
        hold(
            not does or moved <= _SAME,
            f"deforms is '{ready.deforms}', but its 'deformed' is r - {gain:g} (realised - desired) in every cycle: reviews "
            "would look for its deformation elsewhere",
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
    begin = min(int(np.ceil(trial.problem.longest_warm_up)) + 2, len(memories) - 1)
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
    wrong = [n for n, p in own.items() if all(n in q.parameters and q.parameters[n].exact != p.exact for q in plants)]
    if wrong:
        name, plant = wrong[0], problem.plant
        hold(
            False,
            f"plant_model() says that the exact '{name}' is {own[name].exact:.6g}, the plant has "
            f"{plant.parameters[name].exact:.6g}: results would be compared with a plant that is not there",
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
    if law is None or ready.planner is not None or ready.feeds:
        return
    k = min(int(np.ceil(trial.problem.longest_warm_up)) + 2, trial.run.cycles - 1)
    replay = Replay(trial.problem, ready, trial.run)
    memory = [cycle.memory for cycle, _ in zip(replay.cycles(), range(k), strict=False)][-1]
    on = replay.cycle(k, memory)["reference"]
    at = replay.cycle(k, memory, **{plant.output.name: on})["desired"]
    for row, (name, order) in enumerate(plant.response_orders.items()):
        feedback = law.feedback(order) if order else None
        if feedback is None:
            continue
        for s, gain in enumerate(feedback.gains[-order:]):
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


FACTS = (
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
