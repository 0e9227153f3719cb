"""The three forms of the iteration around one map, told what the problem says about dead times."""

from __future__ import annotations

from fpirhc.deformation.base import Deformation
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.deformation.wrappers.delayed import Increment
from fpirhc.task.problem import Problem

PLAIN, INCREMENT, REFERENCED = "plain", "increment", "model-referenced"


def map_inside(deformation: Deformation) -> Deformation:
    """Return the map inside a form: without pairing, increment and model reference."""
    map_ = deformation
    while map_.inner is not None and (
        map_.mirror is not None or map_.iteration.pairing is not None or not map_.iteration.slows_desired
    ):
        map_ = map_.inner
    return map_


def forms_of(problem: Problem, deformation: Deformation) -> dict[str, Deformation]:
    """Return the forms of the deformation's map by name, paired with the dead times of the problem.

    The plain form is left out where the response is late: it would need a pairing, which `Paired` gives.
    """
    map_, times = map_inside(deformation), problem.dead_time
    inputs = tuple(times.inputs.get(name, 0.0) / problem.period for name in problem.plant.inputs)
    measurement = times.measurement / problem.period
    cycles = inputs[0] if len(set(inputs)) == 1 else inputs
    sums = cycles + measurement if isinstance(cycles, float) else tuple(c + measurement for c in cycles)
    forms = {} if max(inputs) + measurement else {PLAIN: map_}
    return {
        **forms,
        INCREMENT: Increment(map_, cycles=sums),
        REFERENCED: ModelReferenced(map_, cycles=cycles, measurement=measurement),
    }
