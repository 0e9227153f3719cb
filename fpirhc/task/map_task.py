"""A task whose plant, or reality, is a map: what follows from its steps, and what is refused beside them.

A map has its own steps in place of an integrator, in the run and along a horizon. The plant of the problem is the map over one
control cycle (`fpirhc.plant.maps`). A response of a map is a difference of outputs, which no sensor shows, so it is taken from the
outputs of the last cycles (`StepDifference`); that of an output of order 0 is the output itself, and measured.
"""

from __future__ import annotations

from dataclasses import replace

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.horizon.horizon import Horizon
from fpirhc.plant.integrators import USUAL, Integrator
from fpirhc.plant.map_steps import MapSteps
from fpirhc.plant.plant import Plant
from fpirhc.sensing import Sensing
from fpirhc.sensing.positions import StepDifference
from fpirhc.task.reality import Reality


def settled_maps(
    plant: Plant,
    reality: Reality | None,
    period: float,
    integrator: Integrator,
    horizon: Horizon | None,
    sensing: Sensing,
    mistakes: Mistakes,
) -> dict[str, object]:
    """Return the fields of a problem that follow from its maps, by name, and add to `mistakes` what does not fit their steps.

    Args:
        plant: the model.
        reality: another plant that moves.
        period: of the control cycle.
        integrator: of the problem.
        horizon: of the problem.
        sensing: of the problem.
        mistakes: of the problem.
    """
    settled: dict[str, object] = {}
    try:
        settled["plant"] = plant.over(period)
        if reality is not None:
            real = reality.plant.over(period)
            settled["reality"] = reality if real is reality.plant else replace(reality, plant=real)
    except InvalidValue as error:
        mistakes.add(str(error))
        return {}
    if plant.step is not None:
        settled["integrator"] = _steps("integrator", integrator, mistakes)
        if horizon is not None:
            discretisation = _steps("horizon: discretisation", horizon.discretisation, mistakes)
            settled["horizon"] = replace(horizon, discretisation=discretisation)
        if sensing.estimator.measures_all and not _instant(plant):
            settled["sensing"] = replace(sensing, estimator=StepDifference())
    elif integrator.steps_maps:
        settled["integrator"] = USUAL
    return settled


def check_maps(model: Plant, reality: Reality | None, sensing: Sensing, mistakes: Mistakes) -> None:
    """Add what is not covered beside a map to `mistakes`."""
    instant = _instant(model)
    at_once = bool(instant) and set(instant) == set(model.controlled or model.face.names)  # no derivative is looked for
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
    if not instant and not sensing.estimator.of_steps:
        mistakes.add(
            f"sensing: {type(sensing.estimator).__name__} estimates derivatives with respect to time, which a map does not "
            "have; leave the estimator out, and differences of its steps are taken"
        )
    if max(model.face.orders) > 1 and (sensing.belief is not None or sensing.measured is not None):
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
    return tuple(name for name in plant.controlled or plant.face.names if not plant.output_orders[name])


def _steps(what: str, integrator: Integrator, mistakes: Mistakes) -> Integrator:
    """The steps of a map in place of an integrator that nobody named."""
    if integrator.steps_maps:
        return integrator
    if integrator is not USUAL:
        mistakes.add(f"{what}: {integrator!r} integrates differential equations; the plant is a map, leave it out")
    return MapSteps()
