"""A plant with disturbances as parameters of value zero, as a filter estimates them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from fpirhc.errors import Mistakes
from fpirhc.plant.chain import response_names
from fpirhc.plant.motion import followed_units, forcing_units
from fpirhc.plant.plant import Parameter, Plant


def disturbed(plant: Plant, names: Sequence[str]) -> Plant:
    """Return the plant with disturbances as parameters of value 0, see `disturbance_name`.

    The disturbance of a coordinate adds to its response, that of an output to the output. That of an output's response (y'' for
    order 2) adds to the response alone, and no state sees it. A name of both a coordinate and an output is the coordinate's.

    Raises:
        InvalidProblem: an unknown name, no name, or a parameter that already has the name.
    """
    mistakes = Mistakes("drift: disturbances of the model")
    responses = dict(zip(response_names(plant), plant.controlled_names, strict=True)) if plant.outputs else {}
    what = "coordinate, output or response of an output" if plant.outputs else "coordinate"
    mistakes.unknown(what, names, list(dict.fromkeys([*plant.names, *plant.chains, *responses])))
    if not names:
        mistakes.add("name at least one coordinate whose response is disturbed")
    for name in (disturbance_name(c) for c in names):
        if name in plant.parameters:
            mistakes.add(f"the plant has a parameter '{name}' already; rename it")
    mistakes.raise_if_any()
    units = dict(followed_units(plant)) | dict(zip(plant.names, forcing_units(plant), strict=True))
    if responses:
        units |= dict(zip(responses, plant.response_signal("_").units, strict=True))
    added = {disturbance_name(n): Parameter(0.0, 0.0, units[n]) for n in names}
    believed = {**plant.believed, **{n: disturbance_name(n) for n in names}}
    made = replace(plant, parameters={**plant.parameters, **added}, believed=believed)
    return replace(made, inverse=None) if plant.inverse is not None and _mixed(made) else made


def _mixed(plant: Plant) -> bool:
    """Whether a coordinate's disturbance is in the response of another quantity, so that a user's inverse does not know it."""
    x, u, p = plant.symbols()
    of = {parameter: name for name, parameter in plant.believed.items() if name in plant.coordinates}
    pattern = ca.jacobian_sparsity(plant.equations.controlled_response(x, u, p), p)
    parameters, controlled = plant.parameter.elements, plant.controlled_names
    pairs = zip(*pattern.get_triplet(), strict=True)
    return any(of.get(parameters[k], controlled[i]) != controlled[i] for i, k in pairs)


def disturbance_name(name: str) -> str:
    """Name of the parameter that disturbs a coordinate's response, an output (w_y), or an output's response (w_y_2 of y'')."""
    order = name.count("'")
    return f"w_{name.rstrip(chr(39))}_{order}" if order else f"w_{name}"
