"""A plant with disturbances as parameters of value zero, as a filter estimates them."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import casadi as ca

from fpirhc.errors import InvalidProblem, Mistakes
from fpirhc.plant.chain import response_names
from fpirhc.plant.maps import Differences
from fpirhc.plant.motion import followed_units, forcing_units
from fpirhc.plant.plant import Output, Parameter, Plant
from fpirhc.symbolic.layout import Expression, Named

_Map = Callable[..., Mapping[str, Expression]]


def disturbed(plant: Plant, names: Sequence[str]) -> Plant:
    """Return the plant with disturbances as parameters of value 0, see `disturbance_name`.

    The disturbance of a coordinate adds to its response, that of an output to the output. That of an output's response (y'' for
    order 2) adds to the response alone, and no state sees it. A name of both a coordinate and an output is the coordinate's.

    Raises:
        InvalidProblem: an unknown name, no name, a parameter that already has the name, or a response that has a disturbance
            already.
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
    coordinates = [n for n in names if n in plant.coordinates]
    units = dict(followed_units(plant)) | dict(zip(plant.names, forcing_units(plant), strict=True))
    if responses:
        units |= dict(zip(responses, plant.response_signal("_").units, strict=True))
    added = {disturbance_name(n): Parameter(0.0, 0.0, units[n]) for n in names}
    moved, share = (plant.response, 1.0) if plant.next is None else (plant.next, float(plant.step or 1.0))
    response = _moved(plant, moved, share, coordinates)
    bare = replace(
        plant,
        parameters={**plant.parameters, **added},
        response=response if plant.next is None else Differences(response, plant.names, share),
        inverse=None,
        outputs={n: _output(plant, n, one, names) for n, one in plant.outputs.items()},
    )
    inverse = plant.inverse
    return (
        bare if inverse is None or _mixed(bare, coordinates) else replace(bare, inverse=_inverse(plant, inverse, names))
    )


def _mixed(plant: Plant, coordinates: Sequence[str]) -> bool:
    """Whether a coordinate's disturbance is in the response of another quantity, so that a user's inverse does not know it."""
    x, u, p = plant.symbols()
    own = [disturbance_name(n) for n in coordinates]
    pattern = ca.jacobian_sparsity(plant.equations.controlled_response(x, u, p), p)
    pairs = zip(*pattern.get_triplet(), strict=True)
    parameters, controlled = plant.parameter.elements, plant.controlled_names
    return any(parameters[k] in own and parameters[k] != disturbance_name(controlled[i]) for i, k in pairs)


def disturbance_name(name: str) -> str:
    """Name of the parameter that disturbs a coordinate's response, an output (w_y), or an output's response (w_y_2 of y'')."""
    order = name.count("'")
    return f"w_{name.rstrip(chr(39))}_{order}" if order else f"w_{name}"


def _moved(plant: Plant, function: _Map, share: float, coordinates: Sequence[str]) -> _Map:
    """The response, or the next state of a map, with so large a share of each coordinate's disturbance."""

    def moved(*arguments: Named) -> Mapping[str, Expression]:
        *others, p = arguments
        values = function(*others, _own(plant, p))
        return {c: v + share * p[disturbance_name(c)] if c in coordinates else v for c, v in values.items()}

    vars(moved)["__signature__"] = inspect.signature(function)
    return moved


def _output(plant: Plant, name: str, one: Output, names: Sequence[str]) -> Output:
    """The output as an expression of the plant's own parameters, and of those of `names` that disturb it or its response."""
    shifted = name in names and name not in plant.coordinates
    own = [n for n in names if "'" in n and n.rstrip("'") == name]

    def expression(*arguments: Named) -> Expression:
        *others, p = arguments
        value = one.expression(*others, _own(plant, p))
        return value + p[disturbance_name(name)] if shifted else value

    vars(expression)["__signature__"] = inspect.signature(one.expression)
    if own and one.response_disturbance:
        raise InvalidProblem(
            f"disturbances of the model: the response of '{name}' has the disturbance {one.response_disturbance} already"
        )
    return replace(
        one, expression=expression, response_disturbance=disturbance_name(own[0]) if own else one.response_disturbance
    )


def _inverse(
    plant: Plant, inverse: Callable[..., Mapping[str, Expression]], names: Sequence[str]
) -> Callable[..., Mapping[str, Expression]]:
    """The user's inverse for the response without its disturbance; that of an output itself changes no response."""
    responses = dict(zip(response_names(plant), plant.controlled_names, strict=True))
    by = {responses.get(n, n): disturbance_name(n) for n in names if n in responses or n in plant.names}

    def undisturbed(*arguments: Named) -> Mapping[str, Expression]:
        *others, r, p = arguments
        entries = [r[c] - p[by[c]] if c in by else r[c] for c in plant.controlled_names]
        return inverse(*others, Named(plant.controlled_names, ca.vertcat(*entries), "coordinate"), _own(plant, p))

    return undisturbed


def _own(plant: Plant, p: Named) -> Named:
    """The parameters of the plant without disturbances."""
    return Named(tuple(plant.parameters), p.vector[: len(plant.parameters)], "parameter")
