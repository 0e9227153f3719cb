"""Whether the parts of a problem fit together: steps of maps, what the plant that moves must have, cost, limits and set-points.

A map has its own steps in place of an integrator, in the run and along a horizon. A response of a map is a difference of outputs,
which no sensor shows, so it is taken from the outputs of the last cycles (`StepDifference`); that of an output of order 0 is the
output itself, and measured. What is believed, nobody measures; a reality need not have it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.user_code import named_results, scalar_expression
from fpirhc.horizon.cost import Cost, view_of_symbols
from fpirhc.plant.integrators import USUAL, Integrator, MapSteps
from fpirhc.plant.maps import check_time, over
from fpirhc.plant.motion import followed_units
from fpirhc.plant.plant import Plant
from fpirhc.sensing.sensing import Sensing
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.open import nominal
from fpirhc.task.limits import Limits

if TYPE_CHECKING:
    from fpirhc.task.problem import Problem


def settled_maps(problem: Problem, mistakes: Mistakes) -> dict[str, object]:
    """Return the fields of a problem that follow from its maps, by name, and add to `mistakes` what does not fit their steps."""
    settled: dict[str, object] = {}
    with mistakes.caught():
        plant = settled["plant"] = over(problem.plant, problem.period)
        settled["reality"] = problem.reality and problem.reality.over(problem.period)
    if not mistakes.none:
        return {}
    if plant.step is not None:
        settled["integrator"] = _steps("integrator", problem.integrator, mistakes)
        if problem.horizon is not None:
            discretisation = _steps("horizon: discretisation", problem.horizon.discretisation, mistakes)
            settled["horizon"] = replace(problem.horizon, discretisation=discretisation)
            if any(length % 1 for length in problem.horizon.lengths):
                mistakes.add(
                    f"horizon: the stages of a map are whole steps of it, got lengths {problem.horizon.lengths}"
                )
        if problem.sensing.estimator.measures_all and not plant.at_once:
            from fpirhc.sensing.positions import StepDifference  # of maps alone

            settled["sensing"] = replace(problem.sensing, estimator=StepDifference())
    elif problem.integrator.steps_maps:
        settled["integrator"] = USUAL
    return settled


def check_maps(model: Plant, real: Plant, mistakes: Mistakes) -> None:
    """Add what is not covered beside a map to `mistakes`."""
    instant = model.at_once
    at_once = bool(instant) and set(instant) == set(model.controlled or model.chains)  # no derivative is looked for
    check_time(real, model, model.chains, mistakes, at_once=at_once)
    if model.step is None:
        return
    if instant and not at_once:
        mistakes.add(
            f"outputs: {', '.join(instant)} of order 0 beside outputs that steps move: their responses belong to other "
            "cycles, which is not covered; control them by two problems"
        )


def _steps(what: str, integrator: Integrator, mistakes: Mistakes) -> Integrator:
    """The steps of a map in place of an integrator that nobody named."""
    if integrator.steps_maps:
        return integrator
    if integrator is not USUAL:
        mistakes.add(f"{what}: {integrator!r} integrates differential equations; the plant is a map, leave it out")
    return MapSteps()


def needed_names(
    plant: Plant, sensing: Sensing, judged: Sequence[str] | None
) -> tuple[frozenset[str], tuple[str, ...]]:
    """Return the names of the model's coordinates and outputs that what moves must have, and of what is measured.

    Measured is what sensors show, and the state that is given beside outputs where nothing is believed. `judged`: names whose
    errors are judged beside the controlled ones; None: no other need be there.
    """
    beside = plant.motion[:-1] if sensing.observer is None else ()
    states = [element for signal in beside for element in signal.elements]
    measured = tuple(dict.fromkeys((*states, *sensing.measures(plant))))
    if sensing.observer is None:
        return frozenset((*plant.coordinates, *followed_units(plant))), measured
    return frozenset((*(name.rstrip("'") for name in measured), *(judged or ()), *plant.controlled_names)), measured


def check_stage(plant: Plant, cost: Cost | None, limits: Limits, mistakes: Mistakes) -> None:
    """Add every mistake in the cost's names and weights, and in the user's functions of a stage; problems share what they share."""
    mistakes.join(_STAGES.of((plant, cost, limits), (), lambda: _of_stage(plant, nominal(cost), nominal(limits))))


_STAGES: Latest[Mistakes] = Latest(8)


def _of_stage(plant: Plant, cost: Cost | None, limits: Limits) -> Mistakes:
    mistakes = Mistakes("stage")
    view = view_of_symbols(plant)
    parts = (view.state, view.output, view.reference, view.input, view.input_before, view.feedforward, view.parameters)
    symbols = (*(part.vector for part in parts), view.time)
    if cost is not None:
        with mistakes.caught():
            cost.check(plant)
            for name, term in named_results("cost", cost.stage(view)).items():
                scalar_expression(f"cost: term '{name}'", term, symbols=symbols, finite=False)
    for name, path in limits.paths.items():
        with mistakes.caught():
            path.named_value(name, view, symbols)
    return mistakes


def check_values(plant: Plant, limits: Limits, values: Mapping[str, Iterable[float]]) -> None:
    """Raise if a set-point is not finite, or can never be reached."""
    mistakes = []
    for name, numbers in values.items():
        hard = {} if name in limits.prices else limits.states
        ranges = {
            what: ends[name] for what, ends in (("physical range", plant.ranges), ("limits", hard)) if name in ends
        }
        for value in dict.fromkeys(numbers):
            if not math.isfinite(value):
                mistakes.append(f"'{name}' is {value}, expected a finite number")
                continue
            for what, (low, high) in ranges.items():
                if not low <= value <= high:
                    mistakes.append(f"'{name}' is {value:g}, outside its {what} of {low:g} to {high:g}")
    if mistakes:
        raise InvalidValue(f"set-points: {'; '.join(mistakes)}")
