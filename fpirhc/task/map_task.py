"""A task whose plant, or reality, is a map: what follows from its steps, and what is refused beside them.

A map has its own steps in place of an integrator, in the run and along a horizon. The plant of the problem is the map over one
control cycle (`fpirhc.plant.maps`). A response of a map is a difference of outputs, which no sensor shows, so it is taken from the
outputs of the last cycles (`StepDifference`); that of an output of order 0 is the output itself, and measured.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.integrators import USUAL, Integrator
from fpirhc.plant.map_steps import MapSteps
from fpirhc.plant.plant import Plant
from fpirhc.sensing.positions import StepDifference

if TYPE_CHECKING:
    from fpirhc.task.problem import Problem


def settle_maps(problem: Problem, mistakes: Mistakes) -> None:
    """Put into a new problem what follows from its maps, and add to `mistakes` what does not fit their steps."""
    settled: dict[str, object] = {}
    reality = problem.reality.symbolic if problem.reality is not None else None
    try:
        settled["plant"] = problem.plant.over(problem.period)
        if reality is not None:
            real = reality.plant.over(problem.period)
            settled["reality"] = reality if real is reality.plant else replace(reality, plant=real)
    except InvalidValue as error:
        mistakes.add(str(error))
        return
    if problem.plant.step is not None:
        settled["integrator"] = _steps("integrator", problem.integrator, mistakes)
        if problem.horizon is not None:
            discretisation = _steps("horizon: discretisation", problem.horizon.discretisation, mistakes)
            settled["horizon"] = replace(problem.horizon, discretisation=discretisation)
        if problem.sensing.estimator.measures_all and not _instant(problem.plant):
            settled["sensing"] = replace(problem.sensing, estimator=StepDifference())
    elif problem.integrator.steps_maps:
        settled["integrator"] = USUAL
    for name, value in settled.items():
        object.__setattr__(problem, name, value)


def check_map_task(problem: Problem, mistakes: Mistakes) -> None:
    """Add what is not covered beside a map to `mistakes`."""
    model, reality = problem.plant, problem.symbolic_reality
    instant = _instant(model)
    at_once = bool(instant) and set(instant) == set(model.controlled or model.outputs)  # no derivative is looked for
    if reality is not None and reality.plant.step is not None and model.step is None and not at_once:
        mistakes.add(
            "reality: it is a map, and the model has differential equations, whose derivatives a map does not have; write the "
            "model as a map with the same step"
        )
    if model.step is None:
        return
    if instant and not at_once:
        mistakes.add(
            f"outputs: {', '.join(instant)} of order 0 beside outputs that steps move: their responses belong to other "
            "cycles, which is not covered; control them by two problems"
        )
    if not instant and not problem.sensing.estimator.of_steps:
        mistakes.add(
            f"sensing: {type(problem.sensing.estimator).__name__} estimates derivatives with respect to time, which a map does not "
            "have; leave the estimator out, and differences of its steps are taken"
        )
    if max(model.face.orders) > 1 and (problem.sensing.belief is not None or problem.sensing.measured is not None):
        mistakes.add(
            "sensing: believed states are not covered where an output of a map has an order above 1, because its next values are "
            "predicted from measured states; leave measured and belief out"
        )
    later = [name for name, order in zip(model.face.names, model.face.orders, strict=True) if order > 1]
    if later and reality is not None and reality.plant.step is None:
        mistakes.add(
            f"reality: '{later[0]}' has the order {max(model.face.orders)} in the model's steps, and the reality has differential "
            "equations, in which every input shows within one cycle; write a model in which it does too"
        )


def _instant(plant: Plant) -> tuple[str, ...]:
    """Controlled outputs that the command moves at once; their response is the output itself."""
    return tuple(name for name in plant.controlled or plant.outputs if name in plant.instant_names)


def _steps(what: str, integrator: Integrator, mistakes: Mistakes) -> Integrator:
    """The steps of a map in place of an integrator that nobody named."""
    if integrator.steps_maps:
        return integrator
    if integrator is not USUAL:
        mistakes.add(f"{what}: {integrator!r} integrates differential equations; the plant is a map, leave it out")
    return MapSteps()
