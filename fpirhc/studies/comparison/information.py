"""What each controller of a comparison knows, and how often it acts on it: the same information and the same rate, or not.

All controllers of a problem are given the same measurements in every cycle. Which of them a controller uses is read from its
composed step: a measurement is used where the command or the memory depends on it, structurally.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fpirhc.controllers.base import Controller
from fpirhc.errors import listed
from fpirhc.plant.chain import measured_signals
from fpirhc.sensing.base import names_of_responses, response_names
from fpirhc.symbolic.block import Composite
from fpirhc.task.problem import Problem

_SAMPLE = ("state", "output", "realised", "measured", "arrived")


@dataclass(frozen=True)
class Information:
    """What a controller uses, and when.

    Args:
        uses: names of the measured quantities on which its command depends.
        rate: in words: in every cycle, or with every plan.
        waits: whether what it learns waits for the next plan.
    """

    uses: tuple[str, ...]
    rate: str
    waits: bool = False


def information(problem: Problem, controller: Controller, loop: Composite, cycles: int) -> Information:
    """Return what a controller uses, and when.

    Args:
        problem: of the loop.
        controller: resolved.
        loop: closed with it.
        cycles: from plan to plan; 1 for a controller that does not plan.
    """
    waits = cycles > 1 and controller.learns and not _acts_at_once(controller)
    return Information(_used(problem, loop), _rate(controller, cycles), waits)


def sentences(problem: Problem, known: Mapping[str, Information]) -> tuple[str, ...]:
    """Return the lines of a comparison: what all are given, what each uses, and when each acts.

    Args:
        problem: of all controllers.
        known: by name of the controller.
    """
    if not known:
        return ()
    return _given(problem), *_grouped("use", _by_use(known)), *_grouped("act", _by_rate(known))


def _given(problem: Problem) -> str:
    plant, sensing = problem.plant, problem.sensing
    names = sensing.measures(plant) if sensing.estimates else (*plant.output.elements, *response_names(plant))
    if sensing.observer is None:  # the state beside outputs too
        beside = [element for signal in measured_signals(plant)[:-1] for element in signal.elements]
        names = (*beside, *(n for n in names if n not in beside))
    names = tuple(dict.fromkeys(names))  # an output of order 0 is its own response
    text = f"all controllers are given {', '.join(names)} in every cycle of {problem.period:.3g} {problem.time_unit}"
    late = problem.dead_time.measurement
    text += f", {late:g} {problem.time_unit} late" if late else ""
    if sensing.estimates:
        text += f"; {type(sensing.estimator).__name__} estimates the response from them"
    believed = sensing.believed(plant)
    return text + (f"; {', '.join(believed)} are believed ({type(sensing.observer).__name__})" if believed else "")


def _by_use(known: Mapping[str, Information]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name, one in known.items():
        groups.setdefault(", ".join(one.uses) or "nothing measured", []).append(name)
    return groups


def _by_rate(known: Mapping[str, Information]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name, one in known.items():
        groups.setdefault(one.rate, []).append(name)
    return groups


def _grouped(verb: str, groups: Mapping[str, Sequence[str]]) -> list[str]:
    """One line per group; one line for all where there is one group."""
    if len(groups) == 1:
        [what] = groups
        return [f"every controller {verb}s {what}"]
    return [f"{listed(names)}: {verb if len(names) > 1 else verb + 's'} {what}" for what, names in groups.items()]


def _used(problem: Problem, loop: Composite) -> tuple[str, ...]:
    """Names of the measured quantities on which the controller inside the loop depends, in the order in which they are given."""
    inside = next((b.inside for b in loop.blocks if b.inside is not None), None)
    if inside is None:
        return ()
    used: list[str] = []
    for place, signal in enumerate(inside.reads.signals, start=1):
        if signal.name not in _SAMPLE:
            continue
        names = names_of_responses(problem.plant, signal) if signal.name == "realised" else signal.elements
        columns = {k for result in (0, 2) for k in inside.function.jac_sparsity(result, place).get_triplet()[1]}
        used += [names[k] for k in sorted(columns) if names[k] not in used]
    return tuple(used)


def _acts_at_once(controller: Controller) -> bool:
    """Whether a change of its model changes the command in every cycle; a plan may hold its inputs."""
    return controller.planner is None or controller.planner.follows_model


def _rate(controller: Controller, cycles: int) -> str:
    """The words for when a controller acts."""
    if cycles == 1:
        return "in every cycle"
    between = ["its deformation acts"] if controller.deformation.adapts else []
    between += ["its newest estimate acts"] if controller.learns and _acts_at_once(controller) else []
    text = f"with a new plan every {cycles} cycles"
    text += f", between plans {' and '.join(between)} in every cycle" if between else ""
    if controller.learns and not _acts_at_once(controller):
        text += ", in which a new estimate takes effect"
    return text
