"""A model with unknown disturbances of its responses as further parameters.

    q_i^(r_i) = f_i(q, q', ..., u, p) + w_i

A horizon or an inverse, which takes the model's parameters as data, then takes the disturbances as well.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import casadi as ca

from fpirhc.errors import Mistakes
from fpirhc.plant.plant import Parameter, Plant
from fpirhc.symbolic.layout import Expression, Named


def disturbed(plant: Plant, coordinates: Sequence[str]) -> Plant:
    """Return the plant with a disturbance w_i of the response of each named coordinate, a parameter 'w_<name>' of value 0.

    Raises:
        InvalidProblem: an unknown coordinate, no coordinate, or a parameter that already has the name.
    """
    mistakes = Mistakes("disturbed")
    mistakes.unknown("coordinate", coordinates, plant.coordinates)
    if not coordinates:
        mistakes.add("name at least one coordinate whose response is disturbed")
    for name in (disturbance_name(c) for c in coordinates):
        if name in plant.parameters:
            mistakes.add(f"the plant has a parameter '{name}' already; rename it")
    mistakes.raise_if_any()
    units = dict(zip(plant.names, plant.response_units, strict=True))
    added = {disturbance_name(c): Parameter(0.0, 0.0, units[c]) for c in coordinates}
    return replace(
        plant,
        parameters={**plant.parameters, **added},
        response=_response(plant, coordinates),
        inverse=None if plant.inverse is None else _inverse(plant, plant.inverse, coordinates),
    )


def disturbance_name(coordinate: str) -> str:
    """Name of the parameter that disturbs the response of a coordinate."""
    return f"w_{coordinate}"


def _response(plant: Plant, coordinates: Sequence[str]) -> Callable[..., Mapping[str, Expression]]:
    def response(*arguments: Named) -> Mapping[str, Expression]:
        *others, p = arguments
        responses = plant.response(*others, _own(plant, p))
        return {c: v + p[disturbance_name(c)] if c in coordinates else v for c, v in responses.items()}

    vars(response)["__signature__"] = inspect.signature(plant.response)
    return response


def _inverse(
    plant: Plant, inverse: Callable[..., Mapping[str, Expression]], coordinates: Sequence[str]
) -> Callable[..., Mapping[str, Expression]]:
    def undisturbed(*arguments: Named) -> Mapping[str, Expression]:
        *others, r, p = arguments
        entries = [r[c] - p[disturbance_name(c)] if c in coordinates else r[c] for c in plant.controlled_names]
        return inverse(*others, Named(plant.controlled_names, ca.vertcat(*entries), "coordinate"), _own(plant, p))

    return undisturbed


def _own(plant: Plant, p: Named) -> Named:
    """The parameters of the plant without disturbances."""
    return Named(tuple(plant.parameters), p.vector[: len(plant.parameters)], "parameter")
